"""Shutterless flat field: gain and offset of every pixel as polynomials of the FPA temperature.

Model of a pixel that sees a uniform source: its deviation from the mean of the array is
``O(T) + S(T) (mean - m(T))``, with the level ``m(T)`` of the array at FPA temperature ``T``.  So
the corrected count is ``m + (y - m - O) G`` with ``G = 1 / (1 + S)``.  With one temperature and two
sources this is the two-point correction; polynomials of the FPA temperature per pixel follow
Nugent et al., Opt. Eng. 52(6) 061304 (2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import CalibrationError, FrameError

REFRESH_KELVIN = 0.05
"""The maps are evaluated anew once the temperature has moved by this much."""
KELVIN = 273.15


@dataclass(frozen=True)
class FlatFieldConfig:
    """Which stored flat field corrects which camera."""

    file: str = setting(
        "",
        "File of 'calibrate flat-field'; {camera} stands for left, right, ...; empty: none.",
    )
    serials: tuple[str, ...] = setting(
        (), "Serial numbers the files must carry, as camera=serial; empty: any."
    )
    extrapolation_kelvin: float = setting(
        0.0,
        "How far the polynomials are followed beyond the calibrated temperatures before they are "
        "clamped.",
        unit="K",
        minimum=0.0,
        maximum=30.0,
    )
    temperature_smoothing_s: float = setting(
        1.0,
        "Time constant that smooths the coarse reading of the FPA temperature.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )


@dataclass(frozen=True)
class FlatFieldCalibration:
    """The stored flat field of one camera.

    ``level`` (L,), ``offset`` (N, H, W) and ``gain`` (K, H, W) float32 are coefficients in rising
    powers of ``(T - centre_kelvin) / scale_kelvin``; level and offset in counts, gain without unit.
    ``bad`` (H, W) is True for pixels to replace.  ``serial`` and ``camera`` name the camera, empty
    when unknown.  ``fpa_kelvin``, ``uncorrected_counts`` and ``residual_counts`` (M,) tell how
    uniform each calibration frame was before and after (spatial standard deviation).

    Raises:
        CalibrationError: when shapes contradict each other or a number is not finite.
    """

    serial: str
    camera: str
    minimum_kelvin: float
    maximum_kelvin: float
    centre_kelvin: float
    scale_kelvin: float
    level: NDArray[np.float64]
    offset: NDArray[np.float32]
    gain: NDArray[np.float32]
    bad: NDArray[np.bool_]
    fpa_kelvin: NDArray[np.float64]
    uncorrected_counts: NDArray[np.float64]
    residual_counts: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape = self.bad.shape
        maps_fit = self.offset.ndim == self.gain.ndim == 3 and len(shape) == 2
        if not maps_fit or self.offset.shape[1:] != shape or self.gain.shape[1:] != shape:
            raise CalibrationError(
                f"offset {self.offset.shape}, gain {self.gain.shape} and bad pixels {shape} do not "
                "fit together: calibrate again"
            )
        if min(len(self.offset), len(self.gain), self.level.size) == 0:
            raise CalibrationError("the flat field has no coefficients: calibrate again")
        numbers = (self.minimum_kelvin, self.maximum_kelvin, self.centre_kelvin, self.scale_kelvin)
        finite = all(np.isfinite(part).all() for part in (self.level, self.offset, self.gain))
        if not finite or not np.isfinite(numbers).all() or self.scale_kelvin <= 0:
            raise CalibrationError(
                "the flat field holds numbers that are not finite: calibrate again"
            )
        if self.minimum_kelvin > self.maximum_kelvin:
            raise CalibrationError(
                f"the flat field's temperature range {self.minimum_kelvin:.1f} K to "
                f"{self.maximum_kelvin:.1f} K runs backwards: calibrate again"
            )
        for part in (self.level, self.offset, self.gain, self.bad):
            part.flags.writeable = False

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.bad.shape[1], self.bad.shape[0]

    def level_at(self, kelvin: float) -> float:
        """Mean count of the array at an FPA temperature."""
        t = (kelvin - self.centre_kelvin) / self.scale_kelvin
        return float(np.polynomial.polynomial.polyval(t, self.level))

    def describe(self) -> str:
        """One line for people."""
        width, height = self.size
        low, high = self.minimum_kelvin - KELVIN, self.maximum_kelvin - KELVIN
        return (
            f"flat field of camera '{self.camera or 'unnamed'}', serial "
            f"{self.serial or 'unknown'}, {width}x{height}, FPA {low:.1f} to {high:.1f} degC, "
            f"{int(self.bad.sum())} bad pixels, residual {np.median(self.residual_counts):.2f} "
            "counts (median)"
        )


@dataclass(frozen=True)
class FlatFieldStatus:
    """How the last frame was corrected; ``ok`` is false outside what was calibrated."""

    ok: bool
    text: str


class FlatField:
    """Applies a stored flat field to the raw frames of one camera.

    Args:
        calibration: the stored flat field.
        config: limits.
        camera: name for messages.
        serial: serial number of the camera, or empty when unknown.

    Raises:
        CalibrationError: when the flat field is that of another camera.
    """

    def __init__(
        self,
        calibration: FlatFieldCalibration,
        config: FlatFieldConfig | None = None,
        camera: str = "",
        serial: str = "",
    ) -> None:
        _check_owner(calibration, camera, serial)
        self._calibration = calibration
        self._config = config if config is not None else FlatFieldConfig()
        self._camera = camera
        self._bad, self._neighbours = neighbours_of_bad(calibration.bad)
        self._offset = np.zeros(calibration.bad.shape, np.float32)
        self._gain = np.ones(calibration.bad.shape, np.float32)
        self._has_gain = len(calibration.gain) > 1 or bool((calibration.gain != 1.0).any())
        self._maps_kelvin = math.nan
        self._smoothed_kelvin = math.nan
        self._last_ns = 0
        self._status = FlatFieldStatus(True, "no frame yet")

    @property
    def status(self) -> FlatFieldStatus:
        """What to tell people about the last frame."""
        return self._status

    def process(self, image: NDArray[Any], fpa_kelvin: float | None, stamp_ns: int) -> NDArray[Any]:
        """Corrected counts of a raw image; the mean level of the array stays.

        Args:
            image: (H, W) uint8 or uint16; not changed.
            fpa_kelvin: FPA temperature, or None when the camera does not tell.
            stamp_ns: stamp of the frame.

        Returns:
            (H, W) of the same type, rounded and clipped to its range.

        Raises:
            FrameError: when the image has another size than the flat field.
        """
        if image.shape != self._calibration.bad.shape:
            width, height = self._calibration.size
            raise FrameError(
                f"camera '{self._camera}' delivers {image.shape[1]}x{image.shape[0]} images but "
                f"its flat field is {width}x{height}: use the flat field of this camera and format"
            )
        self._refresh(self._temperature(fpa_kelvin, stamp_ns))
        level = self._calibration.level_at(self._maps_kelvin)
        out = np.empty(image.shape, image.dtype)
        image = np.ascontiguousarray(image)
        if self._has_gain:
            correct(image, level, self._offset, self._gain, _largest(image), out)
        else:
            subtract(image, self._offset, _largest(image), out)
        replace_bad(out, self._bad, self._neighbours)
        return out

    def _temperature(self, fpa_kelvin: float | None, stamp_ns: int) -> float:
        """Smoothed and clamped temperature; writes the status."""
        calibration = self._calibration
        if fpa_kelvin is None or not math.isfinite(fpa_kelvin):
            if math.isnan(self._smoothed_kelvin):
                self._smoothed_kelvin = calibration.centre_kelvin
            kelvin = self._smoothed_kelvin
            self._status = FlatFieldStatus(
                False,
                f"the camera tells no FPA temperature: corrected for {kelvin - KELVIN:.1f} degC",
            )
            return self._clamp(kelvin)
        weight = 1.0
        if self._config.temperature_smoothing_s > 0 and not math.isnan(self._smoothed_kelvin):
            seconds = max(0.0, (stamp_ns - self._last_ns) * 1e-9)
            weight = 1.0 - math.exp(-seconds / self._config.temperature_smoothing_s)
        if math.isnan(self._smoothed_kelvin):
            self._smoothed_kelvin = fpa_kelvin
        self._last_ns = stamp_ns
        self._smoothed_kelvin += weight * (fpa_kelvin - self._smoothed_kelvin)
        kelvin = self._clamp(self._smoothed_kelvin)
        low, high = calibration.minimum_kelvin, calibration.maximum_kelvin
        if low <= self._smoothed_kelvin <= high:
            self._status = FlatFieldStatus(True, f"FPA {self._smoothed_kelvin - KELVIN:.1f} degC")
        else:
            self._status = FlatFieldStatus(
                False,
                f"FPA {self._smoothed_kelvin - KELVIN:.1f} degC is outside the calibrated "
                f"{low - KELVIN:.1f} to {high - KELVIN:.1f} degC: corrected for "
                f"{kelvin - KELVIN:.1f} degC",
            )
        return kelvin

    def _clamp(self, kelvin: float) -> float:
        reach = self._config.extrapolation_kelvin
        low, high = self._calibration.minimum_kelvin, self._calibration.maximum_kelvin
        return min(max(kelvin, low - reach), high + reach)

    def _refresh(self, kelvin: float) -> None:
        if abs(kelvin - self._maps_kelvin) <= REFRESH_KELVIN:
            return
        calibration = self._calibration
        t = (kelvin - calibration.centre_kelvin) / calibration.scale_kelvin
        evaluate(calibration.offset, t, self._offset)
        if self._has_gain:
            evaluate(calibration.gain, t, self._gain)
        self._maps_kelvin = kelvin


@njit(cache=True, nogil=True)
def evaluate(coefficients: NDArray[np.float32], t: float, out: NDArray[np.float32]) -> None:
    """Value of (N, H, W) polynomials, rising powers, at ``t`` into ``out`` (H, W)."""
    variable = np.float32(t)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            value = coefficients[-1, y, x]
            for power in range(coefficients.shape[0] - 2, -1, -1):
                value = value * variable + coefficients[power, y, x]
            out[y, x] = value


@njit(cache=True, nogil=True)
def subtract(
    image: NDArray[Any], offset: NDArray[np.float32], largest: float, out: NDArray[Any]
) -> None:
    """``out = image - offset``, rounded and clipped to 0..largest."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            value = np.float32(image[y, x]) - offset[y, x]
            out[y, x] = int(min(max(value, 0.0), largest) + 0.5)


