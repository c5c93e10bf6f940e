"""Which pixels become points: steep ones, spread over the image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.odometry.feature_based.corners import pick_corners

_BORDER_PX = 6
_LEAST_CELL_PX = 8


@dataclass(frozen=True)
class SelectionConfig:
    """How many points there are and how they spread."""

    points: int = setting(500, "Points the keyframes keep in sight.", minimum=100, maximum=5000)
    block_px: int = setting(
        32, "Side of the blocks whose median gradient counts.", unit="px", minimum=8, maximum=500
    )
    min_gradient: float = setting(
        7.0,
        "A point is steeper than the median of its surroundings by this much; a scene has a "
        "standard deviation of 60.",
        minimum=0.0,
        maximum=100.0,
    )


def select_points(
    image: NDArray[np.float32],
    occupied_px: NDArray[np.float64],
    mask: NDArray[np.bool_] | None,
    config: SelectionConfig,
    factor: float = 1.0,
) -> NDArray[np.int64]:
    """(N, 2) pixels of ``image`` (H, W, 3): steepest of each cell without ``occupied_px`` (M, 2).

    There are ``factor`` times as many cells as points wanted, in the whole image one in each.
    As in DSO (Engel et al., TPAMI 2018) the threshold is the median gradient of the surroundings
    and a constant, so that weak parts of the image get points too and noise does not.
    """
    steepness = np.hypot(image[..., 1], image[..., 2])
    steepness[steepness < _threshold(steepness, config)] = 0.0
    height, width = steepness.shape
    cell_px = max(_LEAST_CELL_PX, math.ceil(math.sqrt(height * width / (factor * config.points))))
    everywhere = np.ones((1, 1), np.bool_)
    everywhere.flags.writeable = False
    chosen: NDArray[np.int64] = pick_corners(
        steepness,
        np.ascontiguousarray(occupied_px, np.float64).reshape(-1, 2),
        everywhere if mask is None else mask,
        cell_px,
        1,
        _BORDER_PX,
    )
    return chosen


def _threshold(steepness: NDArray[np.float32], config: SelectionConfig) -> NDArray[np.float32]:
    """(H, W) least steepness: block medians, averaged with those around, and a constant."""
    import cv2

    height, width = steepness.shape
    block = config.block_px
    rows, columns = height // block, width // block
    if rows == 0 or columns == 0:
        return np.full(steepness.shape, np.median(steepness) + config.min_gradient, np.float32)
    blocks = steepness[: rows * block, : columns * block].reshape(rows, block, columns, block)
    # A quarter of the pixels tells the median well enough.
    medians = np.median(blocks[:, ::2, :, ::2], axis=(1, 3)).astype(np.float32)
    smooth = cv2.blur(medians, (3, 3), borderType=cv2.BORDER_REPLICATE)
    smooth = np.atleast_2d(smooth)
    wide = np.repeat(np.repeat(smooth, block, axis=0), block, axis=1)
    wide = np.pad(wide, ((0, height - wide.shape[0]), (0, width - wide.shape[1])), mode="edge")
    return np.asarray(wide + config.min_gradient, np.float32)
