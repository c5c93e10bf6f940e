"""The rigs that fly: two Tau 2 side by side, and a visible camera beside a thermal one.

The stereo rig is that of Mouats et al. 2015: Table II (Amcc) for the lenses, Table I for where the
right camera stands.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    THERMAL,
    VISIBLE,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform

LEFT_LENS = Camera(
    640, 480, 522.3360, 520.0211, 317.8889, 261.0548,
    DistortionModel.RADIAL_TANGENTIAL, (-0.2851, 0.0864, -0.0033, 0.0011),
)  # fmt: skip
RIGHT_LENS = Camera(
    640, 480, 521.7557, 518.7962, 319.7698, 248.4461,
    DistortionModel.RADIAL_TANGENTIAL, (-0.2901, 0.0966, -0.0032, 0.0011),
)  # fmt: skip
VISIBLE_LENS = Camera(
    640, 480, 470.0, 470.5, 322.4, 238.1,
    DistortionModel.RADIAL_TANGENTIAL, (-0.11, 0.07, 0.0004, -0.0006),
)  # fmt: skip

_T_RIGHT_LEFT = make_transform(
    exp_so3([-0.0145, -0.0121, 0.0037]), np.array([-267.8441, 0.4702, 0.5850]) * 1e-3
)
_T_VISIBLE_THERMAL = make_transform(exp_so3([0.006, -0.011, 0.004]), [0.092, 0.004, -0.006])


def tilted(down_rad: float) -> NDArray[np.float64]:
    """(4, 4) ``T_base_rig`` of a rig that looks forward and down by this angle."""
    T_base_rig = default_T_base_rig()
    return T_base_rig @ make_transform(exp_so3([-down_rad, 0.0, 0.0]), np.zeros(3))


def stereo_rig(scale: float = 1.0, tilt_down_deg: float = 0.0) -> RigCalibration:
    """Both thermal cameras; ``scale`` shrinks the images (and the lenses with them).

    The rig frame is that of the rectified left camera, as ``cv2.stereoRectify`` lays it.
    """
    left, right = scaled(LEFT_LENS, scale), scaled(RIGHT_LENS, scale)
    R_left = cv2.stereoRectify(
        left.matrix, np.array(left.distortion), right.matrix, np.array(right.distortion),
        left.size, _T_RIGHT_LEFT[:3, :3].copy(), _T_RIGHT_LEFT[:3, 3:].copy(),
    )[0]  # fmt: skip
    T_rig_left = make_transform(R_left, np.zeros(3))
    return RigCalibration(
        {
            LEFT: RigCamera(left, T_rig_left),
            RIGHT: RigCamera(right, T_rig_left @ inverse(_T_RIGHT_LEFT)),
        },
        origin="simulated stereo rig",
        T_base_rig=tilted(np.radians(tilt_down_deg)),
    )


def visible_thermal_rig(scale: float = 1.0) -> RigCalibration:
    """A visible camera, whose frame is the rig's, and a thermal one to its right."""
    return RigCalibration(
        {
            VISIBLE: RigCamera(scaled(VISIBLE_LENS, scale)),
            THERMAL: RigCamera(scaled(LEFT_LENS, scale), _T_VISIBLE_THERMAL),
        },
        origin="simulated visible + thermal rig",
        T_base_rig=default_T_base_rig(),
    )


def scaled(camera: Camera, scale: float) -> Camera:
    """The same lens on a sensor of ``scale`` times as many pixels."""
    if scale == 1.0:
        return camera
    return Camera(
        round(camera.width * scale),
        round(camera.height * scale),
        camera.fx * scale,
        camera.fy * scale,
        (camera.cx + 0.5) * scale - 0.5,
        (camera.cy + 0.5) * scale - 0.5,
        camera.model,
        camera.distortion,
    )
