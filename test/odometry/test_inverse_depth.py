"""Points with an inverse depth: where they are seen, and how that changes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, inverse, transform_points
from thermal_stereo_vo.odometry.feature_based.inverse_depth import (
    cauchy_cost,
    cauchy_weight,
    in_right_eye,
    point_in_camera,
    predict_pixels,
    predict_pixels_reference,
    relative_transform,
    residual_row,
    uses_component,
)

from .stereo_problems import CAMERA, seen_points
from .window_problems import NO_TURN, TURN, bearings_of, eyes_of, numeric_jacobian, seen_by

NAN = np.nan
seeds = st.integers(0, 2**32 - 1)
components = pytest.mark.parametrize("component", range(4), ids=("uL", "vL", "uR", "vR"))


def poses(rng, n):
    return np.array([exp_se3(rng.normal(0, [0.4] * 3 + [0.1] * 3)) for _ in range(n)])


def scene(rng, n=40, slots=3):
    """Poses of a camera and of hosts, points with hosts, bearings and inverse depths."""
    T_c, T_h = poses(rng, 1)[0], poses(rng, slots)
    hosts = np.sort(rng.integers(0, slots, n))
    in_host = seen_points(rng, n)
    points_w = np.array(
        [transform_points(inverse(T_h[h]), p[None])[0] for h, p in zip(hosts, in_host, strict=True)]
    )
    bearings = in_host / in_host[:, 2:]
    return T_c, T_h, hosts, bearings, 1.0 / in_host[:, 2], points_w


def predict(T_c, T_h, hosts, bearings, rhos, turn, step_px=5.0):
    pixels, warps = np.full((len(hosts), 4), NAN), np.zeros((len(hosts), 2, 2))
    predict_pixels(T_c, T_h, hosts, bearings, rhos, eyes_of(turn), step_px, pixels, warps)
    return pixels, warps


# -------------------------------------------------------------------------------------- small parts


@given(seeds)
def test_relative_transform_is_the_product_with_the_inverse(seed):
    a, b = poses(np.random.default_rng(seed), 2)
    R, t = np.empty((3, 3)), np.empty(3)
    relative_transform(a, b, R, t)
    np.testing.assert_allclose(R, (a @ inverse(b))[:3, :3], atol=1e-13)
    np.testing.assert_allclose(t, (a @ inverse(b))[:3, 3], atol=1e-13)


@given(seeds)
def test_a_point_times_its_inverse_depth_is_the_scaled_point(seed):
    rng = np.random.default_rng(seed)
    T = poses(rng, 1)[0]
    point = seen_points(rng, 1)[0]
    rho = 1.0 / point[2]
    p = np.empty(3)
    point_in_camera(T[:3, :3].copy(), T[:3, 3].copy(), point * rho, rho, p)
    np.testing.assert_allclose(p / rho, transform_points(T, point[None])[0], rtol=1e-12, atol=1e-12)


def test_the_right_eye_is_moved_first_and_turned_then(rng):
    for point in seen_points(rng, 20):
        rho, q = 1.0 / point[2], np.empty(3)
        in_right_eye(point * rho, rho, eyes_of(TURN), q)
        moved = point - [CAMERA.baseline_m, 0.0, 0.0]
        np.testing.assert_allclose(q / rho, moved + np.cross(TURN, moved), rtol=1e-12, atol=1e-12)
        # To first order a rotation; what is left is of second order.
        off = np.linalg.norm(q / rho - exp_so3(TURN) @ moved) / np.linalg.norm(moved)
        assert 0.0 < off < 0.6 * TURN @ TURN


# -------------------------------------------------------------------------------- residuals, slopes


@components
@pytest.mark.parametrize("turn", [NO_TURN, TURN], ids=("straight", "turned"))
def test_residual_rows_are_the_slope_of_the_prediction(rng, component, turn):
    eyes = eyes_of(turn)
    for point in seen_points(rng, 30):
        rho = 1.0 / point[2]
        row, q = np.empty(3), np.empty(3)
        r = residual_row(component, point * rho, rho, 100.0, eyes, row, q)
        right = point - [CAMERA.baseline_m, 0.0, 0.0]
        seen = point if component < 2 else right + np.cross(turn, right)
        centre = (CAMERA.cx, CAMERA.cy, CAMERA.cx_right, CAMERA.cy)[component]
        focal = (CAMERA.fx, CAMERA.fy)[component % 2]
        assert r == pytest.approx(100.0 - focal * seen[component % 2] / seen[2] - centre, abs=1e-9)

        def predicted(p, rho=rho):
            return np.array(-residual_row(component, p, rho, 0.0, eyes, np.empty(3), np.empty(3)))

        slope = numeric_jacobian(predicted, point * rho)
        assert np.abs(slope).max() > 100.0
        np.testing.assert_allclose(row, slope, rtol=1e-6, atol=1e-4)


@components
def test_the_baseline_enters_as_the_bundle_says(rng, component):
    """d/drho at fixed p is -row[0] * baseline for the right eye, nothing for the left."""
    eyes = eyes_of(TURN)
    for point in seen_points(rng, 10):
        p, row, q = point / point[2], np.empty(3), np.empty(3)
        residual_row(component, p, 1.0 / point[2], 0.0, eyes, row, q)

        def predicted(rho, p=p):
            row, q = np.empty(3), np.empty(3)
            return np.array(-residual_row(component, p, rho[0], 0.0, eyes, row, q))

        slope = numeric_jacobian(predicted, np.array([1.0 / point[2]]))[0]
        expected = -row[0] * CAMERA.baseline_m if component >= 2 else 0.0
        assert slope == pytest.approx(expected, rel=1e-6, abs=1e-5)


@components
def test_nothing_is_predicted_behind_the_camera(component):
    for z in (0.0, -1.0):
        r = residual_row(
            component, np.array([0.1, 0.2, z]), 0.2, 0.0, eyes_of(), np.empty(3), np.empty(3)
        )
        assert np.isnan(r)


@components
@pytest.mark.parametrize(
    ("observation", "used"),
    [
        ((1.0, 2.0, 3.0, 4.0), (True, True, True, False)),
        ((1.0, 2.0, NAN, NAN), (True, True, False, False)),
        ((NAN, NAN, 3.0, 4.0), (False, False, True, True)),
        ((NAN, NAN, NAN, NAN), (False, False, False, False)),
    ],
    ids=("both", "left", "right", "blind"),
)
def test_the_right_row_counts_for_a_blind_left_eye_only(component, observation, used):
    assert uses_component(component, np.array(observation)) == used[component]


@given(st.floats(-100.0, 100.0).filter(lambda r: r == 0.0 or abs(r) > 1e-9), st.floats(0.05, 10.0))
def test_the_weight_is_the_slope_of_the_robust_cost(residual, scale):
    def cost(r):
        return np.array(cauchy_cost(r[0], scale))

    slope = numeric_jacobian(cost, np.array([residual]), 1e-5 * scale)[0]
    assert slope == pytest.approx(cauchy_weight(residual, scale) * residual, rel=1e-5, abs=1e-6)
    assert cauchy_cost(residual, scale) <= 0.5 * residual**2 * (1.0 + 1e-9)
    assert 0.0 < cauchy_weight(residual, scale) <= 1.0


def test_the_kernel_halves_a_residual_of_its_width():
    assert cauchy_weight(0.7, 0.7) == pytest.approx(0.5)
    assert cauchy_weight(0.0, 0.7) == 1.0
    assert cauchy_cost(1e-3, 1.0) == pytest.approx(0.5e-6, rel=1e-5)


# --------------------------------------------------------------------------------------- prediction


@pytest.mark.parametrize("turn", [NO_TURN, TURN], ids=("straight", "turned"))
def test_predictions_are_those_of_the_plain_form(rng, turn):
    T_c, T_h, hosts, bearings, rhos, points_w = scene(rng)
    pixels, _ = predict(T_c, T_h, hosts, bearings, rhos, turn)
    for host in range(len(T_h)):
        mine = hosts == host
        T_c_h = T_c @ inverse(T_h[host])
        plain = predict_pixels_reference(T_c_h, bearings[mine], rhos[mine], CAMERA, turn)
        np.testing.assert_allclose(pixels[mine], plain, rtol=1e-10, atol=1e-9)
    # The true rotation of the right eye differs by the second order: less than 0.05 px here.
    off = np.abs(pixels - seen_by(T_c, points_w, turn))
    assert np.nanmax(off[:, :2]) < 1e-9
    assert np.nanmax(off[:, 2:]) < (0.05 if turn.any() else 1e-9)


def test_a_point_at_infinity_stays_where_it_is_however_far_the_rig_goes(rng):
    bearings = bearings_of(rng.uniform((50, 50), (590, 460), (10, 2)))
    T_far = exp_se3([30.0, -20.0, 50.0, 0.0, 0.0, 0.0])
    pixels, warps = predict(
        T_far, np.eye(4)[None], np.zeros(10, np.int64), bearings, np.zeros(10), NO_TURN
    )
    np.testing.assert_allclose(bearings_of(pixels), bearings, atol=1e-12)
    disparity = pixels[:, 0] - CAMERA.cx - (pixels[:, 2] - CAMERA.cx_right)
    np.testing.assert_allclose(disparity, 0.0, atol=1e-9)
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (10, 1, 1)), atol=1e-9)


def test_warps_are_the_slope_of_the_left_pixel(rng):
    """Of a patch that faces its host: the depth along the axis is that of the centre."""
    T_c, T_h, hosts, bearings, rhos, _ = scene(rng, 20)
    _, warps = predict(T_c, T_h, hosts, bearings, rhos, TURN, step_px=1e-3)
    assert np.abs(warps - np.eye(2)).max() > 0.02
    for n, host in enumerate(hosts):
        T_c_h = T_c @ inverse(T_h[host])

        def left(offset, T=T_c_h, n=n):
            moved = bearings[n] + [offset[0] / CAMERA.fx, offset[1] / CAMERA.fy, 0.0]
            return predict_pixels_reference(T, moved[None], rhos[n : n + 1], CAMERA, NO_TURN)[0, :2]

        slope = numeric_jacobian(left, np.zeros(2), 1e-3)
        np.testing.assert_allclose(warps[n], slope, atol=2e-5)


@given(st.floats(0.3, 0.9))
def test_going_towards_a_wall_widens_its_patches(share):
    """At a share of the old distance everything is 1 / share as large."""
    bearings = np.array([[0.1, -0.05, 1.0]])
    T = exp_se3([0.0, 0.0, -10.0 * (1.0 - share), 0.0, 0.0, 0.0])
    _, warps = predict(
        T, np.eye(4)[None], np.zeros(1, np.int64), bearings, np.array([0.1]), NO_TURN
    )
    np.testing.assert_allclose(warps[0], np.eye(2) / share, rtol=1e-9, atol=1e-9)


def test_what_is_behind_the_camera_is_nowhere():
    T = exp_se3([0.0, 0.0, -20.0, 0.0, 0.0, 0.0])
    bearings = np.array([[0.1, -0.05, 1.0], [0.1, -0.05, 1.0]])
    pixels, _ = predict(
        T, np.eye(4)[None], np.zeros(2, np.int64), bearings, np.array([0.1, 0.01]), NO_TURN
    )
    assert np.isnan(pixels[0]).all()
    assert np.isfinite(pixels[1]).all()
