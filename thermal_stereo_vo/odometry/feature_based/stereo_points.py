"""New points for a keyframe: corners of its left image, and what its right eye says of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.feature_based.corners import CornerConfig, find_corners
from thermal_stereo_vo.odometry.feature_based.image_pyramid import Pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.feature_based.patch_alignment import (
    align_patches,
    search_disparity,
)
from thermal_stereo_vo.odometry.feature_based.patch_tracker import TrackingConfig


def find_stereo_points(
    window: KeyframeWindow,
    left: Pyramid,
    right: Pyramid,
    mask: NDArray[np.bool_] | None,
    occupied_px: NDArray[np.float64],
    max_disparity_px: float,
    corner_config: CornerConfig,
    config: TrackingConfig,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Corners of the newest keyframe away from ``occupied_px`` (M, 2), with a disparity.

    Returns (N, 2) pixels and the (N,) column at which the right eye sees each.

    The row is searched one pyramid level up, where it is cheap; alignment finds the sub-pixel.
    """
    radius = config.patch_radius_px
    corners = find_corners(left[0], occupied_px, 2 * radius + 2, mask, corner_config)
    n = len(corners)
    disparity, score = np.zeros(n, np.int64), np.zeros(n)
    # Where a point at infinity lies, when the principal points of the eyes differ.
    least = int(np.floor((window.camera.cx - window.camera.cx_right) / 2))
    most = least + int(max_disparity_px) // 2
    search_disparity(left[1], right[1], corners // 2, radius, least, most, disparity, score)
    start = corners.astype(np.float64)
    start[:, 0] -= 2.0 * disparity
    start[score < config.min_correlation] = np.nan
    found_px, found_score = np.empty((n, 2)), np.empty(n)
    align_patches(
        window.images.stacks,
        right,
        np.full(n, window.newest, np.int64),
        corners.astype(np.float64),
        np.tile(np.eye(2), (n, 1, 1)),
        start,
        1,
        radius,
        config.alignment_iterations,
        found_px,
        found_score,
    )
    good = found_score >= config.min_correlation
    good &= np.abs(found_px[:, 1] - corners[:, 1]) < config.row_tolerance_px
    # Further from the searched column than its own uncertainty: another texture caught it.
    good &= np.abs(found_px[:, 0] - start[:, 0]) < 4.0
    return corners[good], found_px[good, 0]
