"""Residuals of points with an inverse depth in their host keyframe, and their Jacobians.

A point is the centre of a patch of its host: bearing b = (x, y, 1) there and inverse depth rho.
With T = T_camera_host = (R, t) it appears in another rectified pair at the projection of
p = R b + rho t (the true point times rho), so that rho = 0, a point at infinity, is no special
case.  The right eye sees p - rho (baseline, 0, 0), turned by the small rotation that is left of the
extrinsics after rectification.  Fixed triangulated points bias the motion (the
noise of a disparity does not average out of 1 / disparity); free inverse depths do not.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera

COMPONENTS = 4
"""An observation is uL, vL, uR, vR; NaN where an eye did not see the point.

Only a blind left eye makes vR count, so that an error of the rectification between the eyes does
not enter twice.
"""


@njit(cache=True, nogil=True)
def relative_transform(T_c_w, T_h_w, R, t):  # type: ignore[no-untyped-def]
    """Write rotation (3, 3) and translation (3,) of ``T_c_w @ inverse(T_h_w)``."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += T_c_w[i, k] * T_h_w[j, k]
            R[i, j] = total
    for i in range(3):
        total = T_c_w[i, 3]
        for k in range(3):
            total -= R[i, k] * T_h_w[k, 3]
        t[i] = total


@njit(cache=True, nogil=True)
def point_in_camera(R, t, bearing, rho, p):  # type: ignore[no-untyped-def]
    """Write p = R b + rho t (3,)."""
    for i in range(3):
        p[i] = R[i, 0] * bearing[0] + R[i, 1] * bearing[1] + R[i, 2] * bearing[2] + rho * t[i]


@njit(cache=True, nogil=True)
def in_right_eye(p, rho, eyes, q):  # type: ignore[no-untyped-def]
    """Write the point as the right eye sees it (3,): moved by the baseline, then turned."""
    baseline, turn_x, turn_y, turn_z = eyes[5:]
    x, y, z = p[0] - rho * baseline, p[1], p[2]
    q[0] = x + turn_y * z - turn_z * y
    q[1] = y + turn_z * x - turn_x * z
    q[2] = z + turn_x * y - turn_y * x


@njit(cache=True, nogil=True)
def residual_row(component, p, rho, observed, eyes, row, q):  # type: ignore[no-untyped-def]
    """Residual (px) of one component of an observation; NaN when it cannot be had.

    Writes to ``row`` (3,) the derivative of the predicted pixel with respect to ``p``; ``q`` (3,)
    is room for the point in axes of the eye, which stays there.
    """
    fx, fy, cx, cy, cx_right = eyes[:5]
    if component < 2:
        q[0], q[1], q[2] = p[0], p[1], p[2]
    else:
        in_right_eye(p, rho, eyes, q)
    if q[2] <= 1e-6:
        return np.nan
    iz = 1.0 / q[2]
    row[0] = row[1] = 0.0
    if component == 0 or component == 2:
        row[0] = fx * iz
        row[2] = -fx * q[0] * iz * iz
        predicted = fx * q[0] * iz + (cx if component == 0 else cx_right)
    else:
        row[1] = fy * iz
        row[2] = -fy * q[1] * iz * iz
        predicted = fy * q[1] * iz + cy
    if component >= 2:
        turn_x, turn_y, turn_z = eyes[6:]
        a, b, c = row[0], row[1], row[2]
        row[0] = a + b * turn_z - c * turn_y
        row[1] = b - a * turn_z + c * turn_x
        row[2] = c + a * turn_y - b * turn_x
    return observed - predicted


@njit(cache=True, nogil=True)
def uses_component(component, observation):  # type: ignore[no-untyped-def]
    """Whether this component of a (4,) observation enters the cost."""
    if np.isnan(observation[component]):
        return False
    return component != 3 or np.isnan(observation[0])


@njit(cache=True, nogil=True)
def counts(component, camera_index, host, observation):  # type: ignore[no-untyped-def]
    """Whether a component enters: in its host a point is the patch, only its disparity is open."""
    if camera_index == host and component != 2:
        return False
    return uses_component(component, observation)


