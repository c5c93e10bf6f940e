"""What ROS says of a camera (``sensor_msgs/CameraInfo``), and how it maps to a rig calibration.

R and P follow ``image_pipeline``: ``x_rectified = R x_camera``, ``pixel ~ P (x_rectified, 1)``, and
the right camera of a pair has ``P[0, 3] = -fx * baseline``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

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
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import make_transform

_IDENTITY_R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_RADIAL_TANGENTIAL_LENGTHS = (4, 5, 8, 12, 14)
_MODELS = {
    "plumb_bob": DistortionModel.RADIAL_TANGENTIAL,
    "rational_polynomial": DistortionModel.RADIAL_TANGENTIAL,
    "thin_prism": DistortionModel.RADIAL_TANGENTIAL,
    "equidistant": DistortionModel.EQUIDISTANT,
    "fisheye": DistortionModel.EQUIDISTANT,
}


@dataclass(frozen=True)
class CameraInfoFields:
    """The fields of a ``CameraInfo`` message or file; matrices row by row.

    ``d`` has any length, ``k`` 9, ``r`` 9 and ``p`` 12 numbers.  ``name`` is the camera name of a
    file or the frame id of a message, for messages to people.
    """

    width: int
    height: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...] = _IDENTITY_R
    p: tuple[float, ...] = field(default=(0.0,) * 12)
    name: str = ""

    def __post_init__(self) -> None:
        for letter, numbers, length in (("K", self.k, 9), ("R", self.r, 9), ("P", self.p, 12)):
            if len(numbers) != length:
                raise CalibrationError(
                    f"camera_info of '{self.name}': {letter} has {len(numbers)} numbers instead of "
                    f"{length}; calibrate again or correct the file"
                )
        if self.k[0] == 0.0:
            raise CalibrationError(
                f"camera_info of '{self.name}' says that the camera is not calibrated (K[0] = 0): "
                "calibrate it, or give a calibration file"
            )

    @property
    def rectification(self) -> NDArray[np.float64]:
        """(3, 3) R."""
        return np.array(self.r, dtype=np.float64).reshape(3, 3)

    @property
    def projection(self) -> NDArray[np.float64]:
        """(3, 4) P."""
        return np.array(self.p, dtype=np.float64).reshape(3, 4)

    @property
    def bends_nothing(self) -> bool:
        """True when the images need no rectification: no distortion, no rotation, K equal to P."""
        same_pinhole = np.allclose(self.projection[:, :3].ravel(), self.k, rtol=0.0, atol=1e-6)
        no_rotation = np.allclose(self.r, _IDENTITY_R, rtol=0.0, atol=1e-12)
        return not any(self.d) and no_rotation and same_pinhole


def camera_from_info(info: CameraInfoFields) -> Camera:
    """The camera as its raw images obey it: K and D.

    Raises CalibrationError for an unknown distortion model or a wrong number of coefficients.
    """
    model, distortion = DistortionModel.NONE, info.d
    if any(info.d):
        try:
            model = _MODELS[info.distortion_model]
        except KeyError:
            raise CalibrationError(
                f"camera_info of '{info.name}' has the distortion model '{info.distortion_model}': "
                f"known are {', '.join(_MODELS)}"
            ) from None
        if model is DistortionModel.RADIAL_TANGENTIAL and len(info.d) not in (
            _RADIAL_TANGENTIAL_LENGTHS
        ):
            raise CalibrationError(
                f"camera_info of '{info.name}' has {len(info.d)} coefficients for "
                f"'{info.distortion_model}': OpenCV knows "
                f"{', '.join(map(str, _RADIAL_TANGENTIAL_LENGTHS))}"
            )
    else:
        distortion = ()
    fx, fy, cx, cy = info.k[0], info.k[4], info.k[2], info.k[5]
    return Camera(info.width, info.height, fx, fy, cx, cy, model, distortion)


def calibration_from_pair(
    left: CameraInfoFields,
    right: CameraInfoFields,
    *,
    rectified: bool | None = None,
    origin: str = "",
) -> RigCalibration:
    """A stereo rig from the two ``camera_info`` of a calibrated pair.

    The rig frame is the rectified left camera.  With ``rectified`` (None: when neither camera bends
    anything) the cameras are the pinholes of P; else they are K and D, with R and P kept for the
    rectifier and the extrinsics ``T_left_right = R_l^T [R_r | t]`` that R and P stand for.  The
    baseline is not judged here: see ``RigCalibration.check_stereo``.
    """
    offset_m = _centre(right, "right", left.name) - _centre(left, "left", left.name)
    if rectified is None:
        rectified = left.bends_nothing and right.bends_nothing
    if rectified:
        cameras = {
            LEFT: RigCamera(_pinhole(left)),
            RIGHT: RigCamera(_pinhole(right), make_transform(np.eye(3), offset_m)),
        }
    else:
        cameras = {
            LEFT: _unrectified(left, np.zeros(3)),
            RIGHT: _unrectified(right, offset_m),
        }
    return RigCalibration(cameras, rectified=rectified, origin=origin)


def undistorted_rig(rig: RigCalibration, infos: Mapping[str, CameraInfoFields]) -> RigCalibration:
    """The rig as its rectified images obey it: the pinholes of P, mounted where ``rig`` says."""
    cameras = {
        role: RigCamera(_pinhole(info), rig[role].T_rig_camera) for role, info in infos.items()
    }
    return replace(rig, cameras=cameras)


def infos_from_calibration(calibration: RigCalibration) -> dict[str, CameraInfoFields]:
    """``camera_info`` of every camera, by role; the inverse of ``calibration_from_pair``.

    Cameras beside the stereo pair get R = I and P = [K | 0], as ROS has no field for their pose.

    Raises CalibrationError when an unrectified pair brings no R and P.
    """
    return {role: _info(calibration, role) for role in calibration.cameras}


def _centre(info: CameraInfoFields, eye: str, name: str) -> NDArray[np.float64]:
    """(3,) position of the camera in the common rectified frame, -K'^-1 P[:, 3]."""
    projection = info.projection
    if projection[0, 0] == 0.0:
        raise CalibrationError(
            f"the {eye} camera_info of '{info.name or name}' has no projection matrix P: calibrate "
            "the two cameras as a stereo pair"
        )
    return -np.asarray(np.linalg.solve(projection[:, :3], projection[:, 3]), dtype=np.float64)


