"""Loop matching: left -> right -> previous right -> previous left -> left (P1 section IV.A).

A match counts only when the loop closes on the feature it started from.  Images are rectified, so
the two stereo legs search along the row; the two temporal legs search around a predicted place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.odometry.feature_based.description import Features
from thermal_stereo_vo.odometry.feature_based.hamming import build_grid, match_in_windows
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera


@dataclass(frozen=True)
class LoopMatchingConfig:
    """Gates of the four legs."""

    row_tolerance_px: float = setting(
        1.5, "Half height of the epipolar band.", unit="px", minimum=0.1, maximum=20.0
    )
    min_disparity_px: float = setting(
        0.5,
        "Least disparity; farther points tell too little.",
        unit="px",
        minimum=0.0,
        maximum=50.0,
    )
    max_disparity_px: float = setting(
        160.0, "Largest disparity.", unit="px", minimum=4.0, maximum=2000.0
    )
    motion_radius_px: float = setting(
        40.0,
        "Search radius around the predicted place of a feature in the previous image.",
        unit="px",
        minimum=2.0,
        maximum=1000.0,
    )
    wide_motion_radius_px: float = setting(
        120.0,
        "Search radius while nothing can be predicted (start, after a gap).",
        unit="px",
        minimum=2.0,
        maximum=2000.0,
    )
    coarse_bits: int = setting(
        48,
        "Candidates that differ in more of the first 128 bits are dropped at once.",
        unit="bits",
        minimum=1,
        maximum=128,
    )
    ratio: float = setting(
        1.0,
        "Best distance over second best must be below this; 1 leaves the choice to the loop.",
        minimum=0.1,
        maximum=1.0,
    )


@dataclass(frozen=True)
class StereoFeatures:
    """Features of both eyes of one frame, bucketed for search."""

    left: Features
    right: Features
    left_grid: tuple[NDArray[np.int64], NDArray[np.int64]]
    right_grid: tuple[NDArray[np.int64], NDArray[np.int64]]
    size: tuple[int, int]

    @classmethod
    def of(cls, left: Features, right: Features, camera: Camera) -> StereoFeatures:
        """Bucket the features of two images of the camera's size."""
        return cls(
            left,
            right,
            build_grid(left.pixels, camera.width, camera.height),
            build_grid(right.pixels, camera.width, camera.height),
            camera.size,
        )


@dataclass(frozen=True)
class LoopMatches:
    """Closed loops.

    The four images' pixels, (N, 2) float32 each; ``distance`` (N,) summed bits of the four legs;
    ``index`` (N, 4) int64 into the left, right, previous right, previous left features.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    previous_left: NDArray[np.float32]
    previous_right: NDArray[np.float32]
    distance: NDArray[np.int64]
    index: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.left)

    def take(self, chosen: NDArray[np.intp]) -> LoopMatches:
        """Those at the positions ``chosen``."""
        return LoopMatches(
            self.left[chosen],
            self.right[chosen],
            self.previous_left[chosen],
            self.previous_right[chosen],
            self.distance[chosen],
            self.index[chosen],
        )


def match_loops(
    current: StereoFeatures,
    previous: StereoFeatures,
    camera: StereoCamera,
    T_previous_current: NDArray[np.float64] | None,
    config: LoopMatchingConfig,
) -> LoopMatches:
    """Find the loops between two stereo frames.

    ``T_previous_current`` (4, 4) predicts the motion, or None for a wide search around the same
    pixel.
    """
    radius_px = (
        config.wide_motion_radius_px if T_previous_current is None else config.motion_radius_px
    )
    left, right = current.left, current.right
    shift_px = camera.cx_right - camera.cx
    partner_r, bits_lr = _leg(
        left,
        _row_windows(left.pixels, config, shift_px, towards_right=True),
        right,
        current.right_grid,
        current.size,
        config,
    )
    i_l = np.flatnonzero(partner_r >= 0)
    i_r = partner_r[i_l]
    distance = bits_lr[i_l]

    centres: NDArray[np.floating] = right.pixels[i_r]
    if T_previous_current is not None:
        centres = camera.predict_right(left.pixels[i_l], right.pixels[i_r], T_previous_current)
    partner_pr, bits = _leg(
        _take(right, i_r),
        _around(centres, radius_px),
        previous.right,
        previous.right_grid,
        previous.size,
        config,
    )
    keep = partner_pr >= 0
    i_l, i_r, i_pr, distance = i_l[keep], i_r[keep], partner_pr[keep], (distance + bits)[keep]

    partner_pl, bits = _leg(
        _take(previous.right, i_pr),
        _row_windows(previous.right.pixels[i_pr], config, -shift_px, towards_right=False),
        previous.left,
        previous.left_grid,
        previous.size,
        config,
    )
    keep = partner_pl >= 0
    i_l, i_r, i_pr, i_pl = i_l[keep], i_r[keep], i_pr[keep], partner_pl[keep]
    distance = (distance + bits)[keep]

    # Back to where the loop began: the search is centred so that it mirrors the other leg.
    centres = left.pixels[i_l]
    partner_l, bits = _leg(
        _take(previous.left, i_pl),
        _around(centres, radius_px),
        left,
        current.left_grid,
        current.size,
        config,
    )
    keep = partner_l == i_l
    index = np.stack([i_l, i_r, i_pr, i_pl], axis=1)[keep]
    return LoopMatches(
        left.pixels[index[:, 0]],
        right.pixels[index[:, 1]],
        previous.left.pixels[index[:, 3]],
        previous.right.pixels[index[:, 2]],
        (distance + bits)[keep],
        index,
    )


def _leg(
    query: Features,
    windows: NDArray[np.float32],
    other: Features,
    grid: tuple[NDArray[np.int64], NDArray[np.int64]],
    size: tuple[int, int],
    config: LoopMatchingConfig,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    partner, distance = match_in_windows(
        query.descriptors,
        query.bright,
        windows,
        other.pixels,
        other.descriptors,
        other.bright,
        *grid,
        *size,
        config.coarse_bits,
        config.ratio,
    )
    return partner, distance


def _take(features: Features, index: NDArray[np.int64]) -> Features:
    return Features(
        features.pixels[index],
        features.descriptors[index],
        features.response[index],
        features.bright[index],
    )


def _row_windows(
    pixels: NDArray[np.float32],
    config: LoopMatchingConfig,
    shift_px: float,
    *,
    towards_right: bool,
) -> NDArray[np.float32]:
    """(N, 4) search bands along the row: a point lies further left in the right image.

    ``shift_px`` is where a point at infinity lies in the other image, relative to this one.
    """
    near, far = config.min_disparity_px, config.max_disparity_px
    low, high = (-far, -near) if towards_right else (near, far)
    tolerance = config.row_tolerance_px
    x, y = pixels[:, 0] + shift_px, pixels[:, 1]
    return np.stack([x + low, x + high, y - tolerance, y + tolerance], axis=1).astype(np.float32)


def _around(centres: NDArray[np.floating], radius_px: float) -> NDArray[np.float32]:
    """(N, 4) square windows."""
    x, y = centres[:, 0], centres[:, 1]
    return np.stack([x - radius_px, x + radius_px, y - radius_px, y + radius_px], axis=1).astype(
        np.float32
    )
