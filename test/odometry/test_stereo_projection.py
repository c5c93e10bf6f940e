"""Triangulation, projection and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.cameras import Camera, DistortionModel
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.core.transforms import exp_se3, inverse, make_transform, transform_points
from thermal_stereo_vo.odometry.feature_based.stereo_projection import (
    StereoCamera,
    linearise_reprojection,
    reprojection_cost,
    reprojection_residuals,
)

from .stereo_problems import CAMERA, make_problem, seen_points

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_normal_equations_are_those_of_the_numeric_jacobian(seed):
    """Random states away from the minimum; the sign of g is that of a descent step."""
    rng = np.random.default_rng(seed)
    problem = make_problem(rng, 25, weighted=True)
    T = exp_se3(rng.normal(0, (0.3, 0.3, 0.3, 0.05, 0.05, 0.05))) @ problem.T_true
    A, g = np.empty((6, 6)), np.empty(6)
    cost = linearise_reprojection(
        T, problem.points, problem.observed, problem.weights, CAMERA.parameters, A, g
    )
    A_numeric, g_numeric = problem.normal_equations(T)
    assert cost == pytest.approx(problem.cost(T), rel=1e-10)
    np.testing.assert_allclose(A, A_numeric, rtol=1e-6, atol=1e-6 * np.abs(A_numeric).max())
    np.testing.assert_allclose(g, g_numeric, rtol=1e-6, atol=1e-6 * np.abs(g_numeric).max())
    assert np.array_equal(A, A.T)
    step = 1e-9 * g / np.linalg.norm(g)
    assert problem.cost(exp_se3(step) @ T) < problem.cost(T)


@given(seeds)
def test_kernels_agree_with_the_plain_residuals(seed):
    rng = np.random.default_rng(seed)
    problem = make_problem(rng, 20, weighted=True)
    T = exp_se3(rng.normal(0, 0.05, 6)) @ problem.T_true
    arguments = problem.points, problem.observed, problem.weights, CAMERA.parameters
    plain = reprojection_residuals(T, problem.points, problem.observed, CAMERA)
    np.testing.assert_allclose(plain, problem.residuals(T), atol=1e-9)
    expected = 0.5 * np.sum(problem.weights[:, None] * plain**2)
    assert reprojection_cost(T, *arguments) == pytest.approx(expected, rel=1e-12)
    A, g = np.empty((6, 6)), np.empty(6)
    assert linearise_reprojection(T, *arguments, A, g) == pytest.approx(expected, rel=1e-12)


def test_a_point_behind_the_camera_costs_infinitely_much(rng):
    problem = make_problem(rng, 10)
    T = make_transform(np.eye(3), [0.0, 0.0, -100.0])
    arguments = T, problem.points, problem.observed, problem.weights, CAMERA.parameters
    assert reprojection_cost(*arguments) == np.inf
    assert linearise_reprojection(*arguments, np.empty((6, 6)), np.empty(6)) == np.inf


@given(seeds)
def test_triangulation_undoes_projection(seed):
    points = seen_points(np.random.default_rng(seed), 50)
    pixels = CAMERA.project(points)
    np.testing.assert_allclose(
        CAMERA.triangulate(pixels[:, :2], pixels[:, 2:]), points, rtol=1e-9, atol=1e-9
    )


def test_known_projection_by_hand():
    """1 m right, 2 m down, 10 m ahead; the right eye sees it fx * B / z further left."""
    uL, vL, uR, vR = CAMERA.project(np.array([[1.0, 2.0, 10.0]]))[0]
    assert (uL, vL) == pytest.approx((320.5 + 52.2, 255.0 + 105.2))
    assert (uR, vR) == pytest.approx((324.0 + 52.2 - 522.0 * 0.0268, vL))


def test_a_shifted_right_principal_point_does_not_change_depth():
    """Disparity counts from the principal points, not from the image border."""
    shifted = replace(CAMERA, cx_right=CAMERA.cx_right - 11.0)
    pixels = CAMERA.project(np.array([[0.5, 0.2, 8.0]]))
    moved = pixels - [0, 0, 11.0, 0]
    assert shifted.triangulate(moved[:, :2], moved[:, 2:])[0, 2] == pytest.approx(8.0)
    np.testing.assert_allclose(shifted.project(np.array([[0.5, 0.2, 8.0]])), moved)


def test_no_depth_without_positive_disparity():
    left = np.array([[320.5, 255.0], [320.5, 255.0], [320.5, 255.0]])
    right = np.array([[324.0, 255.0], [325.0, 255.0], [323.0, 255.0]])
    z = CAMERA.triangulate(left, right)[:, 2]
    assert np.isnan(z[:2]).all()
    assert z[2] == pytest.approx(522.0 * 0.268)
    assert np.isnan(CAMERA.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))).all()


def test_the_row_is_the_mean_of_both():
    point = CAMERA.triangulate(np.array([[400.0, 281.0]]), np.array([[390.0, 283.0]]))[0]
    assert CAMERA.project(point[None])[0, 1] == pytest.approx(282.0)


def test_predicted_place_in_the_other_right_image(rng):
    points = seen_points(rng, 30)
    T_other_this = exp_se3([0.2, -0.1, 0.5, 0.02, -0.03, 0.01])
    pixels = CAMERA.project(points)
    predicted = CAMERA.predict_right(pixels[:, :2], pixels[:, 2:], T_other_this)
    expected = CAMERA.project(transform_points(T_other_this, points))[:, 2:]
    np.testing.assert_allclose(predicted, expected, atol=1e-6)
    assert np.abs(predicted - pixels[:, 2:]).max() > 2.0


def test_points_that_cannot_be_predicted_keep_their_pixel():
    pixels = CAMERA.project(np.array([[0.0, 0.0, 5.0]]))
    left = np.vstack([pixels[:, :2], [[100.0, 100.0]]])
    right = np.vstack([pixels[:, 2:], [[200.0, 100.0]]])  # no disparity at all
    behind = make_transform(np.eye(3), [0.0, 0.0, -10.0])
    np.testing.assert_array_equal(CAMERA.predict_right(left, right, behind), right)


def view(fx=100.0, fy=100.0, cx=32.0, cy=24.0, baseline_m=0.0, **lens) -> CameraView:
    T = make_transform(np.eye(3), [baseline_m, 0.0, 0.0])
    return CameraView(np.zeros((48, 64), np.uint8), Camera(64, 48, fx, fy, cx, cy, **lens), T)


def test_the_pair_of_two_views():
    camera = StereoCamera.of(view(), view(cx=30.0, baseline_m=0.2))
    assert camera == StereoCamera(100.0, 100.0, 32.0, 24.0, 30.0, 0.2)
    np.testing.assert_array_equal(camera.parameters, [100.0, 100.0, 32.0, 24.0, 30.0, 0.2])


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (view(), view(fy=101.0, baseline_m=0.2)),
        (view(), view(fx=101.0, baseline_m=0.2)),
        (view(), view(cy=24.5, baseline_m=0.2)),
        (view(model=DistortionModel.RADIAL_TANGENTIAL, distortion=(0.1, 0, 0, 0)),
         view(baseline_m=0.2)),
        (view(),
         view(baseline_m=0.2, model=DistortionModel.RADIAL_TANGENTIAL, distortion=(0.1, 0, 0, 0))),
    ],
    ids=["fy", "fx", "cy", "left lens", "right lens"],
)  # fmt: skip
def test_views_that_are_not_rectified_are_refused(left, right):
    with pytest.raises(CalibrationError, match="the feature method needs rectified images"):
        StereoCamera.of(left, right)


def test_motion_convention_points_move_against_the_camera():
    """T maps old coordinates to new ones: a rig that went ahead by 1 m sees points 1 m nearer."""
    T_world_after = make_transform(np.eye(3), [0.0, 0.0, 1.0])
    T_after_before = inverse(T_world_after)
    residual = reprojection_residuals(
        T_after_before,
        np.array([[1.0, 1.0, 10.0]]),
        CAMERA.project(np.array([[1.0, 1.0, 9.0]])),
        CAMERA,
    )
    np.testing.assert_allclose(residual, 0.0, atol=1e-9)