def _pinhole(info: CameraInfoFields) -> Camera:
    p = info.p
    return Camera(info.width, info.height, fx=p[0], fy=p[5], cx=p[2], cy=p[6])


def _unrectified(info: CameraInfoFields, offset_m: NDArray[np.float64]) -> RigCamera:
    rectification = info.rectification
    if not np.allclose(rectification @ rectification.T, np.eye(3), rtol=0.0, atol=1e-5):
        raise CalibrationError(
            f"the R of camera_info '{info.name}' is no rotation: calibrate again or correct it"
        )
    T_rig_camera = make_transform(rectification, offset_m)
    return RigCamera(camera_from_info(info), T_rig_camera, rectification, info.projection)


def _info(calibration: RigCalibration, role: str) -> CameraInfoFields:
    mounted = calibration[role]
    camera = mounted.camera
    K = camera.matrix
    R, P = np.eye(3), np.column_stack([K, np.zeros(3)])
    if calibration.rectified and role == RIGHT and LEFT in calibration.cameras:
        P[:, 3] = -K @ calibration.T_a_b(LEFT, RIGHT)[:3, 3]
    elif not calibration.rectified and role in (LEFT, RIGHT):
        if mounted.rectification is None or mounted.projection is None:
            raise CalibrationError(
                f"the calibration {calibration.origin} has no rectification for the {role} camera, "
                "which camera_info needs: rectify the calibration first"
            )
        R, P = mounted.rectification, mounted.projection
    return CameraInfoFields(
        width=camera.width,
        height=camera.height,
        distortion_model=_model_name(camera),
        d=_coefficients(camera),
        k=_flat(K),
        r=_flat(R),
        p=_flat(P),
        name=role,
    )


def _model_name(camera: Camera) -> str:
    if camera.has_distortion and camera.model is DistortionModel.EQUIDISTANT:
        return "equidistant"
    return "rational_polynomial" if len(_coefficients(camera)) > 5 else "plumb_bob"


def _coefficients(camera: Camera) -> tuple[float, ...]:
    if not camera.has_distortion:
        return (0.0,) * 5
    numbers = tuple(map(float, camera.distortion))
    if camera.model is DistortionModel.EQUIDISTANT:
        return numbers
    return numbers + (0.0,) * (5 - len(numbers))  # plumb_bob has five


def _flat(matrix: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(float(x) for x in matrix.ravel())
