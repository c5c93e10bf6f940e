"""Pyramids of float32 images that carry their gradients, the images direct methods compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.feature_based.image_pyramid import LEVELS, build_pyramid

GradientPyramid = tuple[NDArray[np.float32], ...]
"""``LEVELS`` arrays (H / 2^l, W / 2^l, 3) float32: brightness, d/dx and d/dy.

Pixel x of level 0 is x / 2^l of level l.
"""

_CONTRAST = 60.0
_TAILS = (16.0, 84.0)


@dataclass(frozen=True)
class BrightnessUnit:
    """What counts are measured in: brightness = (counts - offset) / unit.

    Thresholds in the literature (Engel et al., DSO, TPAMI 2018) are grey levels of a scene with a
    standard deviation of about 60; a thermal scene may span 40 counts or 4000.
    """

    offset_counts: float
    unit_counts: float

    @classmethod
    def of(
        cls, image: NDArray[np.generic], mask: NDArray[np.bool_] | None
    ) -> BrightnessUnit | None:
        """The unit in which this (H, W) image has a usual contrast; None for a flat one."""
        sample = image[::4, ::4] if mask is None else image[::4, ::4][mask[::4, ::4]]
        if sample.size < 100:
            return None
        low, high = np.percentile(sample.astype(np.float32), _TAILS)
        spread = 0.5 * float(high - low)
        if not spread > 0.0:
            return None
        return cls(0.5 * float(low + high), spread / _CONTRAST)


def build_gradient_pyramid(
    image: NDArray[np.generic],
    smoothing_px: float,
    unit: BrightnessUnit,
    room: GradientPyramid | None = None,
) -> GradientPyramid:
    """Pyramid of an (H, W) image of any depth, in brightness ``unit``.

    It is written to the arrays in ``room`` where there are some: fresh memory costs more than the
    arithmetic.
    """
    smooth = build_pyramid(image, smoothing_px)
    if room is None:
        room = tuple(np.empty((*level.shape, 3), np.float32) for level in smooth)
    offset, factor = np.float32(unit.offset_counts), np.float32(1.0 / unit.unit_counts)
    for level, out in zip(smooth, room, strict=True):
        fill_gradients(level, offset, factor, out)
    assert len(room) == LEVELS
    return room


@njit(cache=True, nogil=True)
def fill_gradients(image, offset, factor, out):  # type: ignore[no-untyped-def]
    """Write ``(image - offset) * factor`` and its central differences; 0 on the border."""
    height, width = image.shape
    half = np.float32(0.5) * factor
    for y in range(height):
        row, to = image[y], out[y]
        for x in range(width):
            to[x, 0] = (row[x] - offset) * factor
        if 0 < y < height - 1:
            above, below = image[y - 1], image[y + 1]
            for x in range(1, width - 1):
                to[x, 1] = half * (row[x + 1] - row[x - 1])
                to[x, 2] = half * (below[x] - above[x])
            for m in range(1, 3):
                to[0, m] = to[width - 1, m] = np.float32(0.0)
        else:
            to[:, 1:] = np.float32(0.0)


def gradients_reference(image: NDArray[np.float32], unit: BrightnessUnit) -> NDArray[np.float32]:
    """(H, W, 3), the plain numpy form of ``fill_gradients``."""
    value = (image - unit.offset_counts) / unit.unit_counts
    dy, dx = np.gradient(value)
    out = np.stack([value, dx, dy], axis=2)
    out[[0, -1], :, 1:] = 0.0
    out[:, [0, -1], 1:] = 0.0
    return np.asarray(out, np.float32)
