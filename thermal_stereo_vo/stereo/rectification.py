"""Row-aligned, distortion-free images of both eyes."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.core.frames import CameraView, GapReason, RadiometricFrame, RigFrame
from thermal_stereo_vo.core.transforms import inverse, make_transform


@dataclass(frozen=True)
class RectificationConfig:
    """How the rectified image is cut out of the raw one."""

    alpha: float = setting(
        0.0,
        "0 keeps only pixels that were seen, 1 keeps the whole raw image (OpenCV stereoRectify).",
        minimum=0.0,
        maximum=1.0,
    )


class Rectifier:
    """Maps both eyes onto a common image plane.

    Uses the R and P of the calibration file when both eyes bring them, else Bouguet's method
    (``cv2.stereoRectify``).  Counts stay linear: bilinear interpolation, rounded to the input type,
    so that a chain of nodes and a replay see the same numbers.

    ``T_rig_rectified`` maps coordinates of the rectified left camera, the ``rig`` of every result,
    to those of the rig the calibration speaks of.

    Raises CalibrationError for a pair that cannot be rectified.
    """

    def __init__(self, calibration: RigCalibration, config: RectificationConfig) -> None:
        calibration.check_stereo()
        self._calibration = calibration
        left, right = calibration[LEFT], calibration[RIGHT]
        self._raw_size = left.camera.size
        self._maps: dict[str, tuple[NDArray[np.int16], NDArray[np.uint16]]] = {}
        self._masks: dict[str, NDArray[np.bool_] | None] = {LEFT: None, RIGHT: None}
        if calibration.rectified:
            R_left = np.eye(3)
            self._cameras = {LEFT: left.camera, RIGHT: right.camera}
            baseline_m = calibration.baseline_m
        else:
            R_left, R_right, P_left, P_right = _rectifying_transforms(calibration, config.alpha)
            baseline_m = float(P_left[0, 3] / P_left[0, 0] - P_right[0, 3] / P_right[0, 0])
            self._cameras = {}
            for role, rig_camera, R, P in (
                (LEFT, left, R_left, P_left),
                (RIGHT, right, R_right, P_right),
            ):
                width, height = rig_camera.camera.size
                self._cameras[role] = Camera(width, height, P[0, 0], P[1, 1], P[0, 2], P[1, 2])
                self._maps[role] = _undistortion_maps(rig_camera.camera, R, P)
                self._masks[role] = _seen(self._maps[role][0], self._raw_size)
        self.T_rig_rectified = left.T_rig_camera @ make_transform(R_left.T, np.zeros(3))
        self._T_rig_camera = {
            LEFT: np.eye(4),
            RIGHT: make_transform(np.eye(3), [baseline_m, 0.0, 0.0]),
        }

    @property
    def baseline_m(self) -> float:
        """Distance of the rectified eyes."""
        return float(self._T_rig_camera[RIGHT][0, 3])

    @property
    def rectified_calibration(self) -> RigCalibration:
        """The rig that the rectified images obey, seen from the rectified left camera."""
        T_base_rig, T_rig_imu = self._calibration.T_base_rig, self._calibration.T_rig_imu
        return RigCalibration(
            cameras={
                role: RigCamera(self._cameras[role], self._T_rig_camera[role])
                for role in (LEFT, RIGHT)
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
        if frame.image is None:
            return None
        height, width = frame.image.shape
        if (width, height) != self._raw_size:
            raise FrameError(
                f"camera '{role}' gives {width}x{height} pixels, but the calibration "
                f"{self._calibration.origin} is for {self._raw_size[0]}x{self._raw_size[1]}: use "
                "the calibration of this camera and video mode"
            )
        image, mask = frame.image, frame.mask
        if self._maps:
            maps = self._maps[role]
            image = cv2.remap(image, *maps, cv2.INTER_LINEAR)
            if mask is not None:
                whole = cv2.remap(mask.astype(np.uint8) * 255, *maps, cv2.INTER_LINEAR) == 255
                mask = whole & self._masks[role] if self._masks[role] is not None else whole
            else:
                mask = self._masks[role]
        return CameraView(
            image=image,
            camera=self._cameras[role],
            T_rig_camera=self._T_rig_camera[role],
            mask=mask,
            epoch=frame.epoch,
            gap=frame.gap,
        )


def assemble(
    rectifier: Rectifier,
    first: RadiometricFrame | None,
    second: RadiometricFrame | None,
    stamp_ns: int,
) -> RigFrame:
    """The rectified rig frame of a pair; an eye that is missing or blind has no view."""
    views: dict[str, CameraView] = {}
    blind: dict[str, GapReason] = {}
    for role, frame in ((LEFT, first), (RIGHT, second)):
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
        _coefficients(left.camera),
        right.camera.matrix,
        _coefficients(right.camera),
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


def _coefficients(camera: Camera) -> NDArray[np.float64]:
    if camera.model is DistortionModel.NONE:
        return np.zeros(5)
    return np.array(camera.distortion, dtype=np.float64)


def _undistortion_maps(
    camera: Camera, R: NDArray[np.float64], P: NDArray[np.float64]
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    build = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.model is DistortionModel.EQUIDISTANT
        else cv2.initUndistortRectifyMap
    )
    map_x, map_y = build(
        camera.matrix, _coefficients(camera), R, P[:, :3], camera.size, cv2.CV_16SC2
    )
    return map_x, map_y


def _seen(map_xy: NDArray[np.int16], raw_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) True where all four neighbours of the sample lie in the raw image."""
    width, height = raw_size
    x, y = map_xy[..., 0], map_xy[..., 1]
    return (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