@njit(cache=True, nogil=True)
def pose_rows(row, R, p, b, rho, Jc, Jh):  # type: ignore[no-untyped-def]
    """Write the (6,) derivatives of a pixel by the poses of the camera and of the point's host.

    ``row`` (3,) is that by the point ``p`` = R b + rho t in the camera.
    """
    Jc[0], Jc[1], Jc[2] = rho * row[0], rho * row[1], rho * row[2]
    Jc[3] = p[1] * row[2] - p[2] * row[1]
    Jc[4] = p[2] * row[0] - p[0] * row[2]
    Jc[5] = p[0] * row[1] - p[1] * row[0]
    x = row[0] * R[0, 0] + row[1] * R[1, 0] + row[2] * R[2, 0]
    y = row[0] * R[0, 1] + row[1] * R[1, 1] + row[2] * R[2, 1]
    z = row[0] * R[0, 2] + row[1] * R[1, 2] + row[2] * R[2, 2]
    Jh[0], Jh[1], Jh[2] = -rho * x, -rho * y, -rho * z
    Jh[3] = -(b[1] * z - b[2] * y)
    Jh[4] = -(b[2] * x - b[0] * z)
    Jh[5] = -(b[0] * y - b[1] * x)


@njit(cache=True, nogil=True)
def cauchy_weight(residual, scale):  # type: ignore[no-untyped-def]
    """Weight of a residual under the Cauchy kernel of width ``scale``."""
    return 1.0 / (1.0 + (residual / scale) ** 2)


@njit(cache=True, nogil=True)
def cauchy_cost(residual, scale):  # type: ignore[no-untyped-def]
    """Half squared residual, flattened by the Cauchy kernel."""
    return 0.5 * scale * scale * np.log1p((residual / scale) ** 2)


@njit(cache=True, nogil=True)
def predict_pixels(T_c_w, T_h_w, hosts, bearings, rhos, eyes, step_px, pixels, warps):  # type: ignore[no-untyped-def]
    """Where N points should appear, and how their patches are warped on the way.

    ``T_h_w`` (slots, 4, 4), ``hosts`` (N,) int64, ``bearings`` (N, 3), ``rhos`` (N,).  Writes
    ``pixels`` (N, 4) uL vL uR vR, NaN behind the camera, and ``warps`` (N, 2, 2), the derivative of
    the left pixel with respect to the host's pixel for a patch that faces the host.
    """
    fx, fy, cx, cy, cx_right = eyes[:5]
    R, t, p, q = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    moved = np.empty(3)
    last = -1
    for n in range(len(hosts)):
        if hosts[n] != last:
            last = hosts[n]
            relative_transform(T_c_w, T_h_w[last], R, t)
        rho = rhos[n]
        point_in_camera(R, t, bearings[n], rho, p)
        in_right_eye(p, rho, eyes, q)
        if p[2] <= 1e-3 or q[2] <= 1e-3:
            pixels[n] = np.nan
            continue
        pixels[n, 0] = fx * p[0] / p[2] + cx
        pixels[n, 1] = fy * p[1] / p[2] + cy
        pixels[n, 2] = fx * q[0] / q[2] + cx_right
        pixels[n, 3] = fy * q[1] / q[2] + cy
        for axis in range(2):
            moved[:] = bearings[n]
            moved[axis] += step_px / (fx if axis == 0 else fy)
            point_in_camera(R, t, moved, rho, q)
            depth = max(q[2], 1e-3)
            warps[n, 0, axis] = (fx * q[0] / depth + cx - pixels[n, 0]) / step_px
            warps[n, 1, axis] = (fy * q[1] / depth + cy - pixels[n, 1]) / step_px


def predict_pixels_reference(
    T_c_h: NDArray[np.float64],
    bearings: NDArray[np.float64],
    rhos: NDArray[np.float64],
    camera: StereoCamera,
    right_turn_rad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N, 4) uL vL uR vR of points of one host, the plain numpy form."""
    points = bearings / rhos[:, None] @ T_c_h[:3, :3].T + T_c_h[:3, 3]
    pixels = camera.project(points)
    right = points - [camera.baseline_m, 0.0, 0.0]
    turned = camera.project(right + np.cross(right_turn_rad, right))
    pixels[:, 2:] = turned[:, :2] + [camera.cx_right - camera.cx, 0.0]
    return pixels
