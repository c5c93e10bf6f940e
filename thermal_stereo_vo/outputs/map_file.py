"""The semi-dense map of a run of two bands as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.point_cloud_file import write_ply

CELL_OF_EXTENT = 1.0 / 1000.0
TAIL_PERCENT = (1.0, 99.0)
COLOUR_PERCENT = (2.0, 98.0)


class MapFile(Observer):
    """Gathers the points at each keyframe; ``close`` writes ``map.ply`` if two bands saw them.

    Of several points in a small cube (a thousandth of the extent) the last one stays.  Where the
    scale was ever known only points in metres are left, as of the trajectory; where it never was,
    all are, in their arbitrary unit.  Red is thermal, green and blue are visible.
    """

    wants_points = True

    def __init__(self, path: Path) -> None:
        self._path = path
        self._clouds: list[PointCloud] = []
        self._result: OdometryResult | None = None
        self._metric_only = False

    def on_result(self, result: OdometryResult) -> None:
        if result.is_metric and not self._metric_only:
            self._metric_only = True
            self._clouds.clear()
        self._result = result

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        result = self._result
        if result is None or not result.stats.keyframe:
            return
        fits_in = result.is_metric or not self._metric_only
        if fits_in and cloud.thermal_counts is not None and len(cloud.xyz):
            self._clouds.append(cloud)

    def close(self) -> None:
        if not self._clouds:
            return
        cloud = thinned(joined(self._clouds))
        write_ply(self._path, cloud, rgb=two_band_colours(cloud))


def joined(clouds: list[PointCloud]) -> PointCloud:
    """Clouds of two bands as one; points that are not finite are left out."""
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    intensity = np.concatenate([cloud.intensity for cloud in clouds])
    thermal = np.concatenate([_counts(cloud) for cloud in clouds])
    known = np.all(np.isfinite(xyz), axis=1)
    return PointCloud(xyz[known], intensity[known], thermal_counts=thermal[known])


def thinned(cloud: PointCloud) -> PointCloud:
    """One point, the last, for each small cube."""
    if len(cloud.xyz) == 0:
        return cloud
    low, high = np.percentile(cloud.xyz, TAIL_PERCENT, axis=0)
    cell = max(float(np.max(high - low)) * CELL_OF_EXTENT, 1e-9)
    cubes = np.rint((cloud.xyz - low) / cell).astype(np.int64)
    _, last = np.unique(cubes[::-1], axis=0, return_index=True)
    kept = np.sort(len(cubes) - 1 - last)
    return PointCloud(cloud.xyz[kept], cloud.intensity[kept], thermal_counts=_counts(cloud)[kept])


def two_band_colours(cloud: PointCloud) -> NDArray[np.uint8]:
    """(N, 3) RGB: red is thermal, green and blue visible; black where a band saw nothing."""
    visible, thermal = _stretched(cloud.intensity), _stretched(_counts(cloud))
    return np.column_stack([thermal, visible, visible])


def _counts(cloud: PointCloud) -> NDArray[np.float32]:
    assert cloud.thermal_counts is not None
    return cloud.thermal_counts


def _stretched(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    known = np.isfinite(values)
    if not np.any(known):
        return np.zeros(len(values), np.uint8)
    low, high = np.percentile(values[known], COLOUR_PERCENT)
    shares = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return np.where(known, 255.0 * np.nan_to_num(shares), 0.0).astype(np.uint8)
