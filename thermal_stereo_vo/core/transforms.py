"""Rigid motions as (4, 4) float64 matrices, their exponential maps and quaternions.

Tangent vectors are ``xi = (rho, phi)``: translation (m) first, then rotation (rad).  Formulas after
Barfoot, State Estimation for Robotics, ch. 7, and Sola et al., A micro Lie theory (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-5


def identity() -> Matrix:
    """A fresh (4, 4) identity."""
    return np.eye(4)


def make_transform(rotation: ArrayLike, translation_m: ArrayLike) -> Matrix:
    """(4, 4) from a (3, 3) rotation and a (3,) translation."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def inverse(T_a_b: Matrix) -> Matrix:
    """T_b_a, by transposition of the rotation.

    >>> T = exp_se3(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.9]))
    >>> bool(np.allclose(inverse(T) @ T, np.eye(4)))
    True
    """
    rotation = T_a_b[:3, :3]
    return make_transform(rotation.T, -rotation.T @ T_a_b[:3, 3])


def transform_points(T_a_b: Matrix, points_b: NDArray[np.floating]) -> Matrix:
    """(N, 3) points in b to (N, 3) points in a."""
    return np.asarray(points_b, dtype=np.float64) @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def skew(v: ArrayLike) -> Matrix:
    """(3, 3) matrix with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(phi: ArrayLike) -> Matrix:
    """(3, 3) rotation of a (3,) rotation vector (Rodrigues).

    >>> exp_so3([0.0, 0.0, np.pi / 2]).round(12) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    phi = np.asarray(phi, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    K = skew(phi)
    if angle < _SMALL_ANGLE_RAD:
        rotation: Matrix = np.eye(3) + K + 0.5 * K @ K
        return rotation
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    rotation = np.eye(3) + a * K + b * (K @ K)
    return rotation


def log_so3(rotation: Matrix) -> Vector:
    """(3,) rotation vector, angle in [0, pi]; exact near 0 and near pi."""
    quat_xyzw = quat_xyzw_from_rotation(rotation)
    vector, scalar = quat_xyzw[:3], quat_xyzw[3]
    norm = float(np.linalg.norm(vector))
    if norm < 1e-12:
        return 2.0 * vector
    return float(2.0 * np.arctan2(norm, scalar) / norm) * vector


def left_jacobian_so3(phi: ArrayLike) -> Matrix:
    """(3, 3) J with Exp(phi + d) ~ Exp(J d) Exp(phi)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    K = skew(phi)
    if angle < _SMALL_ANGLE_RAD:
        a, b = 0.5, 1.0 / 6.0
    else:
        a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    J: Matrix = np.eye(3) + a * K + b * (K @ K)
    return J


def exp_se3(xi: ArrayLike) -> Matrix:
    """(4, 4) motion of a (6,) tangent vector (rho, phi)."""
    xi = np.asarray(xi, dtype=np.float64)
    return make_transform(exp_so3(xi[3:]), left_jacobian_so3(xi[3:]) @ xi[:3])


def log_se3(T: Matrix) -> Vector:
    """(6,) tangent vector (rho, phi) of a (4, 4) motion."""
    phi = log_so3(T[:3, :3])
    return np.concatenate([np.linalg.solve(left_jacobian_so3(phi), T[:3, 3]), phi])


def adjoint(T_a_b: Matrix) -> Matrix:
    """(6, 6) Ad with ``T Exp(xi) T^-1 == Exp(Ad xi)``, order (rho, phi)."""
    rotation = T_a_b[:3, :3]
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = rotation
    Ad[:3, 3:] = skew(T_a_b[:3, 3]) @ rotation
    return Ad


def rotation_from_quat_xyzw(quat_xyzw: ArrayLike) -> Matrix:
    """(3, 3) rotation of a quaternion (x, y, z, w), normalised first.

    Raises ValueError for a quaternion of length zero.
    """
    q = np.asarray(quat_xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not norm > 1e-9:
        raise ValueError("a quaternion of length zero is no rotation")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_xyzw_from_rotation(rotation: Matrix) -> Vector:
    """(4,) unit quaternion (x, y, z, w) with w >= 0 (Shepperd's method)."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    candidates = np.array([m[0, 0], m[1, 1], m[2, 2], trace])
    i = int(np.argmax(candidates))
    q = np.empty(4)
    if i == 3:
        q[3] = 1.0 + trace
        q[0] = m[2, 1] - m[1, 2]
        q[1] = m[0, 2] - m[2, 0]
        q[2] = m[1, 0] - m[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[j] = m[j, i] + m[i, j]
        q[k] = m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def orthonormalised(T: Matrix) -> Matrix:
    """The (4, 4) motion nearest to T: rounding errors of long products removed by SVD."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return make_transform(rotation, T[:3, 3])


def interpolate(T_a_b0: Matrix, T_a_b1: Matrix, fraction: float) -> Matrix:
    """The motion a ``fraction`` of the way from b0 to b1 along the screw between them."""
    return T_a_b0 @ exp_se3(fraction * log_se3(inverse(T_a_b0) @ T_a_b1))
