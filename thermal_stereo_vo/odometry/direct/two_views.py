"""Motion and depths from two views far apart: where alignment with random depths does not reach."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import make_transform

_MOST_CORNERS = 800
_LEAST_POINTS = 60
_WINDOW_PX = 21
_BACK_PX = 0.7
_THRESHOLD_PX = 0.4
_LEAST_PARALLAX = 0.002
"""Median angle (rad) between the rays of a point; below it depths are noise."""


@dataclass(frozen=True)
class TwoViews:
    """``T_second_first`` (4, 4) and inverse depths ``rhos`` (N,) of first-view ``pixels`` (N, 2).

    The unit of length is such that the median inverse depth is one.
    """

    T_second_first: NDArray[np.float64]
    pixels: NDArray[np.float64]
    rhos: NDArray[np.float64]


def two_views(
    first: NDArray[np.uint8], second: NDArray[np.uint8], camera: NDArray[np.float64]
) -> TwoViews | None:
    """Follow corners of one (H, W) image into the other; None when they tell no translation.

    ``camera`` (4,) fx fy cx cy without distortion.
    """
    corners = cv2.goodFeaturesToTrack(first, _MOST_CORNERS, 0.005, 8)
    if corners is None or len(corners) < _LEAST_POINTS:
        return None
    size = (_WINDOW_PX, _WINDOW_PX)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, corners, None, winSize=size, maxLevel=5
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=size, maxLevel=5)
    steady = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < _BACK_PX
    good = (found.ravel() > 0) & (again.ravel() > 0) & steady
    if int(good.sum()) < _LEAST_POINTS:
        return None
    pixels = corners.reshape(-1, 2)[good].astype(np.float64)
    fx, fy, cx, cy = camera
    a = (pixels - [cx, cy]) / [fx, fy]
    b = (there.reshape(-1, 2)[good].astype(np.float64) - [cx, cy]) / [fx, fy]
    cv2.setRNGSeed(0)
    essential, chosen = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, _THRESHOLD_PX / fx)
    if essential is None or essential.shape != (3, 3):
        return None
    count, R, t, chosen = cv2.recoverPose(essential, a, b, np.eye(3), mask=chosen)
    if count < _LEAST_POINTS:
        return None
    keep = chosen.ravel() > 0
    a, b, pixels = a[keep], b[keep], pixels[keep]
    rays = np.column_stack([a, np.ones(len(a))]) @ R.T
    rhos = _inverse_depths(rays, t.ravel(), b)
    turned = rays[:, :2] / rays[:, 2:]
    parallax = np.median(np.linalg.norm(b - turned, axis=1))
    seen = rhos > 0.0
    if parallax < _LEAST_PARALLAX or int(seen.sum()) < _LEAST_POINTS:
        return None
    unit = float(np.median(rhos[seen]))
    return TwoViews(make_transform(R, t.ravel() * unit), pixels[seen], rhos[seen] / unit)


def _inverse_depths(
    rays: NDArray[np.float64], t: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) rho with rays + rho t along (b, 1), in least squares."""
    left = t[:2] - b * t[2]
    right = b * rays[:, 2:] - rays[:, :2]
    return np.asarray(np.sum(left * right, axis=1) / np.maximum(np.sum(left**2, axis=1), 1e-12))
