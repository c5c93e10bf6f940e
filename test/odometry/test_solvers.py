"""The three solvers against scipy, against each other and against the printed algorithms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, make_transform
from thermal_stereo_vo.odometry.solvers import (
    DOUBLE_DOGLEG,
    GAUSS_NEWTON,
    LEVENBERG_MARQUARDT,
    SOLVERS,
    Solution,
    SolverConfig,
    solve_reprojection,
)

from .stereo_problems import (
    CAMERA,
    Problem,
    difference,
    make_problem,
    on_a_line,
    one_place,
    seen_points,
)
from .test_dogleg_step import reference_step

seeds = st.integers(0, 2**32 - 1)
TIGHT = SolverConfig(gradient_tolerance=1e-6, step_tolerance=1e-5)  # 1e-10 at p = 0
each_solver = pytest.mark.parametrize("solver", SOLVERS)


def solve(problem: Problem, T_start, solver=DOUBLE_DOGLEG, config=TIGHT) -> Solution:
    return solve_reprojection(
        solver,
        T_start,
        problem.points,
        problem.observed,
        problem.weights,
        problem.camera.parameters,
        config,
    )


def scale_of(problem):
    """Translations count in mean depths, so that one ball holds metres and radians."""
    depth = problem.points[:, 2].mean()
    return np.array([depth] * 3 + [1.0] * 3)


# ------------------------------------------------------------------ against an independent minimum


@each_solver
@given(seed=seeds, weighted=st.booleans())
@settings(max_examples=12)
def test_minimum_is_that_of_scipy(solver, seed, weighted):
    problem = make_problem(np.random.default_rng(seed), weighted=weighted)
    solution = solve(problem, np.eye(4), solver)
    expected = problem.scipy_solution(np.eye(4))
    assert solution.converged
    assert np.abs(difference(solution.T, expected)).max() < 1e-6
    assert solution.cost == pytest.approx(problem.cost(expected), rel=1e-9)
    assert 0.0 < np.abs(difference(solution.T, problem.T_true)).max() < 1.0


@given(seed=seeds)
@settings(max_examples=15)
def test_the_three_agree(seed):
    problem = make_problem(np.random.default_rng(seed), weighted=True)
    T = [solve(problem, np.eye(4), solver).T for solver in SOLVERS]
    assert np.abs(difference(T[0], T[1])).max() < 1e-6
    assert np.abs(difference(T[0], T[2])).max() < 1e-6


@each_solver
def test_paper_tolerances_are_far_below_the_statistical_error(solver, rng):
    """Notes on the paper: what loose tolerances leave is 100 times less than what noise does."""
    left, noise = [], []
    for _ in range(10):
        problem = make_problem(rng, 200)
        solution = solve(problem, np.eye(4), solver, SolverConfig())
        assert solution.converged
        exact = solve(problem, np.eye(4), solver)
        left.append(np.linalg.norm(difference(solution.T, exact.T)[:3]))
        noise.append(np.linalg.norm(difference(exact.T, problem.T_true)[:3]))
    assert np.median(left) < 0.05 * np.median(noise)


@each_solver
def test_without_noise_the_true_motion_is_found(solver, rng):
    problem = make_problem(rng, sigma_px=0.0)
    solution = solve(problem, np.eye(4), solver)
    assert np.abs(difference(solution.T, problem.T_true)).max() < 1e-8
    assert solution.cost < 1e-10


@each_solver
def test_weights_of_zero_are_as_good_as_absent(solver, rng):
    problem = make_problem(rng, 40)
    spoilt = problem.observed.copy()
    spoilt[:10] += 50.0
    weights = np.ones(40)
    weights[:10] = 0.0
    weighted = solve(replace(problem, observed=spoilt, weights=weights), np.eye(4), solver)
    # The same scale of depths for both: the mean is taken over all points.
    rest = replace(
        problem,
        points=problem.points[10:],
        observed=problem.observed[10:],
        weights=problem.weights[10:],
    )
    assert np.abs(difference(weighted.T, solve(rest, np.eye(4), solver).T)).max() < 1e-7


@each_solver
def test_solution_says_what_is_true_at_the_minimum(solver, rng):
    problem = make_problem(rng, weighted=True)
    start = exp_se3([0.1, 0, 0, 0, 0.01, 0])
    before = start.copy()
    solution = solve(problem, start, solver)
    A, g = problem.normal_equations(solution.T)
    assert solution.cost == pytest.approx(problem.cost(solution.T), rel=1e-10)
    np.testing.assert_allclose(solution.A, A, rtol=1e-5, atol=1e-5 * np.abs(A).max())
    assert np.abs(g).max() < 1e-3 * np.sqrt(np.diag(A)).max()
    assert np.array_equal(start, before)
    np.testing.assert_allclose(solution.T[:3, :3] @ solution.T[:3, :3].T, np.eye(3), atol=1e-12)


@each_solver
def test_same_problem_same_bits(solver, rng):
    problem = make_problem(rng)
    a, b = (solve(problem, np.eye(4), solver) for _ in range(2))
    assert np.array_equal(a.T, b.T)
    assert (a.cost, a.iterations, a.evaluations) == (b.cost, b.iterations, b.evaluations)


# ---------------------------------------------------------------- against the algorithms as printed


def scaled_model(problem, T, scale):
    A, g = problem.normal_equations(T)
    return scale[:, None] * A * scale, scale * g


def printed_double_dogleg(problem, T, radius, config):
    """Algorithm 2 with its misprints put right, in plain numpy; counts rejected steps."""
    eps = config.step_tolerance
    scale = scale_of(problem)
    motion = np.linalg.norm(log_se3(T) / scale)
    cost, (A, g) = problem.cost(T), scaled_model(problem, T, scale)
    iterations = rejected = on_border = 0
    converged = np.abs(g).max() <= config.gradient_tolerance
    while not converged and iterations < config.max_iterations:
        iterations += 1
        d = reference_step(A, g, radius)
        T_new = exp_se3(d * scale) @ T
        new_cost = problem.cost(T_new)
        gain = (cost - new_cost) / (g @ d - 0.5 * d @ A @ d)
        border = np.linalg.norm(d) > 0.99 * radius
        on_border += border
        radius *= 0.5 if gain < 0.15 else 2.0 if gain > 0.75 and border else 1.0
        small = np.linalg.norm(d) <= eps * (motion + eps) or radius <= eps * (motion + eps)
        if gain > 0:
            T, cost, (A, g) = T_new, new_cost, scaled_model(problem, T_new, scale)
        else:
            rejected += 1
        converged = small or np.abs(g).max() <= config.gradient_tolerance
    return T, iterations, rejected, on_border


def printed_levenberg_marquardt(problem, T, tau, config):
    """Algorithm 1 with Nielsen's start of the damping, in plain numpy; counts rejected steps."""
    eps = config.step_tolerance
    scale = scale_of(problem)
    motion = np.linalg.norm(log_se3(T) / scale)
    cost, (A, g) = problem.cost(T), scaled_model(problem, T, scale)
    mu, nu, iterations, rejected = tau * np.diag(A).max(), 2.0, 0, 0
    converged = np.abs(g).max() <= config.gradient_tolerance
    while not converged and iterations < config.max_iterations:
        iterations += 1
        d = np.linalg.solve(A + mu * np.eye(6), g)
        converged = np.linalg.norm(d) <= eps * (motion + eps)
        T_new = exp_se3(d * scale) @ T
        new_cost = problem.cost(T_new)
        gain = (cost - new_cost) / (0.5 * d @ (mu * d + g))
        if gain > 0:
            T, cost, (A, g) = T_new, new_cost, scaled_model(problem, T_new, scale)
            converged = converged or np.abs(g).max() <= config.gradient_tolerance
            mu *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
            nu = 2.0
        else:
            rejected += 1
            mu *= nu
            nu *= 2.0
    return T, iterations, rejected


