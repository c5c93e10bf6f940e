"""Row-aligned, distortion-free images of both eyes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

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
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView, GapReason, RadiometricFrame, RigFrame
from thermal_stereo_vo.core.transforms import inverse, make_transform
from thermal_stereo_vo.stereo.remapping import RemappedCamera, coefficients


@dataclass(frozen=True)
class RectificationConfig:
    """How the rectified image is cut out of the raw one."""

    alpha: float = setting(
        0.0,
        "0 keeps only pixels that were seen, 1 keeps the whole raw image (OpenCV stereoRectify).",
        minimum=0.0,
        maximum=1.0,
    )


class RigRectifier(Protocol):
    """Turns frames of the cameras in ``roles`` into views through ideal pinholes.

    ``T_rig_rectified`` (4, 4) maps coordinates of the rig that results speak of to those of the rig
    the calibration speaks of.
    """

    T_rig_rectified: NDArray[np.float64]

    @property
    def roles(self) -> tuple[str, ...]:
        """The cameras, in the order of a pair."""

    @property
    def rectified_calibration(self) -> RigCalibration:
        """The rig that the views obey."""

    def process(self, frame: RadiometricFrame, role: str) -> CameraView | None:
        """The view of one camera, or None while it is blind."""


class Rectifier:
    """Maps both eyes onto a common image plane.

    Uses the R and P of the calibration file when both eyes bring them, else Bouguet's method
    (``cv2.stereoRectify``).

    ``T_rig_rectified`` maps coordinates of the rectified left camera, the ``rig`` of every result,
    to those of the rig the calibration speaks of.

    Raises CalibrationError for a pair that cannot be rectified.
    """

    roles = (LEFT, RIGHT)

    def __init__(self, calibration: RigCalibration, config: RectificationConfig) -> None:
        calibration.check_stereo()
        self._calibration = calibration
        left, right = calibration[LEFT], calibration[RIGHT]
        R_left, R_right, ideal_left, ideal_right = None, None, left.camera, right.camera
        baseline_m = calibration.baseline_m
        if not calibration.rectified:
            R_left, R_right, P_left, P_right = _rectifying_transforms(calibration, config.alpha)
            ideal_left, ideal_right = _pinhole(left.camera, P_left), _pinhole(right.camera, P_right)
            baseline_m = float(P_left[0, 3] / P_left[0, 0] - P_right[0, 3] / P_right[0, 0])
        origin, T_left_right = calibration.origin, make_transform(np.eye(3), [baseline_m, 0.0, 0.0])
        self._eyes = {
            LEFT: RemappedCamera(left.camera, ideal_left, R_left, np.eye(4), origin),
            RIGHT: RemappedCamera(right.camera, ideal_right, R_right, T_left_right, origin),
        }
        R_rig_rectified = np.eye(3) if R_left is None else R_left.T
        self.T_rig_rectified = left.T_rig_camera @ make_transform(R_rig_rectified, np.zeros(3))

    @property
    def baseline_m(self) -> float:
        """Distance of the rectified eyes."""
        return float(self._eyes[RIGHT].T_rig_camera[0, 3])

    @property
    def rectified_calibration(self) -> RigCalibration:
        """The rig that the rectified images obey, seen from the rectified left camera."""
        T_base_rig, T_rig_imu = self._calibration.T_base_rig, self._calibration.T_rig_imu
        return RigCalibration(
            cameras={
                role: RigCamera(eye.camera, eye.T_rig_camera) for role, eye in self._eyes.items()
            },
            rectified=True,
            origin=self._calibration.origin,
            T_base_rig=None if T_base_rig is None else T_base_rig @ self.T_rig_rectified,
            T_rig_imu=None if T_rig_imu is None else inverse(self.T_rig_rectified) @ T_rig_imu,
        )

    def process(self, frame: RadiometricFrame, role: str) -> CameraView | None:
        """The rectified view of one eye, or None while it is blind.

        Raises FrameError for an image of another size than the calibration's.
        """
        return self._eyes[role].process(frame, role)


def assemble(
    rectifier: RigRectifier,
    first: RadiometricFrame | None,
    second: RadiometricFrame | None,
    stamp_ns: int,
) -> RigFrame:
    """The rig frame of a pair; a camera that is missing or blind has no view."""
    views: dict[str, CameraView] = {}
    blind: dict[str, GapReason] = {}
    for role, frame in zip(rectifier.roles, (first, second), strict=True):
        view = None if frame is None else rectifier.process(frame, role)
        if view is not None:
            views[role] = view
        else:
            reason = None if frame is None else frame.blind
            blind[role] = GapReason.DROPPED if reason is None else reason
    skew_ns = 0 if first is None or second is None else second.stamp_ns - first.stamp_ns
    return RigFrame(stamp_ns=stamp_ns, views=views, blind=blind, skew_ns=skew_ns)


def with_rectification(
    calibration: RigCalibration, config: RectificationConfig
) -> tuple[RigCalibration, NDArray[np.float64]]:
    """The same raw cameras with the R and P that ``Rectifier`` would use, and ``T_rig_rectified``.

    The rig frame of the new calibration is the rectified left camera, as in a ``camera_info`` pair:
    a pose becomes ``T_world_rig @ T_rig_rectified``.

    Raises CalibrationError for a pair that cannot be rectified.
    """
    T_rig_rectified = Rectifier(calibration, config).T_rig_rectified
    T_rectified_rig = inverse(T_rig_rectified)
    cameras = {
        role: replace(mounted, T_rig_camera=T_rectified_rig @ mounted.T_rig_camera)
        for role, mounted in calibration.cameras.items()
    }
    if not calibration.rectified:
        R_left, R_right, P_left, P_right = _rectifying_transforms(calibration, config.alpha)
        cameras[LEFT] = replace(cameras[LEFT], rectification=R_left, projection=P_left)
        cameras[RIGHT] = replace(cameras[RIGHT], rectification=R_right, projection=P_right)
    T_base_rig, T_rig_imu = calibration.T_base_rig, calibration.T_rig_imu
    completed = replace(
        calibration,
        cameras=cameras,
        T_base_rig=None if T_base_rig is None else T_base_rig @ T_rig_rectified,
        T_rig_imu=None if T_rig_imu is None else T_rectified_rig @ T_rig_imu,
    )
    return completed, T_rig_rectified


def _rectifying_transforms(
    calibration: RigCalibration, alpha: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """R (3, 3) and P (3, 4) of both eyes."""
    left, right = calibration[LEFT], calibration[RIGHT]
    if (
        left.rectification is not None
        and right.rectification is not None
        and left.projection is not None
        and right.projection is not None
    ):
        return left.rectification, right.rectification, left.projection, right.projection
    fisheye = [rig.camera.model is DistortionModel.EQUIDISTANT for rig in (left, right)]
    if fisheye[0] != fisheye[1]:
        raise CalibrationError(
            f"{calibration.origin}: one eye is equidistant and the other is not; calibrate both "
            "with the same model"
        )
    T_right_left = inverse(calibration.T_a_b(LEFT, RIGHT))
    arguments = (
        left.camera.matrix,
        coefficients(left.camera),
        right.camera.matrix,
        coefficients(right.camera),
        left.camera.size,
        np.ascontiguousarray(T_right_left[:3, :3]),
        np.ascontiguousarray(T_right_left[:3, 3]).reshape(3, 1),
    )
    if fisheye[0]:
        R_left, R_right, P_left, P_right, _ = cv2.fisheye.stereoRectify(
            *arguments, flags=cv2.CALIB_ZERO_DISPARITY, balance=alpha
        )
    else:
        R_left, R_right, P_left, P_right = cv2.stereoRectify(
            *arguments, flags=cv2.CALIB_ZERO_DISPARITY, alpha=alpha
        )[:4]
    return R_left, R_right, P_left, P_right


def _pinhole(raw: Camera, P: NDArray[np.float64]) -> Camera:
    return Camera(*raw.size, P[0, 0], P[1, 1], P[0, 2], P[1, 2])
