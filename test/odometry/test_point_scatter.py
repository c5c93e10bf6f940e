"""Covariances by the scatter of what points pull, against plain forms and many windows of noise."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.clustered_covariance import clustered_covariance, scatter_steps
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    adjust_bundle,
    linearise_bundle,
)
from thermal_stereo_vo.odometry.feature_based.point_scatter import point_pulls
from thermal_stereo_vo.odometry.information import inverse_information

from .window_problems import TURN, eyes_of, make_window, mean_nees_band, poses_apart

FLOOR_PX = 0.05


def given(problem):
    return (
        problem.T_k_w, problem.rhos, problem.hosts, problem.bearings, problem.observed,
        problem.weights, problem.eyes,
    )  # fmt: skip


def equations(problem, width):
    """Reduced A and g of the kernel that adjusts."""
    free, n = 6 * (len(problem.T_k_w) - 1), len(problem.rhos)
    A, g = np.zeros((free, free)), np.zeros(free)
    linearise_bundle(*given(problem), width, A, g, np.zeros((n, free)), np.zeros(n), np.zeros(n))
    return A, g


def pulls_of(problem, width):
    pulls = np.full((len(problem.rhos), 6 * (len(problem.T_k_w) - 1)), np.nan)
    return pulls, point_pulls(*given(problem), width, pulls)


def alone(window, n):
    """The window with point ``n`` and no other."""
    p = window.problem
    one = slice(n, n + 1)
    return window.changed(
        hosts=p.hosts[one], bearings=p.bearings[one], rhos=p.rhos[one],
        observed=np.ascontiguousarray(p.observed[:, one]),
        weights=np.ascontiguousarray(p.weights[:, one]),
    ).problem  # fmt: skip


def test_each_point_pulls_as_if_it_were_alone_and_together_they_pull_as_all(rng):
    window = make_window(rng, 4, 30, sigma_px=0.4, turn=TURN, holes=0.2, weighted=True)
    window = window.disturbed(rng).changed(eyes=eyes_of(TURN))
    pulls, _ = pulls_of(window.problem, 1.5)
    for n in range(len(window)):
        _, g = equations(alone(window, n), 1.5)
        np.testing.assert_allclose(pulls[n], g, rtol=1e-9, atol=1e-9 * np.abs(pulls).max())
    _, g = equations(window.problem, 1.5)
    np.testing.assert_allclose(pulls.sum(axis=0), g, rtol=1e-9, atol=1e-9 * np.abs(pulls).max())


def test_the_kernel_gives_way_less_than_its_weights_say(rng):
    """By numeric integration over Gaussian noise, at the width that has 95 % efficiency."""
    problem = make_window(rng, 4, 400, sigma_px=0.2).problem
    _, steepness = pulls_of(problem, 2.385 * 0.2)
    x = np.linspace(-8.0, 8.0, 20001)
    density = np.exp(-0.5 * x * x)
    u2 = (x / 2.385) ** 2
    slope, weight = (1.0 - u2) / (1.0 + u2) ** 2, 1.0 / (1.0 + u2)
    assert steepness == pytest.approx((density @ slope) / (density @ weight), abs=0.03)
    assert pulls_of(problem, 1e6)[1] == pytest.approx(1.0, abs=1e-6)


def test_scatter_is_that_of_matrix_products(rng):
    root = rng.normal(size=(12, 12))
    unit = root @ root.T
    pulls = rng.normal(size=(50, 12))
    pulls[7] = 0.0
    out = np.full((12, 12), np.nan)
    assert scatter_steps(unit, pulls, out) == 49
    steps = pulls @ unit
    np.testing.assert_allclose(out, steps.T @ steps, rtol=1e-9, atol=1e-9 * np.abs(out).max())


def test_independent_pulls_give_the_noise_back(rng):
    """With pulls drawn as the equations say, the covariance is noise times their inverse."""
    root = rng.normal(size=(12, 12))
    information = root @ root.T + 5.0 * np.eye(12)
    unit = inverse_information(information)
    pulls = rng.multivariate_normal(np.zeros(12), information / 4000.0 * 0.09, size=4000)
    covariance = clustered_covariance(information, unit, pulls, 1.0, FLOOR_PX)
    factor = np.linalg.cholesky(information)
    np.testing.assert_allclose(factor.T @ covariance @ factor, 0.09 * np.eye(12), atol=0.009)
    steeper = clustered_covariance(information, unit, pulls, 0.5, FLOOR_PX)
    np.testing.assert_allclose(steeper, 4.0 * covariance, rtol=1e-9)
    # Half of the points have gone, and left only the sum of what they pulled.
    behind = pulls[2000:].T @ pulls[2000:]
    half = clustered_covariance(information, unit, pulls[:2000], 1.0, FLOOR_PX, behind)
    np.testing.assert_allclose(half, covariance, rtol=0.02, atol=0.02 * np.abs(covariance).max())


@pytest.mark.parametrize(
    ("count", "scale", "steepness"), [(23, 1.0, 1.0), (200, 1e-4, 1.0), (200, 1.0, 0.1)]
)
def test_what_tells_nothing_is_not_used(rng, count, scale, steepness):
    """Too few points, less than the least noise, a kernel that has flattened nearly everything."""
    information = np.eye(12) * count
    pulls = scale * rng.normal(size=(count, 12))
    unit = inverse_information(information)
    assert clustered_covariance(information, unit, pulls, steepness, FLOOR_PX) is None


def test_without_noise_the_least_noise_is_claimed(rng):
    window = make_window(rng, 4, 60)
    solution = adjust_bundle(window.problem, sigma_floor_px=FLOOR_PX, iterations=8)
    A, _ = equations(window.problem, 2.385 * FLOOR_PX)
    np.testing.assert_allclose(solution.covariance, FLOOR_PX**2 * np.linalg.inv(A), rtol=1e-3)


@pytest.mark.parametrize(
    ("shared", "thinner"), [(0.0, 1.0), (0.2, 1.3)], ids=("independent", "one error a point")
)
def test_poses_err_as_claimed_also_when_keyframes_share_errors(shared, thinner):
    """What a patch has wrong in one keyframe it may have wrong in all of them."""
    runs, keyframes, values, plain = 60, 4, [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        window = make_window(rng, keyframes, 120, sigma_px=0.15)
        problem = window.problem
        away = np.arange(keyframes)[:, None] != problem.hosts
        observed = problem.observed + shared * rng.normal(size=(120, 4)) * away[..., None]
        problem = window.changed(observed=observed).problem
        solution = adjust_bundle(problem, sigma_floor_px=FLOOR_PX, iterations=12)
        e = poses_apart(solution.T_k_w[1:], window.problem.T_k_w[1:])
        A, _ = equations(problem, 2.385 * solution.sigma_px)
        for k in range(0, len(e), 6):
            block = slice(k, k + 6)
            values.append(e[block] @ np.linalg.solve(solution.covariance[block, block], e[block]))
            claim = solution.sigma_px**2 * np.linalg.inv(A)[block, block]
            plain.append(e[block] @ np.linalg.solve(claim, e[block]))
    low, high = mean_nees_band(6, runs)
    # Residuals are smaller than the noise: each point has fitted its own depth to them.
    assert low < np.mean(values) < 1.35 * high
    assert np.mean(plain) > thinner * np.mean(values)
