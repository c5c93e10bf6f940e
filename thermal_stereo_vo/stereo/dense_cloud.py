"""The points that a disparity map stands for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.stereo.dense import DisparityMap


def camera_cloud(
    disparities: DisparityMap,
    kelvin: Callable[[NDArray[Any]], NDArray[np.float32]] | None = None,
    *,
    max_range_m: float = np.inf,
    step: int = 1,
) -> PointCloud:
    """Points in axes of the rectified left camera, with its counts as intensity.

    ``kelvin`` turns counts into temperatures, where that is known.
    Points farther along the axis than ``max_range_m`` are left out, and all but every ``step``-th
    pixel of every ``step``-th row.
    """
    rows, columns, depth_m = points_of(disparities, max_range_m=max_range_m, step=step)
    camera = disparities.camera
    rays = np.column_stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(rows))]
    )
    counts = disparities.counts[rows, columns]
    return PointCloud(
        (rays * depth_m[:, None]).astype(np.float32),
        counts.astype(np.float32),
        None if kelvin is None else kelvin(counts),
    )


def points_of(
    disparities: DisparityMap, *, max_range_m: float = np.inf, step: int = 1
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Rows, columns (N,) and depths (N,) float32 (m) of the pixels that give a point."""
    depth_m = disparities.depth_m[::step, ::step]
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m <= max_range_m))
    return rows * step, columns * step, depth_m[rows, columns]