LOOSE = SolverConfig(gradient_tolerance=1e-3, step_tolerance=1e-5)


FAR = (0, 3, 7, 9, 10, 18, 27, 28)
"""Seeds of far problems, most of which make steps fail."""


def far_problem(seed):
    """A start so far off that full Newton steps overshoot."""
    rng = np.random.default_rng(seed)
    problem = make_problem(rng, 40, translation_m=0.5, rotation_rad=0.05, depth_m=(1.0, 10.0))
    while True:
        T_start = exp_se3(np.concatenate([rng.normal(0, 1.0, 3), rng.normal(0, 0.9, 3)]))
        if np.isfinite(problem.cost(T_start)):
            return problem, T_start


@pytest.mark.parametrize("seed", FAR)
@pytest.mark.parametrize("radius", [1e-3, 0.02, 0.3, 1.0])
def test_double_dogleg_walks_as_algorithm_2_does(seed, radius):
    problem, T_start = far_problem(seed)
    config = replace(LOOSE, initial_radius=radius, max_iterations=40)
    T, iterations, _, _ = printed_double_dogleg(problem, T_start, radius, config)
    solution = solve(problem, T_start, DOUBLE_DOGLEG, config)
    assert solution.iterations == iterations
    assert solution.evaluations == iterations + 1
    assert np.abs(difference(solution.T, T)).max() < 1e-5


