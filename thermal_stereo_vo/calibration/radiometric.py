"""Stored flat fields from recordings of uniform sources (blackbody, shutter, lens cap).

Every frame gives each pixel one linear equation: its deviation from the mean of the array is a
polynomial of the FPA temperature plus, where sources of several temperatures were seen, a
polynomial times the level.  All pixels share the matrix, so one least-squares solve does them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field import (
    KELVIN,
    FlatField,
    FlatFieldCalibration,
    FlatFieldConfig,
)

OUTLIER_SIGMAS = 10.0
SAME_TEMPERATURE_KELVIN = 0.2


@dataclass(frozen=True)
class FlatFrame:
    """One view of a uniform source.

    ``image`` (H, W) raw counts, a single frame or a mean of many; ``fpa_kelvin`` the temperature
    of the detector; ``source_kelvin`` that of the source, or None when unknown; ``name`` for
    messages.
    """

    image: NDArray[Any]
    fpa_kelvin: float
    source_kelvin: float | None = None
    name: str = ""


@dataclass(frozen=True)
class FlatFieldOrders:
    """Degrees of the polynomials of FPA temperature; ``gain`` None means a gain of one.

    The default takes what the recordings can carry: offset up to the fourth degree, a constant
    gain where sources of different temperatures were seen.
    """

    offset: int | None = None
    gain: int | None = -1
    level: int = 2


def fit_flat_field(
    frames: Sequence[FlatFrame],
    *,
    serial: str = "",
    camera: str = "",
    orders: FlatFieldOrders | None = None,
) -> FlatFieldCalibration:
    """Fit gain, offset and bad pixels of one camera.

    Raises:
        CalibrationError: when there is no frame, sizes differ, a number is not finite, or the
            recordings cannot carry the degrees asked for.
    """
    _check(frames)
    fpa = np.array([frame.fpa_kelvin for frame in frames], np.float64)
    offset_order, gain_order, level_order = _orders(frames, orders or FlatFieldOrders())
    centre = 0.5 * (float(fpa.min()) + float(fpa.max()))
    scale = max(0.5 * float(np.ptp(fpa)), 1.0)
    t = (fpa - centre) / scale

    means = np.array([_robust_mean(frame.image) for frame in frames])
    level = np.polynomial.polynomial.polyfit(t, means, level_order)
    above = means - np.polynomial.polynomial.polyval(t, level)
    columns = [t**power for power in range(offset_order + 1)]
    if gain_order is not None:
        columns += [above * t**power for power in range(gain_order + 1)]
    design = np.column_stack(columns)
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise CalibrationError(
            f"{len(frames)} flat fields at {len(_distinct(fpa))} FPA temperatures cannot carry an "
            f"offset of degree {offset_order} and a gain of degree {gain_order}: record more "
            "temperatures and sources, or lower the degrees"
        )
    coefficients, residual_rms = _solve(frames, means, design)
    offset = coefficients[: offset_order + 1]
    height, width = frames[0].image.shape
    gain = np.ones((1, height, width))
    if gain_order is not None:
        gain = _inverse_gain(coefficients[offset_order + 1 :], t)
    bad = _outliers([*offset, *gain, residual_rms]) | (gain[0] < 0.3) | (gain[0] > 3.0)
    good_share = float(np.mean(~bad))
    if good_share < 0.5:
        raise CalibrationError(
            f"only {100 * good_share:.0f} % of the pixels look sound: was the source uniform?"
        )
    calibration = FlatFieldCalibration(
        serial=serial,
        camera=camera,
        minimum_kelvin=float(fpa.min()),
        maximum_kelvin=float(fpa.max()),
        centre_kelvin=centre,
        scale_kelvin=scale,
        level=level,
        offset=offset.astype(np.float32),
        gain=gain.astype(np.float32),
        bad=bad,
        fpa_kelvin=fpa,
        uncorrected_counts=np.array([non_uniformity(frame.image, bad) for frame in frames]),
        residual_counts=np.zeros(len(frames)),
    )
    return replace(calibration, residual_counts=residual_counts(calibration, frames))


def residual_counts(
    calibration: FlatFieldCalibration, frames: Sequence[FlatFrame], *, reach_kelvin: float = 0.0
) -> NDArray[np.float64]:
    """(M,) spatial standard deviation of each frame once corrected, in counts.

    ``reach_kelvin`` is how far beyond its range the calibration is followed.
    """
    config = FlatFieldConfig(temperature_smoothing_s=0.0, extrapolation_kelvin=reach_kelvin)
    values = []
    for frame in frames:
        # A new object for each frame: no smoothing of the temperature over unrelated frames.
        corrector = FlatField(calibration, config)
        image = np.clip(np.round(frame.image), 0, 65535).astype(np.uint16)
        corrected = corrector.process(image, frame.fpa_kelvin, 0)
        values.append(non_uniformity(corrected, calibration.bad))
    return np.array(values)


def non_uniformity(image: NDArray[Any], bad: NDArray[np.bool_]) -> float:
    """Spatial standard deviation of the pixels that are not bad, in counts."""
    return float(np.std(image[~bad].astype(np.float64)))


def every_second_temperature(
    frames: Sequence[FlatFrame],
) -> tuple[list[FlatFrame], list[FlatFrame]]:
    """The frames in order of FPA temperature, by turns: those to fit, those to test."""
    parts: tuple[list[FlatFrame], list[FlatFrame]] = ([], [])
    turn, last_kelvin = 1, -np.inf
    for frame in sorted(frames, key=lambda frame: frame.fpa_kelvin):
        if frame.fpa_kelvin - last_kelvin > SAME_TEMPERATURE_KELVIN:
            turn, last_kelvin = 1 - turn, frame.fpa_kelvin
        parts[turn].append(frame)
    return parts


def held_out_counts(
    frames: Sequence[FlatFrame], orders: FlatFieldOrders | None = None
) -> NDArray[np.float64]:
    """(M,) residual of the frames at every second temperature under a fit to the others."""
    fitted, tested = every_second_temperature(frames)
    calibration = fit_flat_field(fitted, orders=orders)
    return residual_counts(calibration, tested, reach_kelvin=30.0)


def _check(frames: Sequence[FlatFrame]) -> None:
    if not frames:
        raise CalibrationError("no flat field given: record a uniform source first")
    shape = frames[0].image.shape
    for frame in frames:
        if frame.image.ndim != 2 or frame.image.shape != shape:
            raise CalibrationError(
                f"flat field '{frame.name}' is {frame.image.shape}, the first is {shape}: give "
                "recordings of one camera in one format"
            )
        if not np.isfinite(frame.fpa_kelvin) or not 150.0 < frame.fpa_kelvin < 450.0:
            raise CalibrationError(
                f"flat field '{frame.name}' has an FPA temperature of {frame.fpa_kelvin} K: state "
                "it in the recording"
            )
        if not np.isfinite(frame.image).all():
            raise CalibrationError(f"flat field '{frame.name}' holds NaN or infinite pixels")
        if frame.image.min() == frame.image.max():
            raise CalibrationError(
                f"flat field '{frame.name}' has one value everywhere: the camera sent no image"
            )


def _orders(frames: Sequence[FlatFrame], orders: FlatFieldOrders) -> tuple[int, int | None, int]:
    fpa = [frame.fpa_kelvin for frame in frames]
    temperatures = len(_distinct(fpa))
    sources = _distinct([f.source_kelvin for f in frames if f.source_kelvin is not None])
    offset = orders.offset
    if offset is None:
        offset = min(4, max(1, temperatures // 2), temperatures - 1)
    gain = orders.gain
    if gain is not None and gain < 0:
        gain = 0 if len(sources) > 1 else None
    return offset, gain, min(orders.level, temperatures - 1)


def _distinct(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    """Values that differ by more than what a sensor of temperature tells apart."""
    kept: list[float] = []
    for value in sorted(values):
        if not kept or value - kept[-1] > SAME_TEMPERATURE_KELVIN:
            kept.append(float(value))
    return kept


def _robust_mean(image: NDArray[Any]) -> float:
    """Mean of the pixels within a few robust deviations of the median."""
    values = image.astype(np.float64).ravel()
    median = np.median(values)
    spread = 1.4826 * np.median(np.abs(values - median)) + 1.0
    return float(np.mean(values[np.abs(values - median) < OUTLIER_SIGMAS * spread]))


def _solve(
    frames: Sequence[FlatFrame], means: NDArray[np.float64], design: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(C, H, W) coefficients and (H, W) rms of the residuals, summing frame by frame."""
    shape = frames[0].image.shape
    moments = np.zeros((design.shape[1], *shape))
    squares = np.zeros(shape)
    for frame, mean, row in zip(frames, means, design, strict=True):
        deviation = frame.image.astype(np.float64) - mean
        squares += deviation**2
        moments += row[:, None, None] * deviation
    coefficients = np.tensordot(np.linalg.inv(design.T @ design), moments, axes=1)
    explained = np.einsum("chw,chw->hw", coefficients, moments)
    return coefficients, np.sqrt(np.maximum(squares - explained, 0.0) / len(frames))


