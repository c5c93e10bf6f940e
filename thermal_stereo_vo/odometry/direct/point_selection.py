"""Which pixels become points: steep ones, spread over the image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.odometry.feature_based.corners import pick_corners

_BORDER_PX = 6
_LEAST_CELL_PX = 8
_ENOUGH = 0.7
"""Share of the points wanted with which nothing is divided again."""
_LEAST_SHRINKING = 0.5
"""Finer cells have at least this share of the side: a small spot is not filled at any price."""


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

    There are ``factor`` times as many cells as points wanted, in the whole image one in each; where
    much of the image shows nothing, the rest is divided into smaller ones.  As in DSO (Engel et
    al., TPAMI 2018) the threshold is the median gradient of the surroundings and a constant, so
    that weak parts of the image get points too and noise does not.
    """
    steepness: NDArray[np.float32] = np.empty(image.shape[:2], np.float32)
    fill_steepness(image, steepness)
    clear_below(steepness, *_least_by_block(steepness, config))
    height, width = steepness.shape
    wanted = factor * config.points
    cell_px = max(_LEAST_CELL_PX, math.ceil(math.sqrt(height * width / wanted)))
    everywhere = np.ones((1, 1), np.bool_)
    everywhere.flags.writeable = False
    allowed = everywhere if mask is None else mask
    occupied_px = np.ascontiguousarray(occupied_px, np.float64).reshape(-1, 2)
    chosen: NDArray[np.int64] = pick_corners(
        steepness, occupied_px, allowed, cell_px, 1, _BORDER_PX
    )
    share = (len(occupied_px) + len(chosen)) / wanted
    if share > _ENOUGH:
        return chosen
    cell_px = max(_LEAST_CELL_PX, math.ceil(cell_px * max(math.sqrt(share), _LEAST_SHRINKING)))
    more: NDArray[np.int64] = pick_corners(
        steepness, np.concatenate([occupied_px, chosen]), allowed, cell_px, 1, _BORDER_PX
    )
    return np.concatenate([chosen, more])


def _least_by_block(
    steepness: NDArray[np.float32], config: SelectionConfig
) -> tuple[NDArray[np.float32], int]:
    """Least steepness of each block, and its side.

    Medians of blocks, averaged with those around, and a constant; (1, 1) where not one block fits.
    """
    import cv2

    height, width = steepness.shape
    block = config.block_px
    rows, columns = height // block, width // block
    if rows == 0 or columns == 0:
        least = np.full((1, 1), np.median(steepness) + config.min_gradient, np.float32)
        return least, max(height, width)
    blocks = steepness[: rows * block, : columns * block].reshape(rows, block, columns, block)
    # A sixteenth of the pixels tells the median well enough.
    some = blocks[:, ::4, :, ::4].transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    medians = np.median(some, axis=2).astype(np.float32)
    smooth = np.atleast_2d(cv2.blur(medians, (3, 3), borderType=cv2.BORDER_REPLICATE))
    return np.asarray(smooth + config.min_gradient, np.float32), block


@njit(cache=True, nogil=True)
def fill_steepness(image, out):  # type: ignore[no-untyped-def]
    """Write the size of the gradient of (H, W, 3) to ``out`` (H, W)."""
    for y in range(image.shape[0]):
        row, to = image[y], out[y]
        for x in range(image.shape[1]):
            to[x] = np.sqrt(row[x, 1] * row[x, 1] + row[x, 2] * row[x, 2])


@njit(cache=True, nogil=True)
def clear_below(steepness, least, block):  # type: ignore[no-untyped-def]
    """Set to 0 what is less than ``least`` (rows, columns) of its block; the last are wider."""
    for y in range(steepness.shape[0]):
        row, limits = steepness[y], least[min(y // block, least.shape[0] - 1)]
        for x in range(steepness.shape[1]):
            if row[x] < limits[min(x // block, least.shape[1] - 1)]:
                row[x] = np.float32(0.0)
