"""What the sun and the open sky reach, cast once before a flight.

Sun-warmed ground keeps the shadows of the last quarter of an hour: they are blurred accordingly.
The share of open sky decides how much a surface loses at night and gains on a cloudy day.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.ray_casting import RayCaster
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.shading import Light, open_field
from thermal_stereo_vo.simulation.weather import Weather

_SHADOW_CELL_M = 0.25
_OPENNESS_CELL_M = 1.2
_SHADOW_BLUR_M = 0.3
_ABOVE_M = 400.0
_SKY_RAYS = 20
_MARGIN_M = 40.0


def light_scene(scene: Scene, weather: Weather, caster: RayCaster) -> Light:
    """The light maps of a scene; those of an open field for scenes indoors.

    ``caster`` holds what stands still.
    """
    if not scene.outdoors or scene.extent_m is None:
        return open_field()
    low, high = scene.extent_m[0] + _MARGIN_M, scene.extent_m[1] - _MARGIN_M
    shadow = np.empty((1, 1, 2), np.float32)
    if weather.sun > 0.0:
        shadow = _shadow(caster, low, high, weather.sun_direction)
    return Light(
        shadow, _SHADOW_CELL_M, _openness(caster, low, high), _OPENNESS_CELL_M, low.astype(float)
    )


def _grid(low: NDArray[np.float64], high: NDArray[np.float64], cell: float) -> tuple[
    NDArray[np.float64], NDArray[np.float64]
]:  # fmt: skip
    x = np.arange(low[0], high[0], cell)
    y = np.arange(low[1], high[1], cell)
    gx, gy = np.meshgrid(x, y)
    return gx, gy


def _shadow(
    caster: RayCaster,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    sun: NDArray[np.float64],
) -> NDArray[np.float32]:
    x, y = _grid(low, high, _SHADOW_CELL_M)
    origins = np.stack([x, y, np.zeros_like(x)], axis=-1) + sun / sun[2] * _ABOVE_M
    rays = np.broadcast_to(-sun / sun[2], origins.shape)
    met = caster.cast(
        np.ascontiguousarray(origins.reshape(-1, 3), dtype=np.float32),
        np.ascontiguousarray(rays.reshape(-1, 3), dtype=np.float32),
    )
    height = np.where(met.triangle >= 0, _ABOVE_M - met.distance, -50.0).reshape(x.shape)
    sigma = _SHADOW_BLUR_M / _SHADOW_CELL_M
    moments = [
        cv2.GaussianBlur(part.astype(np.float32), (0, 0), sigma) for part in (height, height**2)
    ]
    return np.ascontiguousarray(np.stack(moments, axis=-1))


def _openness(
    caster: RayCaster, low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float32]:
    x, y = _grid(low, high, _OPENNESS_CELL_M)
    n = x.size
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(n, _ABOVE_M)]).astype(np.float32)
    down = np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape)
    # Below roofs and crowns lies the ground: go down through whatever comes first.
    ground = np.full(n, -2.0)
    start = origins.copy()
    for _ in range(12):
        met = caster.cast(start, np.ascontiguousarray(down))
        hit = met.triangle >= 0
        if not np.any(hit):
            break
        z = start[:, 2] - met.distance
        ground = np.where(hit & (z > -1.9), z, ground)
        start[:, 2] = np.where(hit, z - 0.02, -500.0)
    origins[:, 2] = ground + 0.15
    # Cosine-weighted directions on a spiral: each ray carries the same share of a level surface.
    k = np.arange(_SKY_RAYS) + 0.5
    sine = np.sqrt(k / _SKY_RAYS)
    turn = k * np.pi * (3.0 - np.sqrt(5.0))
    seen = np.zeros(n)
    for s, t in zip(sine, turn, strict=True):
        ray = np.array([s * np.cos(t), s * np.sin(t), np.sqrt(1.0 - s * s)], np.float32)
        rays = np.ascontiguousarray(np.broadcast_to(ray, origins.shape))
        seen += ~caster.blocked(origins, rays)
    share = (seen / _SKY_RAYS).reshape(x.shape).astype(np.float32)
    share = cv2.GaussianBlur(share, (0, 0), 0.7)
    return np.ascontiguousarray(np.stack([share, ground.reshape(x.shape)], axis=-1), np.float32)
