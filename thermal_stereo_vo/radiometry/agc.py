"""Automatic gain control: linear counts to the 8-bit view, one mapping for both eyes of a band.

The view is a branch of the way of the data: linear counts stay as they are beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.radiometry import transfer

SAMPLES_PER_EYE = 40_000
LOST_FRACTION = 0.9
"""A mapping that shows more than this of an eye as plain black or white is given up at once."""
FREEZE_FRAMES = 90
"""A camera that is away for longer no longer holds the mapping."""


@dataclass(frozen=True)
class AgcConfig:
    """How linear counts become the 8-bit view."""

    mode: str = setting(
        "auto",
        "Kind of mapping; auto shows 8-bit images as they are and maps all others by plateau.",
        choices=("auto", "plateau", "linear"),
    )
    damping: int = setting(
        16,
        "FLIR's AGC filter coefficient a: new curve = a/256 of this frame + (256-a)/256 of the old "
        "curve. 1 is the slowest; see firmware for 0 and 255.",
        minimum=0,
        maximum=255,
    )
    firmware: str = setting(
        "tau_2_7",
        "Meaning of the ends of damping: from Tau 2.7 on 255 is immediate and 0 holds the first "
        "curve for ever; earlier firmware takes 0 as immediate and has no hold.",
        choices=("tau_2_7", "earlier"),
    )
    plateau: int = setting(
        150,
        "Cap of a histogram bin before equalisation; low is nearly linear.",
        unit="pixels per count of a 640x512 image",
        minimum=1,
        maximum=100_000,
    )
    tail_percent: float = setting(
        0.5,
        "Part of the pixels rejected at either end of the histogram.",
        unit="%",
        minimum=0.0,
        maximum=25.0,
    )
    max_gain: float = setting(
        4.0,
        "Steepest mapping; keeps the noise of a bland scene from filling the range.",
        unit="grey levels per count",
        minimum=0.001,
        maximum=255.0,
    )
    midpoint: float = setting(
        127.0,
        "Grey level of the middle of the counts.",
        unit="grey levels",
        minimum=0.0,
        maximum=255.0,
    )
    roi: tuple[float, ...] = setting(
        (0.0, 0.0, 1.0, 1.0),
        "Part of the image that makes the histogram, as fractions left, top, right, bottom; a top "
        "of 0.4 leaves the sky out.",
    )
    roi_polygon: tuple[float, ...] = setting(
        (),
        "Polygon in place of the rectangle, as fractions x0, y0, x1, y1, x2, y2, ...",
    )


def damping_weight(damping: int, firmware: str) -> float:
    """The part of a new curve that enters at once, 0..1, for FLIR's coefficient 0..255.

    FLIR 102-PS242-100-01: ``n' = n a/256 + n'_prev (256 - a)/256``.  Tau 2.7 reads 255 as
    immediate and 0 as frozen; earlier Tau and Tau 2 read 0 as immediate.
    """
    if firmware == "tau_2_7":
        return 1.0 if damping == 255 else damping / 256.0
    return 1.0 if damping == 0 else damping / 256.0


class AutomaticGain:
    """Fills the ``display`` of every view of a rig frame.

    The cameras ``left`` and ``right`` share one mapping; any other role is a band of its own.  The
    mapping holds still while a camera of its band is blind and starts anew once a correction has
    changed the offsets.

    Raises:
        ConfigError: for a region of interest that is none.
    """

    def __init__(self, config: AgcConfig | None = None) -> None:
        self._config = config if config is not None else AgcConfig()
        self._weight = damping_weight(self._config.damping, self._config.firmware)
        self._polygon = _region(self._config)
        self._regions: dict[tuple[int, ...], NDArray[np.bool_]] = {}
        self._bands: dict[str, _Band] = {}

    def reset(self) -> None:
        """Forget every mapping; the next frame makes its own."""
        self._bands.clear()

    def warm_up(self) -> None:
        """Compile the kernels for every type of image."""
        curve = np.zeros(transfer.COUNTS, np.float32)
        for dtype in (np.uint8, np.uint16, np.float32):
            image = _contiguous(np.zeros((4, 4), dtype))
            everywhere = _contiguous(np.ones((4, 4), np.bool_))
            histogram = np.zeros(transfer.COUNTS, np.int64)
            transfer.add_to_histogram(image, everywhere, everywhere, 1, histogram)
            transfer.apply_curve(image, curve, np.empty((4, 4), np.uint8))
        self._fill(histogram, curve)
        transfer.saturated_fraction(histogram, curve)

    def curve(self, role: str) -> NDArray[np.float32] | None:
        """(65536,) grey level of each count for this camera's band, or None before any frame."""
        band = self._bands.get(_band_of(role))
        return None if band is None or band.curve is None else band.curve.copy()

    def process(self, frame: RigFrame) -> RigFrame:
        """The same frame with ``display`` set in every view: (H, W) uint8.  Never raises."""
        views = dict(frame.views)
        for name in sorted({_band_of(role) for role in views}):
            roles = [role for role in views if _band_of(role) == name]
            mapped = [role for role in roles if not self._is_display(views[role])]
            blind = any(_band_of(role) == name for role in frame.blind)
            band = self._bands.setdefault(name, _Band())
            if mapped:
                self._update(band, {role: views[role] for role in mapped}, blind)
            for role in roles:
                view = views[role]
                shown = view.image if role not in mapped else band.show(view.image)
                views[role] = replace(view, display=shown)
        return replace(frame, views=views)

    def _is_display(self, view: CameraView) -> bool:
        return self._config.mode == "auto" and view.image.dtype == np.uint8

    def _update(self, band: _Band, views: dict[str, CameraView], blind: bool) -> None:
        epochs = {role: view.epoch for role, view in views.items()}
        corrected = any(band.epochs.get(role, epoch) != epoch for role, epoch in epochs.items())
        missing = blind or not band.epochs.keys() <= epochs.keys()
        band.epochs.update(epochs)
        band.frozen_frames = band.frozen_frames + 1 if missing else 0
        held = missing and band.frozen_frames <= FREEZE_FRAMES

        total = np.zeros(transfer.COUNTS, np.int64)
        lost = False
        for view in views.values():
            histogram = self._histogram(view)
            total += histogram
            if band.curve is not None:
                lost |= transfer.saturated_fraction(histogram, band.curve) > LOST_FRACTION
        if not total.any():
            return
        if band.curve is not None and held and not (lost or corrected):
            return
        curve = np.empty(transfer.COUNTS, np.float32)
        self._fill(total, curve)
        if band.curve is None or lost or corrected:
            band.curve = curve
        else:
            weight = np.float32(self._weight)
            band.curve += weight * (curve - band.curve)

    def _fill(self, histogram: NDArray[np.int64], curve: NDArray[np.float32]) -> None:
        config = self._config
        tail, gain, middle = config.tail_percent / 100.0, config.max_gain, config.midpoint
        if config.mode == "linear":
            transfer.linear_curve(histogram, tail, gain, middle, curve)
        else:
            transfer.plateau_curve(histogram, float(config.plateau), tail, gain, middle, curve)

    def _histogram(self, view: CameraView) -> NDArray[np.int64]:
        histogram = np.zeros(transfer.COUNTS, np.int64)
        image = _contiguous(view.image)
        region = self._region_of(image.shape)
        step = max(1, int(np.sqrt(image.size / SAMPLES_PER_EYE)))
        mask = region if view.mask is None else _contiguous(view.mask)
        if mask.shape != image.shape:
            mask = region
        transfer.add_to_histogram(image, region, mask, step, histogram)
        return histogram

    def _region_of(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        if shape not in self._regions:
            height, width = shape
            corners = np.round(self._polygon * (width, height) - 0.5).astype(np.int32)
            canvas = np.zeros(shape, np.uint8)
            cv2.fillPoly(canvas, [corners], 1)
            self._regions[shape] = _contiguous(canvas.astype(np.bool_))
        return self._regions[shape]


@dataclass
class _Band:
    """The mapping of cameras that see the same wavelengths."""

    curve: NDArray[np.float32] | None = None
    epochs: dict[str, int] = field(default_factory=dict)
    frozen_frames: int = 0

    def show(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        shown = np.zeros(image.shape, np.uint8)
        if self.curve is not None:
            transfer.apply_curve(_contiguous(image), self.curve, shown)
        return shown


def _band_of(role: str) -> str:
    return "stereo" if role in (LEFT, RIGHT) else role


def _region(config: AgcConfig) -> NDArray[np.float64]:
    """(N, 2) corners of the region of interest in fractions of width and height."""
    if config.roi_polygon:
        numbers: Sequence[float] = config.roi_polygon
        if len(numbers) < 6 or len(numbers) % 2 or not _are_fractions(numbers):
            raise ConfigError(
                f"roi_polygon = {list(numbers)}: give at least three corners as x0, y0, x1, y1, "
                "x2, y2 in fractions 0..1 of width and height"
            )
        return np.array(numbers, np.float64).reshape(-1, 2)
    roi = config.roi
    if len(roi) != 4 or not _are_fractions(roi) or roi[0] >= roi[2] or roi[1] >= roi[3]:
        raise ConfigError(
            f"roi = {list(roi)}: give left, top, right, bottom in fractions 0..1 with left < right "
            "and top < bottom; [0, 0, 1, 1] is the whole image"
        )
    left, top, right, bottom = roi
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]], np.float64)


def _are_fractions(numbers: Sequence[float]) -> bool:
    return all(isinstance(number, (int, float)) and 0.0 <= number <= 1.0 for number in numbers)


def _contiguous(array: NDArray[Any]) -> NDArray[Any]:
    """The same array in one piece and read-only, so that each kernel is compiled once per type."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array
