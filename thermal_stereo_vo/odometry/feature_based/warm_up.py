"""A tiny stereo frame that makes every kernel compile or load before the first real one."""

from __future__ import annotations

import cv2
import numpy as np

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.transforms import make_transform

_DISPARITY_PX = 8


def synthetic_pair(stamp_ns: int, dtype: type = np.uint8) -> RigFrame:
    """A textured plane seen by both eyes, (240, 320) pixels; every pixel may be used."""
    noise = np.random.default_rng(0).integers(0, 256, (60, 90)).astype(np.uint8)
    texture = cv2.resize(noise, (360, 240), interpolation=cv2.INTER_CUBIC)
    camera = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
    views = {}
    for role, shift, baseline_m in ((LEFT, 0, 0.0), (RIGHT, _DISPARITY_PX, 0.25)):
        display = np.ascontiguousarray(texture[:, shift : shift + 320])
        image = display if dtype == np.uint8 else display.astype(dtype) * 16 + 5000
        views[role] = CameraView(
            image=image,
            camera=camera,
            T_rig_camera=make_transform(np.eye(3), [baseline_m, 0.0, 0.0]),
            display=display,
            mask=np.ones(image.shape, np.bool_),
        )
    return RigFrame(stamp_ns=stamp_ns, views=views)
