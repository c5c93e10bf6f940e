"""The three solvers on the same problems: where they end, what they cost, and whether it matters.

P1 (Mouats et al. 2015) reports different accuracies for Gauss-Newton, Levenberg-Marquardt and
Double Dogleg.  All three minimise one smooth function of six numbers; from the same inputs they can
differ only where one of them stops early or falls into another minimum.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, transform_points
from thermal_stereo_vo.odometry.feature_based.motion import (
    MotionConfig,
    estimate_motion,
    inliers_of,
    radial_weights,
    ransac_motion,
)
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.solvers import SOLVERS, Solution, SolverConfig, solve_reprojection

Array = NDArray[np.float64]

SIMULATED_STEPS = 200
TIMED_SOLVES = 9
EXACT = SolverConfig(gradient_tolerance=0.0, step_tolerance=1e-12)
"""Stops where rounding does."""


@dataclass(frozen=True)
class Step:
    """Matches of two stereo frames: (N, 4) px uL vL uR vR before and after."""

    before_px: Array
    after_px: Array


@dataclass(frozen=True)
class StepSequence:
    """Steps of one drive, seen by a rectified pair of equal eyes.

    ``T_world_left`` (S + 1, 4, 4) are the true poses; errors are summed up from the step
    ``score_from`` on.
    """

    name: str
    focal_px: float
    centre_px: tuple[float, float]
    baseline_m: float
    steps: tuple[Step, ...]
    T_world_left: Array
    score_from: int = 0

    @property
    def camera(self) -> StereoCamera:
        """The pair."""
        f, (cx, cy) = self.focal_px, self.centre_px
        return StereoCamera(f, f, cx, cy, cx, self.baseline_m)


@dataclass(frozen=True)
class Problem:
    """Inliers of one step, ready to be solved: arguments of ``solve_reprojection``."""

    points_m: Array
    observed_px: Array
    weights: Array
    T_start: Array


@dataclass(frozen=True)
class Chain:
    """The whole sequence, each step from RANSAC to the end with this solver."""

    solver: str
    unsolved: int
    final_error_percent: float


@dataclass(frozen=True)
class SolverFigures:
    """One solver over all problems; ``milliseconds`` is the median time of a solve.

    ``stopped_short_*`` say how far the stopping rules of the paper keep it from the exact minimum:
    the median in metres, and the most in standard deviations of the motion itself.
    """

    solver: str
    evaluations: float
    iterations: float
    unconverged: int
    milliseconds: float
    stopped_short_m: float
    stopped_short_sigmas: float


@dataclass(frozen=True)
class Comparison:
    """``apart_m`` and ``apart_rad``: the largest distance between two solvers that ran to the end.

    ``warm`` starts at the motion of the best sample, as in flight; ``cold`` at no motion at all.
    ``sigma_m``: median standard deviation of the translation that the noise of the pixels leaves.
    """

    name: str
    problems: int
    points: float
    chains: tuple[Chain, ...]
    warm: tuple[SolverFigures, ...]
    cold: tuple[SolverFigures, ...]
    apart_m: float
    apart_rad: float
    sigma_m: float


def simulate_steps(
    rng: np.random.Generator, steps: int = SIMULATED_STEPS, *, sigma_px: float = 0.5
) -> StepSequence:
    """The rig of P1 in a random walk among points at 4 to 40 m, a tenth of the matches wrong."""
    empty = StepSequence("simulated steps", 522.0, (320.0, 256.0), 0.2678, (), np.eye(4)[None])
    camera = empty.camera
    poses, made = [np.eye(4)], []
    for _ in range(steps):
        T_before_after = exp_se3(rng.normal(0.0, (0.1, 0.05, 0.3, 0.01, 0.02, 0.01)))
        depth_m = np.exp(rng.uniform(np.log(4.0), np.log(40.0), 300))
        u, v = rng.uniform((0.0, 0.0), (640.0, 512.0), (300, 2)).T
        rays = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy])
        before_m = np.column_stack([rays * depth_m[:, None], depth_m])
        after_m = transform_points(inverse(T_before_after), before_m)
        before_px = camera.project(before_m) + rng.normal(0.0, sigma_px, (300, 4))
        after_px = camera.project(after_m) + rng.normal(0.0, sigma_px, (300, 4))
        after_px[:30] += rng.uniform(-60.0, 60.0, (30, 4))
        seen = np.all(np.isfinite(after_px), axis=1)
        made.append(Step(before_px[seen], after_px[seen]))
        poses.append(poses[-1] @ T_before_after)
    return replace(empty, steps=tuple(made), T_world_left=np.array(poses))


def compare_solvers(
    sequence: StepSequence,
    config: MotionConfig | None = None,
    *,
    seed: int = 0,
) -> Comparison:
    """Solve every step with every solver, from the same inliers and the same start.

    Raises DatasetError when not one step has inliers.
    """
    config = config or MotionConfig()
    warm = _problems(sequence, config, np.random.default_rng(seed))
    if not warm:
        raise DatasetError(f"no step of {sequence.name} has matches that agree on a motion")
    cold = [replace(problem, T_start=np.eye(4)) for problem in warm]
    exact = {
        solver: [_solve(solver, problem, sequence.camera, EXACT) for problem in warm]
        for solver in SOLVERS
    }
    best = exact[SOLVERS[0]]
    figures = [
        tuple(
            _figures(solver, problems, sequence.camera, config.solver, best) for solver in SOLVERS
        )
        for problems in (warm, cold)
    ]
    apart = [
        _difference(one.T, other.T)
        for a, b in itertools.combinations(SOLVERS, 2)
        for one, other in zip(exact[a], exact[b], strict=True)
    ]
    return Comparison(
        sequence.name,
        len(warm),
        float(np.mean([len(problem.points_m) for problem in warm])),
        tuple(_chain(sequence, config, solver, seed) for solver in SOLVERS),
        figures[0],
        figures[1],
        max(float(np.linalg.norm(d[:3])) for d in apart),
        max(float(np.linalg.norm(d[3:])) for d in apart),
        float(np.median([_sigma_m(p, s) for p, s in zip(warm, best, strict=True)])),
    )


def _problems(
    sequence: StepSequence, config: MotionConfig, rng: np.random.Generator
) -> list[Problem]:
    camera = sequence.camera
    T = np.eye(4)
    problems = []
    for step in sequence.steps:
        points, pixels = _with_depth(step, camera)
        if len(points) < config.min_inliers:
            continue
        samples = rng.integers(0, len(points), size=(config.ransac_iterations, 3))
        parameters, inlier_px2 = camera.parameters, config.inlier_px**2
        _, T = ransac_motion(
            points, pixels, parameters, T, samples, inlier_px2, config.ransac_confidence
        )
        inliers = inliers_of(T, points, pixels, camera, config)
        if int(inliers.sum()) < config.min_inliers:
            continue
        chosen_px = np.ascontiguousarray(pixels[inliers])
        weights = radial_weights(chosen_px, camera, config.radial_trust)
        problems.append(Problem(np.ascontiguousarray(points[inliers]), chosen_px, weights, T))
    return problems


def _with_depth(step: Step, camera: StereoCamera) -> tuple[Array, Array]:
    points = camera.triangulate(step.before_px[:, :2], step.before_px[:, 2:])
    seen = np.isfinite(points[:, 2]) & (points[:, 2] > 0.0)
    return np.ascontiguousarray(points[seen]), np.ascontiguousarray(step.after_px[seen])


def _solve(solver: str, problem: Problem, camera: StereoCamera, config: SolverConfig) -> Solution:
    return solve_reprojection(
        solver,
        problem.T_start,
        problem.points_m,
        problem.observed_px,
        problem.weights,
        camera.parameters,
        config,
    )


def _chain(sequence: StepSequence, config: MotionConfig, solver: str, seed: int) -> Chain:
    """A step that cannot be solved moves like the one before."""
    rng = np.random.default_rng(seed)
    T_prior = np.eye(4)
    T_start_end = np.eye(4)
    unsolved = 0
    for i, step in enumerate(sequence.steps):
        points, pixels = _with_depth(step, sequence.camera)
        motion = estimate_motion(points, pixels, sequence.camera, T_prior, solver, config, rng)
        if motion is None:
            unsolved += 1
        else:
            T_prior = motion.T_current_previous
        if i >= sequence.score_from:
            T_start_end = T_start_end @ inverse(T_prior)
    poses = sequence.T_world_left[sequence.score_from :]
    way_m = float(np.sum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
    true = inverse(poses[0]) @ poses[-1]
    error_m = float(np.linalg.norm(T_start_end[:3, 3] - true[:3, 3]))
    return Chain(solver, unsolved, 100.0 * error_m / way_m)


def _figures(
    solver: str,
    problems: Sequence[Problem],
    camera: StereoCamera,
    config: SolverConfig,
    best: Sequence[Solution],
) -> SolverFigures:
    solutions = [_solve(solver, problem, camera, config) for problem in problems]
    short_m, short_sigmas = [], []
    for problem, solution, exact in zip(problems, solutions, best, strict=True):
        d = _difference(solution.T, exact.T)
        short_m.append(float(np.linalg.norm(d[:3])))
        variance_px2 = 2.0 * exact.cost / (4 * len(problem.points_m) - 6)
        short_sigmas.append(float(np.sqrt(max(float(d @ exact.A @ d), 0.0) / variance_px2)))
    return SolverFigures(
        solver,
        float(np.mean([solution.evaluations for solution in solutions])),
        float(np.mean([solution.iterations for solution in solutions])),
        sum(not solution.converged for solution in solutions),
        _time_ms(solver, problems, camera, config),
        float(np.median(short_m)),
        float(np.max(short_sigmas)),
    )


def _time_ms(
    solver: str, problems: Sequence[Problem], camera: StereoCamera, config: SolverConfig
) -> float:
    """Median over the problems of the quickest of several solves: other work only adds."""
    quickest = []
    for problem in problems:
        times = []
        for _ in range(TIMED_SOLVES):
            start = time.perf_counter_ns()
            _solve(solver, problem, camera, config)
            times.append(time.perf_counter_ns() - start)
        quickest.append(min(times))
    return 1e-6 * float(np.median(quickest))


def _difference(T_a: Array, T_b: Array) -> Array:
    """(6,) tangent vector (rho, phi) from one motion to the other."""
    return log_se3(T_a @ inverse(T_b))


def _sigma_m(problem: Problem, solution: Solution) -> float:
    """Standard deviation of the translation (m) that the noise of the pixels leaves."""
    variance_px2 = 2.0 * solution.cost / (4 * len(problem.points_m) - 6)
    covariance = variance_px2 * np.linalg.inv(solution.A)
    return float(np.sqrt(np.trace(covariance[:3, :3])))
