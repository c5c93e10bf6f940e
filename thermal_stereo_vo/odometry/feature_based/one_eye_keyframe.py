"""Keyframes while one eye is blind: new points whose depth is guessed from their neighbours'.

When the rig turns, the points that both eyes had seen leave the picture within a second.  What the
seeing eye finds instead fixes the attitude at once; its depth follows from the motion, and from
the other eye once that sees again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thermal_stereo_vo.core.transforms import exp_so3, make_transform
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.feature_based.patch_tracker import Tracked

NEIGHBOURS = 5
LEAST_SPREAD = 0.3
"""An inverse depth is guessed at best to this share of itself (1 sigma)."""


def right_eye_pose(window: KeyframeWindow) -> NDArray[np.float64]:
    """(4, 4) T_right_left, with what is known of the extrinsics beyond the calibration."""
    rotation = exp_so3(window.right_turn_rad)
    return make_transform(rotation, rotation @ [-window.camera.baseline_m, 0.0, 0.0])


def seen_by_one_eye(observed: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) observations of a pair with one blind eye as those of a left eye alone."""
    alone = observed.copy()
    blind_left = np.isnan(observed[:, 0])
    alone[blind_left, :2] = observed[blind_left, 2:]
    alone[:, 2:] = np.nan
    return alone


def known_inverse_depths(
    window: KeyframeWindow, tracked: Tracked, T_eye_world: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) at which the only eye saw points, and their inverse depths (N,) 1/m there."""
    inliers = np.flatnonzero(tracked.inliers)
    points_m = window.positions_m(tracked.points.take(inliers))
    z_m = points_m @ T_eye_world[2, :3] + T_eye_world[2, 3]
    pixels = seen_by_one_eye(tracked.observed[inliers])[:, :2]
    usable = (z_m > 1e-3) & np.all(np.isfinite(pixels), axis=1)
    return pixels[usable], 1.0 / z_m[usable]


def guess_inverse_depths(
    known_px: NDArray[np.float64], known_rhos: NDArray[np.float64], pixels: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverse depths (N,) of pixels (N, 2) and their standard deviations (N,), both in 1/m.

    They are the medians of the nearest of the known ones, (M,) at (M, 2) px.
    """
    neighbours = min(NEIGHBOURS, len(known_rhos))
    _, nearest = cKDTree(known_px).query(pixels, k=neighbours)
    around = known_rhos[np.reshape(nearest, (len(pixels), neighbours))]
    guessed = np.median(around, axis=1)
    spread = np.median(np.abs(around - guessed[:, None]), axis=1)
    return guessed, np.maximum(1.4826 * spread, LEAST_SPREAD * guessed)
