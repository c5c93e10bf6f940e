"""Geometry of a rectified stereo pair: triangulation, reprojection and its Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.core.transforms import transform_points


@dataclass(frozen=True)
class StereoCamera:
    """Rectified pair: focal lengths and principal points in px, baseline in m.

    ``cx_right`` differs from ``cx`` where the rectification shifted the right image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    cx_right: float
    baseline_m: float

    @classmethod
    def of(cls, left: CameraView, right: CameraView) -> StereoCamera:
        """The pair that two rectified views make up.

        Raises CalibrationError when rows or focal lengths do not agree, or lenses are not ideal.
        """
        a, b = left.camera, right.camera
        same_focal = abs(a.fx - b.fx) <= 1e-6 * a.fx and abs(a.fy - b.fy) <= 1e-6 * a.fy
        same_rows = abs(a.cy - b.cy) <= 1e-3
        if not (same_focal and same_rows) or a.has_distortion or b.has_distortion:
            raise CalibrationError(
                "the feature method needs rectified images: fx, fy and cy of both eyes must agree "
                f"(left {a.fx:g}, {a.fy:g}, {a.cy:g}; right {b.fx:g}, {b.fy:g}, {b.cy:g}) and no "
                "lens may bend rays; rectify first"
            )
        return cls(a.fx, a.fy, a.cx, a.cy, b.cx, float(right.T_rig_camera[0, 3]))

    @property
    def parameters(self) -> NDArray[np.float64]:
        """(6,) fx fy cx cy cx_right baseline_m, the form the kernels take."""
        return np.array([self.fx, self.fy, self.cx, self.cy, self.cx_right, self.baseline_m])

    def triangulate(
        self, left: NDArray[np.floating], right: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """(N, 2) and (N, 2) matched pixels to (N, 3) points in the left camera (m).

        The row is the mean of both; pairs without positive disparity become NaN.
        """
        left = np.asarray(left, np.float64)
        right = np.asarray(right, np.float64)
        disparity = (left[:, 0] - self.cx) - (right[:, 0] - self.cx_right)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(disparity > 0.0, self.fx * self.baseline_m / disparity, np.nan)
        x = (left[:, 0] - self.cx) / self.fx * z
        y = (0.5 * (left[:, 1] + right[:, 1]) - self.cy) / self.fy * z
        return np.stack([x, y, z], axis=1)

    def project(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 3) points in the left camera to (N, 4) uL vL uR vR; NaN behind the camera."""
        points = np.asarray(points_m, np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        u = self.fx * points[:, 0] / z
        v = self.fy * points[:, 1] / z + self.cy
        shift = self.fx * self.baseline_m / z
        return np.stack([u + self.cx, v, u - shift + self.cx_right, v], axis=1)

    def predict_right(
        self,
        left: NDArray[np.floating],
        right: NDArray[np.floating],
        T_other_this: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """(N, 2) where matched points of this frame would appear in the other right image.

        Points that would lie behind the camera keep their pixel.
        """
        points = transform_points(T_other_this, self.triangulate(left, right))
        predicted = self.project(points)[:, 2:]
        return np.where(np.isfinite(predicted), predicted, right)


@njit(cache=True, nogil=True)
def reprojection_cost(T, points, observed, weights, camera):  # type: ignore[no-untyped-def]
    """Half the weighted sum of squared reprojection errors in both eyes (P1 eq. 2), px^2.

    ``T`` (4, 4) maps the (N, 3) ``points`` into the current left camera; ``observed`` (N, 4) uL vL
    uR vR; ``weights`` (N,).  Infinite when a point falls behind the camera.
    """
    fx, fy, cx, cy, cx_right, baseline = camera
    cost = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if pz <= 1e-6:
            return np.inf
        iz = 1.0 / pz
        v = fy * py * iz + cy
        r0 = observed[i, 0] - (fx * px * iz + cx)
        r1 = observed[i, 1] - v
        r2 = observed[i, 2] - (fx * (px - baseline) * iz + cx_right)
        r3 = observed[i, 3] - v
        cost += weights[i] * (r0 * r0 + r1 * r1 + r2 * r2 + r3 * r3)
    return 0.5 * cost


@njit(cache=True, nogil=True)
def linearise_reprojection(T, points, observed, weights, camera, A, g):  # type: ignore[no-untyped-def]
    """Normal equations of P1 eq. (2) at ``T``; returns the cost as ``reprojection_cost``.

    With residual r = x - f(p) and J = df/dp writes A = J'WJ (6, 6) and g = J'Wr (6,) for the left
    perturbation T <- Exp(delta) T, delta = (rho, phi).
    """
    fx, fy, cx, cy, cx_right, baseline = camera
    A[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    J = np.empty((4, 6))
    r = np.empty(4)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if pz <= 1e-6:
            return np.inf
        iz = 1.0 / pz
        v = fy * py * iz + cy
        r[0] = observed[i, 0] - (fx * px * iz + cx)
        r[1] = observed[i, 1] - v
        r[2] = observed[i, 2] - (fx * (px - baseline) * iz + cx_right)
        r[3] = observed[i, 3] - v
        for eye in range(2):
            ex = px - eye * baseline
            a, b, c = fx * iz, -fx * ex * iz * iz, 0.0
            # d(u)/d(point) = (a, 0, b); d(point)/d(delta) = [I, -skew(point)].
            J[2 * eye, 0] = a
            J[2 * eye, 1] = c
            J[2 * eye, 2] = b
            J[2 * eye, 3] = b * py
            J[2 * eye, 4] = a * pz - b * px
            J[2 * eye, 5] = -a * py
            a, b = fy * iz, -fy * py * iz * iz
            J[2 * eye + 1, 0] = 0.0
            J[2 * eye + 1, 1] = a
            J[2 * eye + 1, 2] = b
            J[2 * eye + 1, 3] = b * py - a * pz
            J[2 * eye + 1, 4] = -b * px
            J[2 * eye + 1, 5] = a * px
        w = weights[i]
        for k in range(4):
            cost += w * r[k] * r[k]
            for m in range(6):
                jm = w * J[k, m]
                g[m] += jm * r[k]
                for n in range(m, 6):
                    A[m, n] += jm * J[k, n]
    for m in range(6):
        for n in range(m):
            A[m, n] = A[n, m]
    return 0.5 * cost


def reprojection_residuals(
    T: NDArray[np.float64],
    points: NDArray[np.float64],
    observed: NDArray[np.float64],
    camera: StereoCamera,
) -> NDArray[np.float64]:
    """(N, 4) residuals x - f(p) in px, the plain numpy form of the kernels."""
    return observed - camera.project(transform_points(T, points))