def _inverse_gain(slope: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Polynomial (K, H, W) of 1 / (1 + S) fitted at the recorded temperatures."""
    nodes = np.unique(t) if len(slope) > 1 else t[:1]
    powers = np.vander(nodes, len(slope), increasing=True)
    response = 1.0 + np.tensordot(powers, slope, axes=1)
    # A dead pixel has no response; a huge gain marks it as bad below.
    response = np.where(np.abs(response) < 1e-3, 1e-3, response)
    result: NDArray[np.float64] = np.tensordot(np.linalg.pinv(powers), 1.0 / response, axes=1)
    return result


def _outliers(maps: Sequence[NDArray[np.floating]]) -> NDArray[np.bool_]:
    """(H, W) True where any map stands out from its neighbourhood."""
    bad = np.zeros(maps[0].shape, np.bool_)
    for values in maps:
        single = values.astype(np.float32)
        away = np.abs(single - cv2.medianBlur(single, 5))
        sigma = 1.4826 * float(np.median(away))
        if sigma > 0:
            bad |= away > OUTLIER_SIGMAS * sigma
    return bad


def describe_fit(calibration: FlatFieldCalibration) -> str:
    """A table for people: temperature, non-uniformity before and after."""
    rows = sorted(
        zip(
            calibration.fpa_kelvin - KELVIN,
            calibration.uncorrected_counts,
            calibration.residual_counts,
            strict=True,
        )
    )
    lines = [f"{fpa:8.2f}   {before:13.2f}   {after:12.2f}" for fpa, before, after in rows]
    return "\n".join(["FPA degC   before counts   after counts", *lines])
