"""Camera models and the rig they are mounted on.

Models follow OpenCV: pinhole without distortion, radial-tangential (Brown; k1 k2 p1 p2 [k3 ...],
ROS ``plumb_bob``/``rational_polynomial``) and equidistant (Kannala-Brandt; k1..k4, OpenCV
``fisheye``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import identity, inverse

LEFT, RIGHT = "left", "right"
VISIBLE, THERMAL = "visible", "thermal"


class DistortionModel(Enum):
    """How a lens bends rays."""

    NONE = "none"
    RADIAL_TANGENTIAL = "radial_tangential"
    EQUIDISTANT = "equidistant"


@dataclass(frozen=True)
class Camera:
    """A pinhole with an optional distortion model.  Lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: DistortionModel = DistortionModel.NONE
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.all(np.isfinite(numbers)) or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(
                f"focal lengths ({self.fx}, {self.fy}) px must be positive and every parameter "
                "finite: calibrate the camera first"
            )
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(f"image size {self.width}x{self.height} must be positive")
        if self.model is DistortionModel.EQUIDISTANT and len(self.distortion) != 4:
            raise CalibrationError(
                f"the equidistant model has 4 coefficients, got {len(self.distortion)}"
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    @property
    def has_distortion(self) -> bool:
        """True when the lens bends rays: the equidistant one does so without coefficients too."""
        if self.model is DistortionModel.EQUIDISTANT:
            return True
        return self.model is not DistortionModel.NONE and any(self.distortion)

    def without_distortion(self) -> Camera:
        """The same pinhole with an ideal lens."""
        return replace(self, model=DistortionModel.NONE, distortion=())

    def project(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 3) points in camera axes to (N, 2) pixels; NaN for points not in front (z <= 0)."""
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        pixels = np.full((len(points), 2), np.nan)
        front = points[:, 2] > 0.0
        if not np.any(front):
            return pixels
        seen = points[front]
        if self.has_distortion:
            zero = np.zeros(3)
            project = (
                cv2.fisheye.projectPoints
                if self.model is DistortionModel.EQUIDISTANT
                else cv2.projectPoints
            )
            projected = project(
                np.ascontiguousarray(seen).reshape(-1, 1, 3),
                zero,
                zero,
                self.matrix,
                np.array(self.distortion, dtype=np.float64),
            )[0].reshape(-1, 2)
        else:
            projected = seen[:, :2] / seen[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)
        pixels[front] = projected
        return pixels

    def unproject(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 2) pixels to (N, 3) rays with z = 1, distortion removed iteratively to 1e-10."""
        px = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        if self.has_distortion:
            coefficients = np.array(self.distortion, dtype=np.float64)
            if self.model is DistortionModel.EQUIDISTANT:
                plane = cv2.fisheye.undistortPoints(px.reshape(-1, 1, 2), self.matrix, coefficients)
            else:
                criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
                undistort = getattr(cv2, "undistortPointsIter", None)
                if undistort is not None:
                    plane = undistort(
                        px.reshape(-1, 1, 2),
                        self.matrix,
                        coefficients,
                        np.eye(3),
                        np.eye(3),
                        criteria,
                    )
                else:  # OpenCV 5 takes the criteria directly
                    plane = cv2.undistortPoints(
                        px.reshape(-1, 1, 2), self.matrix, coefficients, criteria=criteria
                    )
            plane = plane.reshape(-1, 2)
        else:
            plane = (px - (self.cx, self.cy)) / (self.fx, self.fy)
        return np.column_stack([plane, np.ones(len(plane))])


@dataclass(frozen=True)
class RigCamera:
    """A camera on the rig.

    ``T_rig_camera`` maps camera to rig coordinates (m).  ``rectification`` (3, 3) and
    ``projection`` (3, 4) are ROS's R and P when the calibration file brings them, else None and the
    rectifier computes its own.
    """

    camera: Camera
    T_rig_camera: NDArray[np.float64] = field(default_factory=identity)
    rectification: NDArray[np.float64] | None = None
    projection: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class RigCalibration:
    """Cameras by role, in a common rig frame.

    ``rectified`` says that the images already are row-aligned and free of distortion.  ``origin``
    names the file or recording, for messages.  ``T_base_rig`` maps rig to ``base_link``
    coordinates when the calibration knows it, ``T_rig_imu`` those of an IMU to the rig's.
    """

    cameras: Mapping[str, RigCamera]
    rectified: bool = False
    origin: str = ""
    T_base_rig: NDArray[np.float64] | None = None
    T_rig_imu: NDArray[np.float64] | None = None

    def __getitem__(self, role: str) -> RigCamera:
        try:
            return self.cameras[role]
        except KeyError:
            have = ", ".join(self.cameras) or "none"
            raise CalibrationError(
                f"the calibration {self.origin} has no camera '{role}' (it has: {have})"
            ) from None

    def T_a_b(self, a: str, b: str) -> NDArray[np.float64]:
        """(4, 4) from camera ``b`` to camera ``a``."""
        return inverse(self[a].T_rig_camera) @ self[b].T_rig_camera

    @property
    def baseline_m(self) -> float:
        """Distance of the right camera from the left along the left camera's x axis, signed."""
        return float(self.T_a_b(LEFT, RIGHT)[0, 3])

    @property
    def R_rig_imu(self) -> NDArray[np.float64]:
        """(3, 3) from axes of the IMU to the rig's; without ``T_rig_imu`` its axes are the base's.

        A rig that does not know its base looks forward.
        """
        if self.T_rig_imu is not None:
            return self.T_rig_imu[:3, :3]
        T_base_rig = default_T_base_rig() if self.T_base_rig is None else self.T_base_rig
        return T_base_rig[:3, :3].T

    @property
    def imu_position_m(self) -> NDArray[np.float64]:
        """(3,) where the IMU sits in the rig; without ``T_rig_imu`` at the origin of the base."""
        if self.T_rig_imu is not None:
            return self.T_rig_imu[:3, 3]
        T_base_rig = default_T_base_rig() if self.T_base_rig is None else self.T_base_rig
        return inverse(T_base_rig)[:3, 3]

    def check_stereo(self) -> None:
        """Refuse a pair that no stereo method can work with.

        Raises CalibrationError for a zero baseline, swapped eyes, or eyes above each other.
        """
        offset_m = self.T_a_b(LEFT, RIGHT)[:3, 3]
        length_m = float(np.linalg.norm(offset_m))
        if length_m < 1e-4:
            raise CalibrationError(
                f"the baseline of {self.origin} is {length_m * 1e3:.3f} mm: a stereo pair needs "
                "two cameras apart from each other; check the translation (ROS: right P[3] = -fx*B)"
            )
        if abs(offset_m[0]) < 0.5 * length_m:
            raise CalibrationError(
                f"the cameras of {self.origin} are not side by side (right eye at {offset_m} m "
                "from the left): turn the rig or its calibration so that the baseline is along x"
            )
        if offset_m[0] < 0:
            raise CalibrationError(
                f"the eyes of {self.origin} are swapped: the right camera lies {length_m:.3f} m to "
                "the LEFT of the left one; exchange the left and right images or calibrations"
            )
        left, right = self[LEFT].camera, self[RIGHT].camera
        if left.size != right.size:
            raise CalibrationError(
                f"left is {left.width}x{left.height} and right {right.width}x{right.height} pixels "
                f"in {self.origin}: both eyes must have the same size"
            )


def default_T_base_rig() -> NDArray[np.float64]:
    """Forward-looking camera at the origin of ``base_link``: optical z is body x (REP-103)."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    return T
