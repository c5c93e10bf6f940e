"""Depth of new points from the other eye of a rectified pair."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.direct.gradient_pyramid import GradientPyramid
from thermal_stereo_vo.odometry.feature_based.patch_alignment import search_disparity

RADIUS = 4
_MIN_CORRELATION = 0.7
_SEARCH_LEVEL = 1


def find_disparities(
    left: GradientPyramid,
    right: GradientPyramid,
    pixels: NDArray[np.int64],
    least_px: float,
    most_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Disparity (N,) px of the (N, 2) left pixels, NaN where there is none, and correlation (N,).

    The row is searched one pyramid level up, where it is cheap; a one-dimensional alignment finds
    the sub-pixel.
    """
    n = len(pixels)
    coarse, score = np.zeros(n, np.int64), np.zeros(n)
    scale = 1 << _SEARCH_LEVEL
    search_disparity(
        np.ascontiguousarray(left[_SEARCH_LEVEL][..., 0]),
        np.ascontiguousarray(right[_SEARCH_LEVEL][..., 0]),
        pixels // scale,
        RADIUS,
        int(np.floor(least_px / scale)),
        int(most_px) // scale,
        coarse,
        score,
    )
    start = scale * coarse.astype(np.float64)
    start[score < _MIN_CORRELATION] = np.nan
    disparity, score = np.full(n, np.nan), np.full(n, -1.0)
    align_rows(left[0], right[0], pixels, start, RADIUS, disparity, score)
    wrong = (score < _MIN_CORRELATION) | (np.abs(disparity - start) > 1.5 * scale)
    disparity[wrong] = np.nan
    return disparity, score


@njit(cache=True, nogil=True)
def align_rows(left, right, pixels, start, radius, disparity, score):  # type: ignore[no-untyped-def]
    """Refine disparities by Gauss-Newton on squares of side 2 radius + 1, means and gains out.

    ``left``, ``right`` (H, W, 3); ``pixels`` (N, 2) int64; ``start`` (N,) px, NaN to skip.  Writes
    ``disparity`` (N,) and its correlation ``score`` (N,), -1 where none was found.
    """
    height, width = left.shape[0], left.shape[1]
    side = 2 * radius + 1
    count = side * side
    a, b, d = np.empty(count), np.empty(count), np.empty(count)
    for n in range(len(pixels)):
        score[n] = -1.0
        x, y = pixels[n, 0], pixels[n, 1]
        if not np.isfinite(start[n]):
            continue
        if not (radius <= x < width - radius and radius <= y < height - radius):
            continue
        mean_a, energy_a = 0.0, 0.0
        for j in range(side):
            for i in range(side):
                a[j * side + i] = left[y + j - radius, x + i - radius, 0]
                mean_a += a[j * side + i]
        mean_a /= count
        for k in range(count):
            a[k] -= mean_a
            energy_a += a[k] * a[k]
        found = start[n]
        for _ in range(10):
            u = x - found
            if not (u - radius >= 1.0 and u + radius < width - 2.0 and energy_a > 0.0):
                score[n] = -1.0
                break
            first = int(u)
            f = u - first
            mean_b, mean_d = 0.0, 0.0
            for j in range(side):
                row = right[y + j - radius]
                for i in range(side):
                    k = j * side + i
                    at = first + i - radius
                    b[k] = (1.0 - f) * row[at, 0] + f * row[at + 1, 0]
                    d[k] = (1.0 - f) * row[at, 1] + f * row[at + 1, 1]
                    mean_b += b[k]
                    mean_d += d[k]
            mean_b /= count
            mean_d /= count
            energy_b, cross, h = 0.0, 0.0, 0.0
            for k in range(count):
                b[k] -= mean_b
                d[k] -= mean_d
                energy_b += b[k] * b[k]
                cross += a[k] * b[k]
                h += d[k] * d[k]
            if not (energy_b > 0.0 and h > 0.0):
                score[n] = -1.0
                break
            score[n] = cross / np.sqrt(energy_a * energy_b)
            gain = np.sqrt(energy_b / energy_a)
            right_side = 0.0
            for k in range(count):
                right_side += d[k] * (gain * a[k] - b[k])
            move = right_side / h
            found -= move
            disparity[n] = found
            if abs(move) < 1e-2:
                break
        if score[n] < 0.0:
            disparity[n] = np.nan