@pytest.mark.parametrize("seed", FAR)
@pytest.mark.parametrize("tau", [1e-6, 1e-3, 10.0])
def test_levenberg_marquardt_walks_as_algorithm_1_does(seed, tau):
    problem, T_start = far_problem(seed)
    config = replace(LOOSE, initial_damping=tau, max_iterations=40)
    T, iterations, _ = printed_levenberg_marquardt(problem, T_start, tau, config)
    solution = solve(problem, T_start, LEVENBERG_MARQUARDT, config)
    assert solution.iterations == iterations
    assert np.abs(difference(solution.T, T)).max() < 1e-5


def test_the_far_problems_do_make_steps_fail_and_the_region_bite():
    """Without this the two tests above could pass without ever rejecting a step."""
    dogleg = [printed_double_dogleg(*far_problem(seed), 1.0, LOOSE) for seed in FAR]
    damped = [printed_levenberg_marquardt(*far_problem(seed), 1e-6, LOOSE) for seed in FAR]
    assert sum(rejected for _, _, rejected, _ in dogleg) >= 3
    assert sum(border for *_, border in dogleg) >= 3
    assert sum(rejected for *_, rejected in damped) >= 3


def test_a_tiny_region_makes_short_steps_that_grow(rng):
    """Double Dogleg under an active trust region: more steps, the same end."""
    problem = make_problem(rng, translation_m=1.5, rotation_rad=0.1)
    free = solve(problem, np.eye(4), DOUBLE_DOGLEG)
    held = solve(problem, np.eye(4), DOUBLE_DOGLEG, replace(TIGHT, initial_radius=1e-4))
    assert held.iterations >= free.iterations + 5
    assert np.abs(difference(held.T, free.T)).max() < 1e-7
    scale = scale_of(problem)
    one = replace(TIGHT, initial_radius=1e-4, max_iterations=1)
    first = log_se3(solve(problem, np.eye(4), DOUBLE_DOGLEG, one).T) / scale
    assert np.linalg.norm(first) == pytest.approx(1e-4, rel=1e-6)


def test_with_the_papers_radius_double_dogleg_takes_gauss_newton_steps(rng):
    """The region of radius 1 never bites near the minimum: the two are one method there."""
    for _ in range(5):
        problem = make_problem(rng)
        a = solve(problem, np.eye(4), GAUSS_NEWTON, SolverConfig())
        b = solve(problem, np.eye(4), DOUBLE_DOGLEG, SolverConfig())
        assert a.iterations == b.iterations
        np.testing.assert_allclose(a.T, b.T, atol=1e-13)


def test_heavy_damping_only_costs_iterations(rng):
    problem = make_problem(rng)
    light = solve(problem, np.eye(4), LEVENBERG_MARQUARDT)
    heavy = solve(problem, np.eye(4), LEVENBERG_MARQUARDT, replace(TIGHT, initial_damping=100.0))
    assert heavy.converged
    assert heavy.iterations > light.iterations
    assert np.abs(difference(heavy.T, light.T)).max() < 1e-7


# ------------------------------------------------------------------------------------- hard corners


@each_solver
def test_hover_stops_at_once_without_noise_and_soon_with_it(solver, rng):
    """p = 0: a test relative to |p| alone would never be met."""
    points = seen_points(rng, 50)
    still = Problem(points, CAMERA.project(points), np.ones(50), np.eye(4))
    solution = solve(still, np.eye(4), solver, SolverConfig())
    assert solution.converged
    assert solution.iterations == 0
    np.testing.assert_array_equal(solution.T, np.eye(4))
    noisy = replace(still, observed=still.observed + rng.normal(0, 0.3, (50, 4)))
    solution = solve(noisy, np.eye(4), solver, SolverConfig())
    assert solution.converged
    assert 1 <= solution.iterations <= 12
    assert 1e-6 < np.linalg.norm(log_se3(solution.T)) < 0.1


