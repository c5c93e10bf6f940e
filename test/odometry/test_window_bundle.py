"""Keyframes and depths adjusted together, against plain and dense forms of the same problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    RHO_MIN,
    adjust_bundle,
    linearise_bundle,
    turn_information,
    window_residuals,
    window_residuals_reference,
)

from .stereo_problems import CAMERA
from .window_problems import (
    NO_TURN,
    TURN,
    eliminated,
    eyes_of,
    make_window,
    mean_nees_band,
    numeric_jacobian,
    poses_apart,
)

GAIN = CAMERA.fx * CAMERA.baseline_m
WIDTH_PX = 1.5
turns = pytest.mark.parametrize("turn", [NO_TURN, TURN], ids=("straight", "turned"))


def fixed(problem):
    return problem.hosts, problem.bearings, problem.observed, problem.weights, problem.eyes


def moved(T, x):
    """Poses (K, 4, 4) after left perturbations (6 (K - 1),) of all but the oldest."""
    after = [exp_se3(d) @ T_k for d, T_k in zip(x.reshape(-1, 6), T[1:], strict=True)]
    return np.array([T[0], *after])


def linearised(problem, width=WIDTH_PX):
    """Cost, reduced A and g, and what back substitution needs."""
    free, n = 6 * (len(problem.T_k_w) - 1), len(problem.rhos)
    room = [np.full(s, np.nan) for s in ((free, free), free, (n, free), n, n)]
    cost = linearise_bundle(problem.T_k_w, problem.rhos, *fixed(problem), width, *room)
    return cost, *room


def dense_equations(problem, turn, width=WIDTH_PX):
    """Cost, H and b of turn of the right eye, poses and depths (in px), by plain differences."""
    free, n = 6 * (len(problem.T_k_w) - 1), len(problem.rhos)

    def residuals(x):
        T, rhos = moved(problem.T_k_w, x[3 : 3 + free]), problem.rhos + x[3 + free :] / GAIN
        return window_residuals_reference(T, rhos, problem, turn + x[:3]).ravel()

    r = residuals(np.zeros(3 + free + n))
    seen = np.isfinite(r)
    # Small enough for points whose wrong inverse depth is nearly zero.
    J = -numeric_jacobian(residuals, np.zeros(3 + free + n), 1e-6)[seen]
    weights = np.repeat(problem.weights.ravel(), 4)[seen]
    w = weights / (1.0 + (r[seen] / width) ** 2)
    cost = np.sum(weights * 0.5 * width**2 * np.log1p((r[seen] / width) ** 2))
    return cost, J.T @ (w[:, None] * J), J.T @ (w * r[seen])


def scaled(A, b):
    """The same equations with a unit diagonal."""
    scale = np.sqrt(np.diag(A))
    return A / np.outer(scale, scale), b / scale


def noisy(rng, turn=NO_TURN, **options):
    window = make_window(rng, 4, 24, sigma_px=0.5, holes=0.15, weighted=True, **options)
    return window.disturbed(rng, pose=0.01, depth=0.02).changed(eyes=eyes_of(turn)).problem


# ------------------------------------------------------------------------- residuals, linearisation


@turns
def test_residuals_are_those_of_the_plain_form(rng, turn):
    problem = noisy(rng, turn)
    problem.weights[1, :5] = 0.0
    out = np.empty(problem.observed.shape)
    window_residuals(problem.T_k_w, problem.rhos, *fixed(problem), out)
    plain = window_residuals_reference(problem.T_k_w, problem.rhos, problem, turn)
    np.testing.assert_allclose(out, plain, atol=1e-9)
    assert np.isnan(out[1, :5]).all()
    at_home = out[problem.hosts, np.arange(24)]
    assert np.isnan(at_home[:, [0, 1, 3]]).all()
    assert np.isfinite(at_home[:, 2]).sum() > 12


@turns
def test_equations_are_those_of_all_unknowns_with_the_depths_eliminated(rng, turn):
    problem = noisy(rng, turn)
    cost, A, g, W, h_rho, b_rho = linearised(problem)
    dense_cost, H, b = dense_equations(problem, turn)
    H, b = H[3:, 3:], b[3:]
    free = len(g)
    assert cost == pytest.approx(dense_cost, rel=1e-9)
    np.testing.assert_allclose(W / GAIN, H[free:, :free], atol=1e-5 * np.abs(H[free:, :free]).max())
    np.testing.assert_allclose(h_rho / GAIN**2, np.diag(H)[free:], rtol=1e-5)
    np.testing.assert_allclose(b_rho / GAIN, b[free:], atol=1e-5 * np.abs(b[free:]).max())
    between = H[free:, free:] - np.diag(np.diag(H)[free:])
    assert np.abs(between).max() < 1e-9 * np.abs(H).max()  # which makes elimination a division
    A_plain, g_plain = scaled(*eliminated(H, b, free))
    A_scaled, g_scaled = scaled(A, g)
    np.testing.assert_allclose(A, A.T, rtol=1e-9, atol=1e-9 * np.abs(A).max())
    np.testing.assert_allclose(A_scaled, A_plain, atol=1e-5)
    np.testing.assert_allclose(g_scaled, g_plain, atol=1e-4 * np.abs(g_plain).max())


def test_slope_of_the_cost(rng):
    """With the depths' part of the reduction put back, g is the slope along the poses."""
    problem = noisy(rng, TURN)
    _, _, g, W, h_rho, b_rho = linearised(problem)
    slope = g + W.T @ (b_rho / h_rho)

    def cost(x):
        return np.array(linearised(replace(problem, T_k_w=moved(problem.T_k_w, x)))[0])

    numeric = -numeric_jacobian(cost, np.zeros(len(g)))
    assert np.abs(numeric).max() > 100.0
    np.testing.assert_allclose(slope, numeric, atol=1e-5 * np.abs(numeric).max())


