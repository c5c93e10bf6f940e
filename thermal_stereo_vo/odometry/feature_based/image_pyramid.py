"""Smoothed float32 pyramids of linear counts, the images that patches are aligned on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

LEVELS = 4
_KERNEL_SIGMAS = 2.5

Pyramid = tuple[NDArray[np.float32], ...]
"""``LEVELS`` images (H / 2^l, W / 2^l) float32.  Pixel x of level 0 is x / 2^l of level l."""


def build_pyramid(image: NDArray[np.generic], smoothing_px: float) -> Pyramid:
    """Pyramid of an (H, W) image of any depth.

    ``smoothing_px`` is the sigma of the Gaussian before level 0; it takes off noise, and with it
    the error that bilinear interpolation makes on detail of one pixel.
    """
    base = image.astype(np.float32)
    if smoothing_px > 0.0:
        side = 2 * int(np.ceil(_KERNEL_SIGMAS * smoothing_px)) + 1
        base = cv2.GaussianBlur(base, (side, side), smoothing_px)
    levels = [base]
    while len(levels) < LEVELS:
        levels.append(cv2.pyrDown(levels[-1]))
    return tuple(levels)


class KeyframeImages:
    """Pyramids of the left images of all keyframes of a window, stacked for the kernels.

    ``stacks`` holds, for each level, an array (slots, H, W) float32.
    """

    def __init__(self, slots: int, shape: tuple[int, int]) -> None:
        height, width = shape
        stacks = []
        for _ in range(LEVELS):
            stacks.append(np.zeros((slots, height, width), np.float32))
            height, width = (height + 1) // 2, (width + 1) // 2
        self.stacks = tuple(stacks)

    def store(self, slot: int, pyramid: Pyramid) -> None:
        """Copy a pyramid into a slot."""
        for stack, level in zip(self.stacks, pyramid, strict=True):
            stack[slot] = level
