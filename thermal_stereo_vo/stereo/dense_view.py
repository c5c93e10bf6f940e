"""The 8-bit view for matching: counts that are weak against noise, made equally strong everywhere.

A gain control for people spends its grey levels on the whole picture.  A matcher needs the few
counts that tell one spot of a road from the next, and must not see noise as texture.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_SIGMA_OF_MEDIAN = 1.0 / 0.6745
_ROUNDING = 12.0**-0.5
_SAMPLED = 4
_DRAWN_OUT_PX = 12
"""How far a match reaches beyond the edge it was made on: half of all windows together."""
_GREY, _GAIN = 128.0, 32.0


def smoothed(image: NDArray[Any], sigma_px: float) -> NDArray[np.float32]:
    """(H, W) float32 counts without single bad pixels, blurred by a Gaussian (0: not at all)."""
    if image.dtype not in (np.uint8, np.uint16):
        image = image.astype(np.float32)
    counts = cv2.medianBlur(image, 3).astype(np.float32)
    if sigma_px > 0.0:
        counts = cv2.GaussianBlur(counts, (0, 0), sigma_px)
    return np.asarray(counts, np.float32)


def fine_noise(image: NDArray[Any]) -> float:
    """Standard deviation (counts) of what changes from pixel to pixel, at least a rounding error.

    J. Immerkaer, Fast noise variance estimation (CVIU 1996), with a median instead of the mean so
    that edges do not count.  Rectification averages neighbours, so this is a lower bound of the
    sensor's noise; rows and columns of a fixed pattern do not enter.
    """
    high = cv2.filter2D(image.astype(np.float32), cv2.CV_32F, _LAPLACIAN)
    high = high[1:-1:_SAMPLED, 1:-1:_SAMPLED]
    sigma = float(np.median(np.abs(high))) * _SIGMA_OF_MEDIAN / 6.0
    return max(sigma, _ROUNDING)


def matching_view(
    counts: NDArray[np.float32], window_px: int, floor_counts: float
) -> NDArray[np.uint8]:
    """(H, W) uint8: difference to the local mean in units of the local deviation.

    ``counts`` (H, W) float32; ``window_px`` the width of the square window.  ``floor_counts`` is
    added (in squares) to the deviation, so that noise on a flat surface stays grey.
    """
    box = (window_px, window_px)
    detail = counts - cv2.blur(counts, box)
    deviation = cv2.blur(cv2.multiply(detail, detail), box)
    deviation += np.float32(floor_counts * floor_counts)
    cv2.sqrt(np.maximum(deviation, 1e-6), dst=deviation)
    cv2.divide(detail, deviation, dst=detail, scale=_GAIN)
    return np.asarray(cv2.add(detail, _GREY, dtype=cv2.CV_8U), np.uint8)


def sky(
    disparity_px: NDArray[np.float32], counts: NDArray[np.float32], contrast_counts: float
) -> NDArray[np.bool_]:
    """(H, W) True where matches are those of an edge nearby, drawn out into empty sky.

    ``disparity_px`` (H, W) is NaN where nothing was matched, ``counts`` (H, W) float32.  Sky begins
    as an area without matches that reaches the upper border; around it goes whatever has a local
    deviation below ``contrast_counts``.
    """
    empty = np.isnan(disparity_px).astype(np.uint8)
    labels = cv2.connectedComponents(empty, connectivity=4, ltype=cv2.CV_32S)[1]
    open_above = np.unique(labels[0])
    area = np.isin(labels, open_above[open_above > 0]).astype(np.uint8)
    reach = np.ones((2 * _DRAWN_OUT_PX + 1, 2 * _DRAWN_OUT_PX + 1), np.uint8)
    around = cv2.dilate(area, reach).astype(np.bool_)
    detail = counts - cv2.blur(counts, (9, 9))
    # Running sums may end a rounding error below zero.
    deviation = np.sqrt(np.maximum(cv2.blur(cv2.multiply(detail, detail), (5, 5)), 0.0))
    return np.asarray(around & (deviation < contrast_counts), np.bool_)