# --------------------------------------------------------------------------------------- adjustment


def adjusted(problem, iterations=20, sigma_floor_px=0.05):
    return adjust_bundle(problem, sigma_floor_px=sigma_floor_px, iterations=iterations)


def test_without_noise_the_window_is_exact_and_the_oldest_stays(rng):
    window = make_window(rng, 5, 60)
    start = window.disturbed(rng).problem
    solution = adjusted(start)
    truth = window.problem
    assert np.abs(poses_apart(start.T_k_w, truth.T_k_w)).max() > 0.01
    np.testing.assert_array_equal(solution.T_k_w[0], truth.T_k_w[0])
    assert np.abs(poses_apart(solution.T_k_w, truth.T_k_w)).max() < 1e-6
    np.testing.assert_allclose(solution.rhos, truth.rhos, rtol=1e-5, atol=1e-8)
    assert 2 <= solution.iterations <= 20
    assert np.nanmax(np.abs(solution.residuals)) < 1e-4
    assert solution.sigma_px == 0.05


def test_what_was_given_stays_as_it_was(rng):
    problem = make_window(rng, 3, 30, sigma_px=0.3).disturbed(rng).problem
    before = [np.copy(getattr(problem, name)) for name in ("T_k_w", "rhos", "observed", "weights")]
    adjusted(problem)
    for name, kept in zip(("T_k_w", "rhos", "observed", "weights"), before, strict=True):
        np.testing.assert_array_equal(getattr(problem, name), kept)


