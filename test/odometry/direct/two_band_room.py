"""The inside of a box whose walls look different in two bands, and flights of a rig through it."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE, Camera
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.transforms import exp_so3, make_transform

PERIOD_NS = 50_000_000
_WAVES = 12
HALF_M = np.array([2.5, 1.8, 3.0])
CAMERAS = {
    VISIBLE: Camera(320, 240, 230.0, 231.0, 160.3, 119.1),
    THERMAL: Camera(300, 220, 240.0, 240.5, 148.2, 111.7),
}
T_RIG_CAMERA = {
    VISIBLE: np.eye(4),
    THERMAL: make_transform(exp_so3([0.01, -0.02, 0.015]), np.array([0.2, 0.01, -0.02])),
}


class Room:
    """Waves in three dimensions, of 10 to 60 cm, other ones in each band."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._waves = {}
        for role in CAMERAS:
            directions = rng.normal(size=(_WAVES, 3))
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            lengths_m = np.exp(rng.uniform(np.log(0.1), np.log(0.6), _WAVES))
            self._waves[role] = (
                2 * np.pi * directions / lengths_m[:, None],
                rng.uniform(0, 2 * np.pi, _WAVES),
                rng.uniform(0.5, 1.0, _WAVES),
            )

    def look(self, role: str, T_world_rig: np.ndarray) -> np.ndarray:
        """(H, W) brightness of mean zero, standard deviation about 1.9."""
        camera = CAMERAS[role]
        T = T_world_rig @ T_RIG_CAMERA[role]
        y, x = np.mgrid[: camera.height, : camera.width].astype(float)
        rays = np.stack(
            [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1
        )
        rays = rays @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            walls = (np.sign(rays) * HALF_M - T[:3, 3]) / rays
        points = T[:3, 3] + rays * walls.min(axis=-1)[..., None]
        k, phase, size = self._waves[role]
        return np.sin(points.astype(np.float32) @ k.T.astype(np.float32) + phase) @ size

    def frame(self, i: int, T_world_rig: np.ndarray, rng: np.random.Generator) -> RigFrame:
        """Both views, 8 bits and counts, with noise."""
        views = {}
        for role, (offset, gain, dtype) in {
            VISIBLE: (120.0, 32.0, np.uint8), THERMAL: (7000.0, 55.0, np.uint16),
        }.items():  # fmt: skip
            image = self.look(role, T_world_rig)
            noisy = offset + gain * (image + 0.02 * rng.normal(size=image.shape))
            image = np.clip(np.rint(noisy), 0, 255 if dtype is np.uint8 else 16383).astype(dtype)
            views[role] = CameraView(image, CAMERAS[role], T_RIG_CAMERA[role].copy())
        return RigFrame((i + 1) * PERIOD_NS, views)


def swaying(count: int) -> np.ndarray:
    """(N, 4, 4) T_world_rig of hands that turn and move the rig, from rest."""
    return np.stack([sway(0.05 * i) for i in range(count)])


def sway(t_s: float) -> np.ndarray:
    """(4, 4) T_world_rig of ``swaying`` at a time."""
    ramp = min(1.0, max(0.0, t_s))
    angles = [0.15 * np.sin(1.7 * t_s), 0.4 * np.sin(1.3 * t_s), 0.2 * np.sin(2.1 * t_s)]
    place = [0.25 * np.sin(1.1 * t_s), 0.12 * np.sin(1.9 * t_s), 0.2 * np.sin(0.8 * t_s)]
    return make_transform(exp_so3(ramp * np.array(angles)), ramp * np.array(place))


def sliding(count: int) -> np.ndarray:
    """(N, 4, 4) straight ahead and a little aside without any turn."""
    ways_m = 0.012 * np.arange(count)[:, None] * np.array([0.5, 0.1, 1.0])
    return np.stack([make_transform(np.eye(3), way) for way in ways_m])
