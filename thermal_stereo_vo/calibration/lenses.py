"""Lens models a calibration may fit, as parameter vectors with derivatives."""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera, DistortionModel

Array = NDArray[np.float64]


class Lens(Enum):
    """Distortion coefficients beside fx, fy, cx, cy.

    ``radtan4`` (k1 k2 p1 p2) is what P1 used and enough for the Tau 2 with a 9 mm lens; ``radtan2``
    leaves out p1 and p2, ``radtan5`` adds k3, ``rational`` k3 to k6; ``equidistant`` is for wide
    angles.
    """

    NONE = "none"
    RADTAN2 = "radtan2"
    RADTAN4 = "radtan4"
    RADTAN5 = "radtan5"
    RATIONAL = "rational"
    EQUIDISTANT = "equidistant"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters in order."""
        return ("fx", "fy", "cx", "cy", *_COEFFICIENTS[self])

    @property
    def opencv_count(self) -> int:
        """Length of OpenCV's coefficient vector for this model."""
        return {Lens.RADTAN5: 5, Lens.RATIONAL: 8}.get(self, 4)

    @property
    def calibration_flags(self) -> int:
        """Flags that make ``cv2.calibrateCamera`` fit this model (not for ``equidistant``)."""
        fixed = {
            Lens.NONE: cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
            Lens.RADTAN2: cv2.CALIB_FIX_K3,
            Lens.RADTAN4: cv2.CALIB_FIX_K3,
            Lens.RATIONAL: cv2.CALIB_RATIONAL_MODEL,
        }.get(self, 0)
        if self in (Lens.NONE, Lens.RADTAN2):
            fixed |= cv2.CALIB_ZERO_TANGENT_DIST
        return int(fixed)


_COEFFICIENTS = {
    Lens.NONE: (),
    Lens.RADTAN2: ("k1", "k2"),
    Lens.RADTAN4: ("k1", "k2", "p1", "p2"),
    Lens.RADTAN5: ("k1", "k2", "p1", "p2", "k3"),
    Lens.RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    Lens.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
}


def lens_of(camera: Camera) -> Lens:
    """The smallest lens model that holds a camera's coefficients."""
    if camera.model is DistortionModel.EQUIDISTANT:
        return Lens.EQUIDISTANT
    if not camera.has_distortion:
        return Lens.NONE
    count = len(np.trim_zeros(np.asarray(camera.distortion), "b"))
    return Lens.RADTAN4 if count <= 4 else Lens.RADTAN5 if count == 5 else Lens.RATIONAL


def to_camera(lens: Lens, parameters: Array, size: tuple[int, int]) -> Camera:
    """A camera of (width, height) from a parameter vector in the order of ``lens.names``."""
    fx, fy, cx, cy = parameters[:4].tolist()
    model = {
        Lens.NONE: DistortionModel.NONE,
        Lens.EQUIDISTANT: DistortionModel.EQUIDISTANT,
    }.get(lens, DistortionModel.RADIAL_TANGENTIAL)
    coefficients = tuple(float(c) for c in _opencv_coefficients(lens, parameters))
    if lens is Lens.NONE:
        coefficients = ()
    return Camera(*size, fx, fy, cx, cy, model, coefficients)


def from_camera(lens: Lens, camera: Camera) -> Array:
    """The parameter vector of a camera, coefficients it lacks being zero."""
    coefficients = np.zeros(len(lens.names) - 4)
    known = np.asarray(camera.distortion, dtype=np.float64)[: len(coefficients)]
    coefficients[: len(known)] = known
    return np.concatenate([[camera.fx, camera.fy, camera.cx, camera.cy], coefficients])


def project(lens: Lens, parameters: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels of (K, 3) points in camera axes, with derivatives.

    Returns pixels (K, 2), derivatives by the point (K, 2, 3) and by the parameters (K, 2, P).
    """
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    coefficients = _opencv_coefficients(lens, parameters)
    cloud = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
    free = len(lens.names) - 4
    if lens is Lens.EQUIDISTANT:
        pixels, jacobian = cv2.fisheye.projectPoints(cloud, zero, zero, matrix, coefficients)
        jacobian = jacobian.reshape(-1, 2, jacobian.shape[1])
        # Columns: f (2), c (2), k (4), rotation (3), translation (3), skew.
        by_parameters = jacobian[:, :, :8]
        by_point = jacobian[:, :, 11:14]
    else:
        pixels, jacobian = cv2.projectPoints(cloud, zero, zero, matrix, coefficients)
        jacobian = jacobian.reshape(-1, 2, jacobian.shape[1])
        # Columns: rotation (3), translation (3), f (2), c (2), coefficients.
        by_parameters = jacobian[:, :, 6 : 10 + free]
        by_point = jacobian[:, :, 3:6]
    return pixels.reshape(-1, 2), by_point, by_parameters


def _opencv_coefficients(lens: Lens, parameters: Array) -> Array:
    coefficients = np.zeros(lens.opencv_count)
    coefficients[: len(lens.names) - 4] = parameters[4:]
    return coefficients