@njit(cache=True, nogil=True)
def correct(
    image: NDArray[Any],
    level: float,
    offset: NDArray[np.float32],
    gain: NDArray[np.float32],
    largest: float,
    out: NDArray[Any],
) -> None:
    """``out = level + (image - level - offset) gain``, rounded and clipped to 0..largest."""
    base = np.float32(level)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            value = base + (np.float32(image[y, x]) - base - offset[y, x]) * gain[y, x]
            out[y, x] = int(min(max(value, 0.0), largest) + 0.5)


def correct_reference(
    image: NDArray[Any],
    level: float,
    offset: NDArray[np.float32],
    gain: NDArray[np.float32],
    largest: float,
) -> NDArray[Any]:
    """Plain numpy twin of ``correct``, and of ``subtract`` with a gain of one."""
    base = np.float32(level)
    value = base + (image.astype(np.float32) - base - offset) * gain
    rounded: NDArray[Any] = np.floor(np.clip(value, 0, largest) + np.float32(0.5))
    return rounded.astype(image.dtype)


@njit(cache=True, nogil=True)
def replace_bad(image: NDArray[Any], bad: NDArray[np.int32], neighbours: NDArray[np.int32]) -> None:
    """Set bad pixels to the median of their valid neighbours, in place.

    Args:
        image: (H, W), changed.
        bad: (B, 2) row and column.
        neighbours: (B, 8, 2) row and column; -1 where there is none.
    """
    values = np.empty(8, np.int64)
    for index in range(bad.shape[0]):
        count = 0
        while count < 8 and neighbours[index, count, 0] >= 0:
            row, column = neighbours[index, count, 0], neighbours[index, count, 1]
            values[count] = image[row, column]
            count += 1
        if count > 0:
            ordered = np.sort(values[:count])
            middle = (ordered[(count - 1) // 2] + ordered[count // 2] + 1) // 2
            image[bad[index, 0], bad[index, 1]] = middle


def neighbours_of_bad(bad: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(B, 2) bad pixels of an (H, W) map and the (B, 8, 2) valid pixels nearest to each.

    The search widens, ring by ring, until at least three valid pixels are found.
    """
    rows, columns = np.nonzero(bad)
    neighbours = np.full((len(rows), 8, 2), -1, np.int32)
    height, width = bad.shape
    for index, (row, column) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        found: list[tuple[int, int, int]] = []
        for radius in range(1, 8):
            top, left = max(0, row - radius), max(0, column - radius)
            part = bad[top : min(height, row + radius + 1), left : min(width, column + radius + 1)]
            near = np.argwhere(~part) + np.array([top, left])
            if len(near) >= 3:
                found = sorted(
                    ((y - row) ** 2 + (x - column) ** 2, int(y), int(x)) for y, x in near
                )
                break
        for slot, (_, y, x) in enumerate(found[:8]):
            neighbours[index, slot] = y, x
    return np.column_stack([rows, columns]).astype(np.int32), neighbours


def _largest(image: NDArray[Any]) -> float:
    return float(np.iinfo(image.dtype).max)


def _check_owner(calibration: FlatFieldCalibration, camera: str, serial: str) -> None:
    if serial and calibration.serial and serial != calibration.serial:
        raise CalibrationError(
            f"the flat field belongs to the camera with serial {calibration.serial}, but camera "
            f"'{camera}' has serial {serial}: give the flat field of this camera"
        )
    if camera and calibration.camera and camera != calibration.camera:
        raise CalibrationError(
            f"the flat field was made for camera '{calibration.camera}', not for '{camera}': are "
            "left and right exchanged?"
        )
