"""A small synthetic flight that makes a method of two bands run every kernel it has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE, Camera
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.transforms import make_transform

_WIDTH, _HEIGHT = 160, 120
_FRAMES = 12


def synthetic_flight() -> Iterator[RigFrame]:
    """Frames of a texture that moves by some pixels from one to the next, as if at one distance."""
    import cv2

    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=(_HEIGHT, 2 * _WIDTH)).astype(np.float32), (0, 0), 2.0)
    texture = (noise - noise.min()) / (noise.max() - noise.min())
    camera = Camera(_WIDTH, _HEIGHT, 120.0, 120.0, 79.5, 59.5)
    T_rig_camera = {VISIBLE: np.eye(4), THERMAL: make_transform(np.eye(3), np.array([0.1, 0, 0]))}
    types = {VISIBLE: (255.0, np.uint8), THERMAL: (4000.0, np.uint16)}
    for i in range(_FRAMES):
        views = {}
        for role, (most, dtype) in types.items():
            start = 5 * i + (4 if role == THERMAL else 0)
            image = (most * texture[:, start : start + _WIDTH]).astype(dtype)
            views[role] = CameraView(image, camera, T_rig_camera[role].copy())
        yield RigFrame((i + 1) * 100_000_000, views)
