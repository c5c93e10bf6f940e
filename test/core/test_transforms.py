"""Rigid motions: laws of the group, near 0, near pi, and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from thermal_stereo_vo.core.transforms import (
    adjoint,
    exp_se3,
    exp_so3,
    identity,
    interpolate,
    inverse,
    left_jacobian_so3,
    log_se3,
    log_so3,
    make_transform,
    orthonormalised,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    skew,
    transform_points,
)

components = st.floats(-1.0, 1.0, allow_nan=False)
directions = (
    st.tuples(components, components, components)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)
# Small angles down to nothing, large ones up to a hair before pi, and all between.
angles = st.one_of(
    st.floats(-12.0, 0.4).map(lambda e: 10.0**e),
    st.floats(-9.0, 0.0).map(lambda e: np.pi - 10.0**e),
)
rotation_vectors = st.tuples(directions, angles).map(lambda da: da[0] * da[1])
translations = st.tuples(*[st.floats(-50.0, 50.0)] * 3).map(np.array)
motions = st.tuples(translations, rotation_vectors).map(np.concatenate)


def hat(xi):
    """(4, 4) of the Lie algebra."""
    X = np.zeros((4, 4))
    X[:3, :3] = skew(xi[3:])
    X[:3, 3] = xi[:3]
    return X


@given(rotation_vectors)
def test_exp_so3_is_the_rotation_of_scipy(phi):
    R = exp_so3(phi)
    np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


@given(rotation_vectors)
@example(np.zeros(3))
@example(np.array([1e-9, -2e-9, 3e-10]))
@example(np.array([0.0, 0.0, 0.99999e-5]))
@example(np.array([0.0, 1.00001e-5, 0.0]))
def test_log_so3_undoes_exp(phi):
    np.testing.assert_allclose(log_so3(exp_so3(phi)), phi, rtol=1e-7, atol=1e-12)


@given(directions)
def test_log_so3_at_pi_gives_the_axis_up_to_sign(axis):
    phi = log_so3(2.0 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(phi) == pytest.approx(np.pi, abs=1e-6)
    assert abs(phi @ axis) == pytest.approx(np.pi, abs=1e-6)


@given(motions)
def test_exp_se3_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(exp_se3(xi), expm(hat(xi)), atol=1e-9)


@given(motions)
@example(np.zeros(6))
def test_log_se3_undoes_exp(xi):
    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, rtol=1e-6, atol=1e-7)


def test_log_se3_is_the_matrix_logarithm(rng):
    for _ in range(20):
        T = exp_se3(rng.normal(0, 1, 6))
        np.testing.assert_allclose(hat(log_se3(T)), np.real(logm(T)), atol=1e-9)


@given(motions, translations)
def test_inverse_takes_points_back(xi, point):
    T_a_b = exp_se3(xi)
    there = transform_points(T_a_b, point[None])
    np.testing.assert_allclose(transform_points(inverse(T_a_b), there)[0], point, atol=1e-9)
    np.testing.assert_allclose((T_a_b @ [*point, 1.0])[:3], there[0], atol=1e-9)


@given(motions, motions)
@settings(max_examples=50)
def test_adjoint_moves_a_perturbation_to_the_other_side(xi, small):
    T, e = exp_se3(xi), 1e-3 * small
    np.testing.assert_allclose(T @ exp_se3(e) @ inverse(T), exp_se3(adjoint(T) @ e), atol=1e-8)


@given(rotation_vectors.filter(lambda v: np.linalg.norm(v) < 3.0))
def test_left_jacobian_by_central_differences(phi):
    step = 1e-6
    J = np.empty((3, 3))
    for k in range(3):
        e = np.zeros(3)
        e[k] = step
        ahead = exp_so3(phi + e) @ exp_so3(phi).T
        behind = exp_so3(phi - e) @ exp_so3(phi).T
        J[:, k] = (log_so3(ahead) - log_so3(behind)) / (2 * step)
    np.testing.assert_allclose(left_jacobian_so3(phi), J, atol=1e-7)


@given(rotation_vectors)
def test_quaternions_go_round_and_agree_with_scipy(phi):
    R = exp_so3(phi)
    quat_xyzw = quat_xyzw_from_rotation(R)
    assert np.linalg.norm(quat_xyzw) == pytest.approx(1.0, abs=1e-12)
    assert quat_xyzw[3] >= 0.0
    np.testing.assert_allclose(rotation_from_quat_xyzw(quat_xyzw), R, atol=1e-12)
    other = Rotation.from_matrix(R).as_quat()
    assert abs(quat_xyzw @ other) == pytest.approx(1.0, abs=1e-12)


def test_quaternion_order_is_xyzw():
    quarter_turn_about_z = rotation_from_quat_xyzw([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(quarter_turn_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_quaternion_is_normalised_first_and_must_not_be_zero():
    np.testing.assert_allclose(rotation_from_quat_xyzw([0, 0, 0, 7.0]), np.eye(3))
    with pytest.raises(ValueError, match="a quaternion of length zero is no rotation"):
        rotation_from_quat_xyzw([0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="length zero"):
        rotation_from_quat_xyzw([0.0, 0.0, 0.0, np.nan])


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3)]))
def test_quaternion_of_half_turns(axis):
    """Each branch of Shepperd's method: the trace is -1."""
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(rotation_from_quat_xyzw(quat_xyzw_from_rotation(R)), R, atol=1e-12)


@given(motions)
@settings(max_examples=50)
def test_orthonormalised_removes_rounding_and_nothing_else(xi):
    T = exp_se3(xi)
    np.testing.assert_allclose(orthonormalised(T), T, atol=1e-10)
    rough = T.copy()
    rough[:3, :3] += 1e-4 * np.sin(np.arange(9)).reshape(3, 3)
    smooth = orthonormalised(rough)
    np.testing.assert_allclose(smooth[:3, :3] @ smooth[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(smooth[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(smooth, T, atol=1e-3)


def test_orthonormalised_never_mirrors():
    mirrored = np.diag([1.0, 1.0, -0.9, 1.0])
    assert np.linalg.det(orthonormalised(mirrored)[:3, :3]) == pytest.approx(1.0)


@given(motions, motions)
@settings(max_examples=50)
def test_interpolation_meets_both_ends(xi0, xi1):
    T0, T1 = exp_se3(xi0), exp_se3(xi0) @ exp_se3(0.3 * xi1)
    np.testing.assert_allclose(interpolate(T0, T1, 0.0), T0, atol=1e-9)
    np.testing.assert_allclose(interpolate(T0, T1, 1.0), T1, atol=1e-6)
    half = interpolate(T0, T1, 0.5)
    np.testing.assert_allclose(inverse(T0) @ half, inverse(half) @ T1, atol=1e-6)


def test_skew_is_the_cross_product(rng):
    v, w = rng.normal(size=(2, 3))
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-14)


def test_identity_is_fresh():
    identity()[0, 0] = 5.0
    assert identity()[0, 0] == 1.0


def test_make_transform_and_inverse_of_a_known_motion():
    """A quarter turn about z and a step along x, by hand."""
    T_a_b = make_transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(transform_points(T_a_b, np.array([[2.0, 0, 0]])), [[1.0, 2.0, 0.0]])
    np.testing.assert_allclose(inverse(T_a_b)[:3, 3], [0.0, 1.0, 0.0], atol=1e-15)
