"""A warm textured plane before two raw 14-bit cameras: drawn in seconds, for measurements of time.

No simulator: there is no world, no sensor but white noise, and nothing to learn about accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.transforms import exp_se3

STEP = (0.012, 0.0, 0.03, 0.0, 0.003, 0.001)
NORMAL, DISTANCE_M = np.array([0.0, -0.35, 1.0]), 8.0
TEXELS_PER_M, TEXELS = 50.0, 1024
NOISE_COUNTS = 6.0


def drawn_rig(width: int = 640, height: int = 480) -> RigCalibration:
    """Two lenses with distortion that squint a little, 0.3 m apart."""

    def camera(focal: float, k1: float) -> Camera:
        model = DistortionModel.RADIAL_TANGENTIAL
        coefficients = (k1, 0.02, 1e-3, -5e-4, 0.0)
        return Camera(
            width, height, focal, focal, width / 2 - 1, height / 2 + 1, model, coefficients
        )

    T_left_right = exp_se3([0.3, 0.002, -0.003, 0.005, -0.01, 0.004])
    return RigCalibration(
        {
            LEFT: RigCamera(camera(0.82 * width, -0.12)),
            RIGHT: RigCamera(camera(0.825 * width, -0.10), T_left_right),
        },
        origin="of the drawn plane",
    )


def drawn_frames(
    rig: RigCalibration, pairs: int, period_ns: int, rng: np.random.Generator
) -> Iterator[RawFrame]:
    """Left and right frames in turn of a steady, slightly curved flight."""
    counts = _texture(rng)
    rays = {role: _rays(mounted.camera) for role, mounted in rig.cameras.items()}
    T_world_rig = np.eye(4)
    for i in range(pairs):
        for role, mounted in rig.cameras.items():
            drawn = _draw(counts, rays[role], T_world_rig @ mounted.T_rig_camera)
            noisy = drawn + NOISE_COUNTS * rng.standard_normal(drawn.shape, np.float32)
            image = np.clip(np.rint(noisy), 0, 16383).astype(np.uint16)
            yield RawFrame(image, i * period_ns, role, i)
        T_world_rig = T_world_rig @ exp_se3(STEP)


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """(TEXELS, TEXELS) counts with detail of all sizes."""
    texture = np.zeros((TEXELS, TEXELS), np.float32)
    for cells in (16, 64, 256, 512):
        patch = rng.standard_normal((cells, cells)).astype(np.float32)
        texture += cv2.resize(patch, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    return 7000.0 + 400.0 * texture


def _rays(camera: Camera) -> NDArray[np.float64]:
    """(H, W, 3) directions with z = 1."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    return camera.unproject(pixels).reshape(camera.height, camera.width, 3)


def _draw(
    counts: NDArray[np.float32], rays: NDArray[np.float64], T_world_camera: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(H, W) counts."""
    origin = T_world_camera[:3, 3]
    directions = rays @ T_world_camera[:3, :3].T
    depth = (DISTANCE_M - origin @ NORMAL) / (directions @ NORMAL)
    hit = (origin[:2] + depth[..., None] * directions[..., :2]) * TEXELS_PER_M + TEXELS / 2
    x, y = (np.ascontiguousarray(hit[..., k], np.float32) for k in range(2))
    drawn = cv2.remap(counts, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(drawn, np.float32)
