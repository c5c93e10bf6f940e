"""Sub-pixel disparity and its standard deviation, from linear counts.

Semi-global matching interpolates between integer costs, which draws slanted surfaces towards whole
pixels and says nothing of the error.  One Gauss-Newton step of the sum of squared differences on
the rectified pair (B. Lucas and T. Kanade, 1981, along the row only) does both.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

LARGEST_STEP_PX = 0.75
_INDEPENDENT = 12.0
"""Pixels that share their noise after rectification and smoothing."""


class Refined(NamedTuple):
    """``disparity_px`` and ``sigma_px`` (H, W) float32, NaN where there was no disparity.

    ``noise_counts`` is the standard deviation of one image, as the differences show it.
    """

    disparity_px: Map
    sigma_px: Map
    noise_counts: float


class Refinement:
    """Keeps the pixel grid of one image size."""

    def __init__(self, height: int, width: int, window_px: int) -> None:
        self._x, self._y = np.meshgrid(
            np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
        )
        self._box = (window_px, window_px)
        self._independent = window_px * window_px / _INDEPENDENT

    def refine(self, disparity_px: Map, left: Map, right: Map) -> Refined:
        """Improve a disparity map.

        ``disparity_px`` (H, W) float32, NaN where unknown; ``left`` and ``right`` (H, W) float32
        counts.  Every pixel of a window is compared at its own disparity, so windows may lie
        across edges and slopes; what they share is the correction.  A difference in level between
        the cameras does not matter.
        """
        known = np.isfinite(disparity_px)
        weight = known.astype(np.float32)
        start = np.where(known, disparity_px, np.float32(0.0))
        seen_at = self._x - start
        warped = cv2.remap(right, seen_at, self._y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        slope = 0.5 * (_slope(left) + _slope(warped)) * weight
        difference = (warped - left) * weight
        share = cv2.blur(weight, self._box) + np.float32(1e-6)
        mean_slope = self._mean(slope, share)
        mean_difference = self._mean(difference, share)
        slopes = self._mean(slope * slope, share) - mean_slope * mean_slope
        both = self._mean(slope * difference, share) - mean_slope * mean_difference
        differences = self._mean(difference * difference, share) - mean_difference**2
        slopes = np.maximum(slopes, np.float32(1e-6))
        noise = np.maximum(differences - both * both / slopes, 0.0)
        typical = np.float32(np.median(noise[known][::16])) if known.any() else np.float32(1.0)
        noise = np.maximum(noise, typical)
        # A prior of one pixel keeps steps small where the counts say nothing.
        step = both / (slopes + noise / np.float32(self._independent))
        np.clip(step, -LARGEST_STEP_PX, LARGEST_STEP_PX, out=step)
        sigma = np.sqrt(noise / (slopes * share * np.float32(self._independent)))
        unknown = np.float32(np.nan)
        return Refined(
            np.where(known, start + step, unknown),
            np.where(known, sigma, unknown),
            float(np.sqrt(typical / 2.0)),
        )

    def _mean(self, values: Map, share: Map) -> Map:
        """Mean over the known pixels of each window."""
        return np.asarray(cv2.blur(values, self._box) / share, np.float32)


def _slope(counts: Map) -> Map:
    """Counts per pixel along the row."""
    return np.asarray(cv2.Sobel(counts, cv2.CV_32F, 1, 0, ksize=3, scale=0.125), np.float32)
