"""A sparse volume of signed distances that many depth maps are averaged in.

B. Curless and M. Levoy, A volumetric method for building complex models from range images (SIGGRAPH
1996): every measured point writes its distance along the ray into the voxels just before and behind
it; the surface is where the weighted mean changes sign.  Voxels live in sorted tables, so memory
grows with the surface and not with the space around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.results import PointCloud

_BITS = 21
_HALF = 1 << (_BITS - 1)
_LOOSE_ROWS = 2_000_000
_SUMS = ("weight", "distance", "count", "intensity", "intensity2", "temperature", "temperature2")
_WEIGHT, _DISTANCE, _COUNT, _INTENSITY, _INTENSITY2, _TEMPERATURE, _TEMPERATURE2 = range(len(_SUMS))


@dataclass(frozen=True)
class VolumeConfig:
    """How clouds become one model."""

    voxel_m: float = setting(0.1, "Edge of a voxel.", unit="m", minimum=0.005, maximum=5.0)
    truncation_voxels: float = setting(
        4.0, "How far before and behind a point it is averaged with others.", unit="voxels",
        minimum=1.0, maximum=20.0,
    )  # fmt: skip
    min_count: int = setting(
        5, "Measured points that a voxel must have seen to be part of the surface.", minimum=1,
        maximum=100_000,
    )  # fmt: skip


@dataclass(frozen=True)
class SurfaceModel:
    """The surface of a volume: points with what was measured about them.

    ``cloud`` holds the means; ``intensity_spread`` and ``temperature_spread_kelvin`` (N,) float32
    are standard deviations between measurements (the latter None without temperatures), ``count``
    (N,) int32 how many there were.
    """

    cloud: PointCloud
    intensity_spread: NDArray[np.float32]
    temperature_spread_kelvin: NDArray[np.float32] | None
    count: NDArray[np.int32]


class Volume:
    """Collects clouds; ``surface`` gives what they agree on."""

    def __init__(self, config: VolumeConfig) -> None:
        self._config = config
        self._keys = np.zeros(0, np.int64)
        self._sums = np.zeros((0, len(_SUMS)))
        self._loose: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        self._has_temperature = True
        self.clouds = 0

    def __len__(self) -> int:
        """Voxels that have seen anything."""
        self._merge()
        return len(self._keys)

    def add(
        self, cloud: PointCloud, eye_m: NDArray[np.floating], sigma_m: NDArray[np.floating]
    ) -> None:
        """Average in a cloud.

        ``eye_m`` (3,) is where it was seen from, in the axes of the cloud; ``sigma_m`` (N,) the
        standard deviation of each point along its ray.
        """
        self.clouds += 1
        self._has_temperature &= cloud.temperature_kelvin is not None
        temperature = cloud.temperature_kelvin
        values = np.zeros((len(cloud.xyz), len(_SUMS)))
        weight = 1.0 / np.maximum(np.asarray(sigma_m, np.float64), 1e-3) ** 2
        values[:, _WEIGHT], values[:, _COUNT] = weight, 1.0
        values[:, _INTENSITY] = cloud.intensity
        if temperature is not None:
            values[:, _TEMPERATURE] = temperature
        usable = np.isfinite(cloud.xyz).all(axis=1) & np.isfinite(values).all(axis=1)
        values[:, _INTENSITY2] = values[:, _INTENSITY] ** 2
        values[:, _TEMPERATURE2] = values[:, _TEMPERATURE] ** 2
        points, values = cloud.xyz[usable].astype(np.float64), values[usable]
        rays = points - np.asarray(eye_m, np.float64)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        voxel_m = self._config.voxel_m
        reach = self._config.truncation_voxels
        for step in np.arange(-np.floor(reach), np.floor(reach) + 1.0):
            self._write(points + rays * (step * voxel_m), points, rays, values, at=step == 0.0)

    def _write(
        self,
        where_m: NDArray[np.float64],
        points_m: NDArray[np.float64],
        rays: NDArray[np.float64],
        values: NDArray[np.float64],
        *,
        at: bool,
    ) -> None:
        """Distances into the voxels at ``where_m``; what was measured only where it was."""
        voxel_m = self._config.voxel_m
        index = np.floor(where_m / voxel_m).astype(np.int64)
        centre_m = (index + 0.5) * voxel_m
        written = values.copy()
        written[:, _DISTANCE] = values[:, _WEIGHT] * np.sum((points_m - centre_m) * rays, axis=1)
        if not at:
            written[:, _COUNT:] = 0.0
        self._loose.append(_summed(_packed(index), written))
        if sum(len(keys) for keys, _ in self._loose) > _LOOSE_ROWS:
            self._merge()

    def _merge(self) -> None:
        if not self._loose:
            return
        tables = [(self._keys, self._sums), *self._loose]
        keys = np.concatenate([keys for keys, _ in tables])
        self._keys, self._sums = _summed(keys, np.concatenate([sums for _, sums in tables]))
        self._loose = []

    def surface(self) -> SurfaceModel:
        """Points where the mean distance changes sign between two voxels side by side."""
        self._merge()
        config = self._config
        keys, sums = self._keys, self._sums
        index = _unpacked(keys)
        distance = sums[:, _DISTANCE] / np.maximum(sums[:, _WEIGHT], 1e-300)
        found_m: list[NDArray[np.float64]] = []
        source: list[NDArray[np.intp]] = []
        partner: list[NDArray[np.intp]] = []
        for axis in range(3):
            step = np.zeros(3, np.int64)
            step[axis] = 1
            place = np.searchsorted(keys, _packed(index + step))
            place = np.minimum(place, max(len(keys) - 1, 0))
            here = np.nonzero(keys[place] == _packed(index + step))[0] if len(keys) else place
            there = place[here]
            crosses = (distance[here] > 0.0) != (distance[there] > 0.0)
            seen = sums[here, _COUNT] + sums[there, _COUNT] >= config.min_count
            here, there = here[crosses & seen], there[crosses & seen]
            part = distance[here] / (distance[here] - distance[there])
            found_m.append((index[here] + 0.5 + part[:, None] * step) * config.voxel_m)
            source.append(here)
            partner.append(there)
        return self._model(np.concatenate(found_m), np.concatenate(source), np.concatenate(partner))

    def _model(
        self,
        points_m: NDArray[np.float64],
        here: NDArray[np.intp],
        there: NDArray[np.intp],
    ) -> SurfaceModel:
        both = self._sums[here] + self._sums[there]
        count = np.maximum(both[:, _COUNT], 1.0)

        def mean_and_spread(first: int, second: int) -> tuple[NDArray[np.float32], ...]:
            mean = both[:, first] / count
            variance = np.maximum(both[:, second] / count - mean * mean, 0.0)
            return mean.astype(np.float32), np.sqrt(variance).astype(np.float32)

        intensity, intensity_spread = mean_and_spread(_INTENSITY, _INTENSITY2)
        temperature, temperature_spread = mean_and_spread(_TEMPERATURE, _TEMPERATURE2)
        known = self._has_temperature and self.clouds > 0
        cloud = PointCloud(points_m.astype(np.float32), intensity, temperature if known else None)
        return SurfaceModel(
            cloud, intensity_spread, temperature_spread if known else None,
            both[:, _COUNT].astype(np.int32),
        )  # fmt: skip


def _summed(
    keys: NDArray[np.int64], rows: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the same key added up, in order of the keys."""
    if len(keys) == 0:
        return keys, rows
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.nonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))[0]
    return ordered[starts], np.add.reduceat(rows[order], starts, axis=0)


def _packed(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) one key for each (N, 3) voxel; far beyond a million voxels it wraps around."""
    x, y, z = ((index[:, k] + _HALF) & (2 * _HALF - 1) for k in range(3))
    return np.asarray((x << (2 * _BITS)) | (y << _BITS) | z)


def _unpacked(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N, 3), the inverse of ``_packed``."""
    parts = [(keys >> shift) & (2 * _HALF - 1) for shift in (2 * _BITS, _BITS, 0)]
    return np.stack(parts, axis=1) - _HALF