@each_solver
@pytest.mark.parametrize("limit", [1, 2])
def test_iterations_are_limited_and_it_says_so(solver, limit):
    problem, T_start = far_problem(3)
    solution = solve(problem, T_start, solver, replace(TIGHT, max_iterations=limit))
    assert solution.iterations == limit
    assert not solution.converged


@each_solver
def test_a_start_at_the_minimum_stays_there(solver, rng):
    problem = make_problem(rng)
    best = solve(problem, np.eye(4), solver)
    again = solve(problem, best.T, solver, SolverConfig())
    assert again.converged
    assert again.iterations <= 1
    assert np.abs(difference(again.T, best.T)).max() < 1e-7


@each_solver
@pytest.mark.parametrize("make", [on_a_line, one_place])
def test_singular_problems_end_with_finite_numbers_and_no_higher_cost(solver, make, rng):
    problem = make(rng)
    solution = solve(problem, np.eye(4), solver, SolverConfig())
    assert np.isfinite(solution.T).all()
    assert np.isfinite(solution.A).all()
    assert solution.cost <= problem.cost(np.eye(4)) * (1 + 1e-12)
    assert solution.iterations <= 100
    np.testing.assert_allclose(solution.T[:3, :3] @ solution.T[:3, :3].T, np.eye(3), atol=1e-9)


@each_solver
def test_points_at_infinity_still_give_the_rotation(solver, rng):
    """Nothing can be said of the translation there; the rotation must not suffer."""
    points = seen_points(rng, 80, depth_m=(1e7, 2e7))
    phi = np.array([0.01, -0.02, 0.015])
    T_true = make_transform(exp_se3([0, 0, 0, *phi])[:3, :3], [0.3, 0.1, -0.5])
    observed = CAMERA.project(points @ T_true[:3, :3].T + T_true[:3, 3])
    observed += rng.normal(0, 0.1, observed.shape)
    problem = Problem(points, observed, np.ones(80), T_true)
    solution = solve(problem, np.eye(4), solver, SolverConfig())
    assert np.isfinite(solution.T).all()
    covariance = 0.1**2 * np.linalg.inv(solution.A)
    error = difference(solution.T, T_true)
    assert np.linalg.norm(error[3:]) < 5.0 * np.sqrt(np.trace(covariance[3:, 3:]))
    assert np.sqrt(covariance[0, 0]) > 100.0


@each_solver
def test_a_start_that_puts_points_behind_the_camera_is_not_called_converged(solver, rng):
    problem = make_problem(rng)
    T_start = make_transform(np.eye(3), [0.0, 0.0, -1000.0])
    solution = solve(problem, T_start, solver, SolverConfig())
    assert not solution.converged
    assert solution.cost == np.inf
    assert np.isfinite(solution.T).all()


@each_solver
def test_no_step_leads_behind_the_camera(solver, rng):
    """Near points and a start far behind: Newton would shoot through the image plane."""
    points = seen_points(rng, 40, depth_m=(0.8, 3.0))
    problem = Problem(points, CAMERA.project(points), np.ones(40), np.eye(4))
    for distance_m in (2.0, 5.0, 10.0, 30.0):
        T_start = make_transform(np.eye(3), [0.0, 0.0, distance_m])
        solution = solve(problem, T_start, solver, SolverConfig())
        assert np.isfinite(solution.cost)
        assert (problem.points @ solution.T[2, :3] + solution.T[2, 3]).min() > 0


def test_direction_of_the_solution_is_from_previous_to_current(rng):
    """The rig moved ahead by 1 m: old points come nearer by 1 m."""
    points = seen_points(rng, 60)
    after = points - [0.0, 0.0, 1.0]
    problem = Problem(points, CAMERA.project(after), np.ones(60), np.eye(4))
    T_after_before = solve(problem, np.eye(4)).T
    np.testing.assert_allclose(inverse(T_after_before)[:3, 3], [0.0, 0.0, 1.0], atol=1e-6)
