"""What one frame and its change since the frame before say about the shutter, in a few numbers.

The image is cut into square blocks.  Flat blocks show the noise of the sensor even while the camera
moves; the busiest blocks show whether there is a scene at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

SAMPLES_PER_SIDE = 8


@dataclass(frozen=True)
class FrameStatistics:
    """Numbers of one frame, in counts unless stated.

    ``identical``: every pixel equals the frame before.  ``constant``: every pixel has one value.
    ``contrast``: spread (5th to 95th percentile) of the block means; ``texture``: 95th percentile
    of the standard deviation within a block.  ``step``: median change of the block means since the
    frame before; ``common``: the fraction of blocks that changed with it.  ``quiet`` and ``busy``:
    10th and 90th percentile of the standard deviation of the change within a block.  ``grain``:
    10th percentile of the pixel noise within a block of this frame alone, fixed pattern included.
    """

    identical: bool
    constant: bool
    contrast: float
    texture: float
    step: float
    common: float
    quiet: float
    busy: float
    grain: float


class StatisticsMaker:
    """Computes the statistics of images of one size, keeping its buffers.

    Args:
        shape: (height, width) of the images.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._stride = 2 if min(shape) >= 240 else 1
        side = self._stride * SAMPLES_PER_SIDE
        blocks = (max(1, shape[0] // side), max(1, shape[1] // side))
        self._sums = np.zeros((5, *blocks), np.float64)

    def measure(self, image: NDArray[Any], previous: NDArray[Any]) -> FrameStatistics:
        """Statistics of ``image`` (H, W) against the frame before it, of the same format."""
        samples = float(
            min(image.shape[0], SAMPLES_PER_SIDE) * min(image.shape[1], SAMPLES_PER_SIDE)
        )
        block_sums(image, previous, self._stride, self._sums)
        sums = self._sums / samples
        mean, change = sums[0].ravel(), sums[2].ravel()
        spread = np.sqrt(np.maximum(sums[1].ravel() - mean**2, 0.0))
        change_spread = np.sqrt(np.maximum(sums[3].ravel() - change**2, 0.0))
        step = float(np.median(change))
        low, high = np.percentile(mean, (5, 95))
        quiet, busy = np.percentile(change_spread, (10, 90))
        together = change * np.sign(step) > 0.3 * abs(step)
        return FrameStatistics(
            identical=same_pixels(image, previous),
            constant=one_value(image),
            contrast=float(high - low),
            texture=float(np.percentile(spread, 95)),
            step=step,
            common=float(np.mean(together)) if step else 0.0,
            quiet=float(quiet),
            busy=float(busy),
            grain=float(np.sqrt(np.percentile(sums[4], 10) / 1.5)),
        )


@njit(cache=True, nogil=True)
def block_sums(
    image: NDArray[Any], previous: NDArray[Any], stride: int, out: NDArray[np.float64]
) -> None:
    """Sums over 8x8 samples of each block.

    They are: value, value squared, change, change squared, and the squared deviation of a pixel
    from the mean of its left and right neighbours (1.5 times the variance of white noise).

    Args:
        image: (H, W) uint8 or uint16.
        previous: the same shape and type.
        stride: distance of the samples in pixels.
        out: (5, rows, columns) float64, written; values are relative to the first pixel.
    """
    origin = float(image[0, 0])
    side = stride * SAMPLES_PER_SIDE
    for row in range(out.shape[1]):
        for column in range(out.shape[2]):
            value_sum, value_squares, change_sum, change_squares, grain = 0.0, 0.0, 0.0, 0.0, 0.0
            for y in range(row * side, min((row + 1) * side, image.shape[0]), stride):
                for x in range(column * side, min((column + 1) * side, image.shape[1]), stride):
                    value = float(image[y, x])
                    change = value - float(previous[y, x])
                    value_sum += value - origin
                    value_squares += (value - origin) ** 2
                    change_sum += change
                    change_squares += change * change
                    left, right = max(x - 1, 0), min(x + 1, image.shape[1] - 1)
                    middle = 0.5 * (float(image[y, left]) + float(image[y, right]))
                    grain += (value - middle) ** 2
            out[0, row, column] = value_sum
            out[1, row, column] = value_squares
            out[2, row, column] = change_sum
            out[3, row, column] = change_squares
            out[4, row, column] = grain


def block_sums_reference(
    image: NDArray[Any], previous: NDArray[Any], stride: int, blocks: tuple[int, int]
) -> NDArray[np.float64]:
    """Plain numpy twin of ``block_sums``; the image must hold every block in full."""
    side = SAMPLES_PER_SIDE
    rows, columns = blocks
    part = (slice(0, rows * side * stride, stride), slice(0, columns * side * stride, stride))
    value = image[part].astype(np.float64) - float(image[0, 0])
    change = image[part].astype(np.float64) - previous[part].astype(np.float64)
    padded = np.pad(image.astype(np.float64), ((0, 0), (1, 1)), mode="edge")
    grain = image - 0.5 * (padded[:, :-2] + padded[:, 2:])
    planes = [value, value**2, change, change**2, grain[part] ** 2]
    tiles = [plane.reshape(rows, side, columns, side).sum(axis=(1, 3)) for plane in planes]
    return np.array(tiles)


@njit(cache=True, nogil=True)
def same_pixels(image: NDArray[Any], previous: NDArray[Any]) -> bool:
    """Whether two (H, W) images are equal; ends at the first difference."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            if image[y, x] != previous[y, x]:
                return False
    return True


@njit(cache=True, nogil=True)
def one_value(image: NDArray[Any]) -> bool:
    """Whether all pixels of an (H, W) image have one value; ends at the first difference."""
    first = image[0, 0]
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            if image[y, x] != first:
                return False
    return True