def test_covariances_are_those_of_the_errors():
    """Poses and depths, over many windows of Gaussian noise."""
    runs, poses, depths, sigmas = 50, [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        window = make_window(rng, 4, 60, sigma_px=0.3)
        truth = window.problem
        solution = adjusted(window.disturbed(rng, pose=0.005, depth=0.02).problem)
        e = poses_apart(solution.T_k_w[1:], truth.T_k_w[1:])
        poses.append(e @ np.linalg.solve(solution.covariance, e))
        # Information of the depths is given the poses, so theirs is an upper bound.
        off = (solution.rhos - truth.rhos) ** 2 * solution.rho_information / solution.sigma_px**2
        depths.append(np.median(off))
        sigmas.append(solution.sigma_px)
    low, high = mean_nees_band(18, runs)
    # The kernel forgoes some information, and a window of free depths fits part of the noise.
    assert 0.9 * low < np.mean(poses) < 1.4 * high
    assert 0.26 < np.mean(sigmas) < 0.31
    assert 0.4 < np.mean(depths) < 1.0  # the median of chi2 of one dimension is 0.455


def test_wrong_observations_hardly_move_the_window(rng):
    window = make_window(rng, 4, 80, sigma_px=0.2)
    observed = window.problem.observed
    wrong = rng.random(observed.shape[:2]) < 0.1
    wrong[window.problem.hosts, np.arange(80)] = False
    observed[wrong] += rng.normal(0, 30.0, (wrong.sum(), 4))
    solution = adjusted(window.disturbed(rng).problem)
    e = poses_apart(solution.T_k_w[1:], window.problem.T_k_w[1:])
    assert 1.0 < e @ np.linalg.solve(solution.covariance, e) < 60.0  # of 18 dimensions
    assert 0.15 < solution.sigma_px < 0.35
    off = np.nanmax(np.abs(solution.residuals), axis=2) > 4.0 * solution.sigma_px
    assert off[wrong].mean() > 0.9
    assert np.mean(off[~wrong & np.isfinite(observed[..., 0])]) < 0.1


def test_points_at_infinity_hold_the_attitude(rng):
    """They have hardly any disparity: the position is all but open, the attitude is not."""
    window = make_window(rng, 4, 60, sigma_px=0.2, depth_m=(5e3, 5e6))
    solution = adjusted(window.disturbed(rng, pose=0.002, depth=1.0).problem)
    assert np.isfinite(solution.T_k_w).all()
    assert (solution.rhos >= RHO_MIN).all()
    turned = poses_apart(solution.T_k_w[1:], window.problem.T_k_w[1:]).reshape(-1, 6)[:, 3:]
    assert 1e-6 < np.abs(turned).max() < 1e-3
    sigmas = np.sqrt(np.diag(solution.covariance)).reshape(-1, 6)
    assert sigmas[:, 3:].max() < 1e-3
    assert sigmas[:, :3].min() > 0.1


def test_near_and_infinite_points_together(rng):
    window = make_window(rng, 4, 80, sigma_px=0.2)
    truth = window.problem
    far = np.arange(80) % 4 == 1  # all of one host, on purpose
    start = window.disturbed(rng, pose=0.005, depth=0.02)
    start.problem.rhos[far] = RHO_MIN  # as add_points sets them when there is no disparity
    solution = adjusted(start.problem)
    e = poses_apart(solution.T_k_w[1:], truth.T_k_w[1:])
    assert 1.0 < e @ np.linalg.solve(solution.covariance, e) < 60.0
    assert np.abs(solution.rhos - truth.rhos)[far].max() * GAIN < 1.5


@pytest.mark.parametrize("spoil", ["nothing seen", "no weight", "one point"])
def test_no_solution_without_enough_to_tell_it(rng, spoil):
    problem = make_window(rng, 3, 30, sigma_px=0.2).problem
    assert adjusted(problem) is not None
    if spoil == "nothing seen":
        problem.observed[:] = np.nan
    elif spoil == "no weight":
        problem.weights[:] = 0.0
    else:
        problem.weights[:, 1:] = 0.0
    assert adjusted(problem) is None


def test_a_keyframe_that_shares_nothing_has_no_pose(rng):
    problem = make_window(rng, 3, 30, sigma_px=0.2).problem
    problem.observed[2] = np.nan
    problem.observed[:, problem.hosts == 2] = np.nan
    assert adjusted(problem) is None


# ---------------------------------------------------------------------------- turn of the right eye


def turn_equations(problem, width=WIDTH_PX):
    """(3, 3) and (3,), all else eliminated, as the kernel has them."""
    _, A, g, W, h_rho, b_rho = linearised(problem, width)
    D, d = np.full((3, 3), np.nan), np.full(3, np.nan)
    turn_information(
        problem.T_k_w, problem.rhos, *fixed(problem), width, np.linalg.inv(A), g, W, h_rho, b_rho,
        D, d,
    )  # fmt: skip
    return D, d


@turns
def test_what_is_said_of_the_turn_is_what_all_unknowns_together_say(rng, turn):
    problem = noisy(rng, turn)
    # Where the left eye is blind the right row counts, which the kernel leaves out.
    problem.observed[np.isnan(problem.observed[..., 0])] = np.nan
    D, d = turn_equations(problem)
    _, H, b = dense_equations(problem, turn)
    D_plain, d_plain = scaled(*eliminated(H, b, 3))
    D_scaled, d_scaled = scaled(D, d)
    np.testing.assert_allclose(D_scaled, D_plain, atol=1e-3)
    np.testing.assert_allclose(d_scaled, d_plain, atol=1e-3 * np.abs(d_plain).max())
    # Motion and depths explain most of what a turn does: that was to be left out.
    assert np.all(np.diag(D) < np.diag(H)[:3])
    assert D[1, 1] < 0.5 * H[1, 1]


def test_a_turn_of_the_right_eye_is_found_and_its_sigma_is_true():
    """Everything else adjusted without it; D^-1 d tells it from motion and depths.

    As the refiner does, the next adjustment starts with what the last one found.
    """
    runs, squares, steps, truths = 40, [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        truth = rng.normal(0, 0.4e-3, 3)
        window = make_window(rng, 5, 100, sigma_px=0.1, turn=truth, depth_m=(3.0, 60.0))
        window.problem.observed[..., 3] = np.nan  # the columns alone
        found = np.zeros(3)
        for _ in range(3):
            solution = adjusted(window.changed(eyes=eyes_of(found)).problem)
            step = np.linalg.solve(solution.turn_information, solution.turn_score)
            if not found.any():
                steps.append(step[1])
            found = found + step
        e = found - truth
        # By the noise that was put in: the residuals show a tenth less, what was fitted of it.
        information = solution.turn_information * (solution.sigma_px / 0.1) ** 2
        squares.append(e @ information @ e)
        truths.append(truth[1])
    low, high = mean_nees_band(3, runs)
    assert low < np.mean(squares) < high
    # The robust weights make a first step shorter, never longer nor of another sign.
    slope = np.dot(steps, truths) / np.dot(truths, truths)
    assert 0.6 < slope < 1.02


def test_once_the_turn_is_known_nothing_is_missing(rng):
    truth = np.array([0.3e-3, -0.8e-3, 0.4e-3])
    window = make_window(rng, 5, 100, sigma_px=0.05, turn=truth, depth_m=(3.0, 60.0))
    before = adjusted(window.problem)
    after = adjusted(window.changed(eyes=eyes_of(truth)).problem)
    missing = [s.turn_score[1] / s.turn_information[1, 1] for s in (before, after)]
    sigma = 1.0 / np.sqrt(after.turn_information[1, 1])
    assert missing[0] == pytest.approx(truth[1], rel=0.4)
    assert abs(missing[1]) < 4.0 * sigma < 0.3 * abs(truth[1])


def test_one_depth_cannot_tell_yaw_from_motion(rng):
    """A yaw shifts all disparities alike; at one depth that is another depth."""
    spread = adjusted(make_window(rng, 4, 80, sigma_px=0.1, depth_m=(3.0, 60.0)).problem)
    plane = adjusted(make_window(rng, 4, 80, sigma_px=0.1, depth_m=(38.0, 42.0)).problem)
    ratio = spread.turn_information[1, 1] / plane.turn_information[1, 1]
    assert 3.0 < ratio < 1e6
