"""Cameras of any kind side by side: each is freed of its own distortion, none is turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera, DistortionModel, RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView, RadiometricFrame
from thermal_stereo_vo.core.transforms import identity, inverse, transform_points
from thermal_stereo_vo.stereo.remapping import RemappedCamera, coefficients

LEAST_COMMON_PERCENT = 20.0
COMMON_DEPTHS_M = (2.0, 10.0, 1000.0)
SAMPLES_PER_SIDE = 24


class Undistorter:
    """Views without distortion of a rig whose cameras may differ in size, lens and band.

    The rig frame stays that of the calibration.  ``alpha`` 0 keeps the pinhole of the lens, so that
    the middle of the picture is sampled as finely as it was taken; 1 keeps the whole raw image
    (OpenCV ``getOptimalNewCameraMatrix``).

    Raises CalibrationError for cameras that look at different places.
    """

    def __init__(
        self, calibration: RigCalibration, roles: Sequence[str], alpha: float = 0.0
    ) -> None:
        self.roles = tuple(roles)
        self.T_rig_rectified = identity()
        self._calibration = calibration
        self._cameras = {
            role: _remapped(calibration, role, alpha) for role in self.roles
        }  # fmt: skip
        _check_common_view(self._cameras, calibration.origin)

    @property
    def rectified_calibration(self) -> RigCalibration:
        """The rig that the views obey."""
        ideal = {
            role: replace(
                self._calibration[role],
                camera=remapped.camera,
                rectification=None,
                projection=None,
            )
            for role, remapped in self._cameras.items()
        }
        return replace(self._calibration, cameras=ideal, rectified=False)

    def process(self, frame: RadiometricFrame, role: str) -> CameraView | None:
        """The view of one camera, or None while it is blind.

        Raises FrameError for an image of another size than the calibration's.
        """
        return self._cameras[role].process(frame, role)


def common_percent(a: Camera, b: Camera, T_b_a: NDArray[np.float64], depth_m: float) -> float:
    """Share of the pixels of ``a`` whose points at this depth the image of ``b`` holds.

    Both cameras are ideal pinholes; ``T_b_a`` (4, 4) maps a to b.
    """
    columns = np.linspace(0.0, a.width - 1.0, SAMPLES_PER_SIDE)
    rows = np.linspace(0.0, a.height - 1.0, SAMPLES_PER_SIDE)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    found = b.project(transform_points(T_b_a, depth_m * a.unproject(pixels)))
    inside = np.all((found >= 0.0) & (found <= (b.width - 1.0, b.height - 1.0)), axis=1)
    return 100.0 * float(np.mean(inside))


def _remapped(calibration: RigCalibration, role: str, alpha: float) -> RemappedCamera:
    mounted = calibration[role]
    raw = mounted.camera
    R = np.eye(3) if raw.has_distortion else None
    return RemappedCamera(
        raw, _ideal(raw, alpha), R, mounted.T_rig_camera.copy(), calibration.origin
    )


def _ideal(raw: Camera, alpha: float) -> Camera:
    if not raw.has_distortion:
        return raw.without_distortion()
    K = raw.matrix
    if alpha > 0.0:
        if raw.model is DistortionModel.EQUIDISTANT:
            whole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                K, coefficients(raw), raw.size, np.eye(3), balance=1.0
            )
        else:
            whole = cv2.getOptimalNewCameraMatrix(K, coefficients(raw), raw.size, 1.0)[0]
        K = (1.0 - alpha) * K + alpha * whole
    return Camera(*raw.size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def _check_common_view(cameras: Mapping[str, RemappedCamera], origin: str) -> None:
    first, *others = cameras
    for other in others:
        a, b = cameras[first], cameras[other]
        T_b_a = inverse(b.T_rig_camera) @ a.T_rig_camera
        percent = max(
            max(
                common_percent(a.camera, b.camera, T_b_a, depth_m),
                common_percent(b.camera, a.camera, inverse(T_b_a), depth_m),
            )
            for depth_m in COMMON_DEPTHS_M
        )
        if percent < LEAST_COMMON_PERCENT:
            raise CalibrationError(
                f"the cameras {first} and {other} of {origin} share {percent:.0f} % of their "
                f"views, and {LEAST_COMMON_PERCENT:.0f} % are needed: check T_rig_camera, or turn "
                "the cameras to the same scene"
            )
