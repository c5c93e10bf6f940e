"""Gauss-Newton, Levenberg-Marquardt and Double Dogleg for the six motion parameters.

P1 (Mouats et al. 2015) section IV.B, Algorithms 1 and 2, with their misprints put right after
Madsen, Nielsen & Tingleff (Methods for Non-Linear Least Squares Problems, 2004) and Dennis & Mei
(J. Optim. Theory Appl. 28, 1979).  With residual r = x - f(p) and J = df/dp, A = J'WJ and g = J'Wr,
every step solves ``A d = g`` or a restriction of it, and F = r'Wr / 2 is the cost.

Deviations from the paper, each where it is made:

* eq. (3) subtracts the damping; it is added.
* Algorithm 1 leaves the first damping open: ``mu = tau * max(diag A)``.
* Algorithm 2 walks from the Cauchy point away from the Newton point and leaves out the
  intermediate Newton point ``eta * d_N``; both are put right.
* The gain ratios compare norms with squared norms; both sides are half squared norms here.
* eq. (5) also enlarges the region after interior steps; only steps on its border do so here.
* Relative step tests fail at hover (p = 0); they are ``eps * (|p| + eps)``, joined to the gradient
  test by "or" instead of overwriting it.
* Parameters are a left perturbation on SE(3), not Euler angles, and translations are divided by
  the mean depth, so that one ball of radius Delta holds comparable numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.kernels import retract, solve_positive
from thermal_stereo_vo.core.transforms import log_se3
from thermal_stereo_vo.odometry.feature_based.stereo_projection import (
    linearise_reprojection,
)

GAUSS_NEWTON, LEVENBERG_MARQUARDT, DOUBLE_DOGLEG = (
    "gauss_newton",
    "levenberg_marquardt",
    "double_dogleg",
)
SOLVERS = (GAUSS_NEWTON, LEVENBERG_MARQUARDT, DOUBLE_DOGLEG)

# Algorithm 2: shrink below, grow above; Dennis & Mei's bias towards the Newton direction.
_SHRINK_BELOW, _GROW_ABOVE, _SHRINK, _GROW = 0.15, 0.75, 0.5, 2.0
_NEWTON_BIAS = 0.2


@dataclass(frozen=True)
class SolverConfig:
    """When the solvers stop and how they start; the defaults are the paper's."""

    max_iterations: int = setting(100, "Most iterations of a solve.", minimum=1, maximum=1000)
    gradient_tolerance: float = setting(
        1e-4, "Stop when no component of the gradient is larger.", minimum=0.0, maximum=1.0
    )
    step_tolerance: float | None = setting(
        None,
        "Stop when the step is smaller than this share of the motion; empty takes the paper's "
        "1e-3 for Levenberg-Marquardt and 1e-4 for the others.",
        minimum=0.0,
        maximum=1.0,
    )
    initial_damping: float = setting(
        1e-3, "tau of Levenberg-Marquardt.", minimum=1e-12, maximum=1e3
    )
    initial_radius: float = setting(
        1.0,
        "Delta of Double Dogleg; radians, and metres over the mean depth.",
        minimum=1e-9,
        maximum=1e6,
    )


@dataclass(frozen=True)
class Solution:
    """``T`` (4, 4) at the minimum, half squared error ``cost`` (px^2), ``A`` (6, 6) there.

    A start that puts a point behind the camera is given back unconverged at infinite cost.
    """

    T: NDArray[np.float64]
    cost: float
    A: NDArray[np.float64]
    iterations: int
    evaluations: int
    converged: bool


def solve_reprojection(
    solver: str,
    T_start: NDArray[np.float64],
    points: NDArray[np.float64],
    observed: NDArray[np.float64],
    weights: NDArray[np.float64],
    camera: NDArray[np.float64],
    config: SolverConfig,
) -> Solution:
    """Minimise P1 eq. (2) from ``T_start`` (4, 4), which maps points to the current left camera.

    ``points`` (N, 3) m, ``observed`` (N, 4) px uL vL uR vR, ``weights`` (N,), ``camera`` (6,) as
    ``StereoCamera.parameters``.
    """
    tolerance = config.step_tolerance
    if tolerance is None:
        tolerance = 1e-3 if solver == LEVENBERG_MARQUARDT else 1e-4
    depth_m = float(np.mean(points[:, 2]))
    scale = np.array([depth_m, depth_m, depth_m, 1.0, 1.0, 1.0])
    motion = float(np.linalg.norm(log_se3(T_start) / scale))
    arguments = (
        T_start, points, observed, weights, camera, scale, motion,
        config.max_iterations, config.gradient_tolerance, tolerance,
    )  # fmt: skip
    if solver == GAUSS_NEWTON:
        found = gauss_newton(*arguments)
    elif solver == LEVENBERG_MARQUARDT:
        found = levenberg_marquardt(*arguments, config.initial_damping)
    else:
        found = double_dogleg(*arguments, config.initial_radius)
    return Solution(*found)


@njit(cache=True, nogil=True)
def gauss_newton(  # type: ignore[no-untyped-def]
    T_start,
    points,
    observed,
    weights,
    camera,
    scale,
    motion,
    max_iterations,
    gradient_eps,
    step_eps,
):
    """Plain Gauss-Newton: ``A d = g`` until the step is small."""
    T, T_new = T_start.copy(), T_start.copy()
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    cost = _linearise(T, points, observed, weights, camera, scale, A, g)
    evaluations, iterations = 1, 0
    if not np.isfinite(cost):  # a point behind the camera: no place to start from
        return T, cost, np.zeros((6, 6)), iterations, evaluations, False
    converged = _largest(g) <= gradient_eps
    while not converged and iterations < max_iterations:
        iterations += 1
        if not solve_positive(A, g, step):
            break
        retract(T, step * scale, T_new)
        new_cost = _linearise(T_new, points, observed, weights, camera, scale, A, g)
        evaluations += 1
        if not np.isfinite(new_cost):
            cost = _linearise(T, points, observed, weights, camera, scale, A, g)
            break
        T[:] = T_new
        cost = new_cost
        converged = _largest(g) <= gradient_eps or _norm(step) <= step_eps * (motion + step_eps)
    return T, cost, _unscaled(A, scale), iterations, evaluations, converged


@njit(cache=True, nogil=True)
def levenberg_marquardt(  # type: ignore[no-untyped-def]
    T_start,
    points,
    observed,
    weights,
    camera,
    scale,
    motion,
    max_iterations,
    gradient_eps,
    step_eps,
    tau,
):
    """P1 Algorithm 1 with Nielsen's damping: ``(A + mu I) d = g``."""
    T, T_new = T_start.copy(), T_start.copy()
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    A_new, g_new = np.zeros((6, 6)), np.zeros(6)
    cost = _linearise(T, points, observed, weights, camera, scale, A, g)
    evaluations, iterations = 1, 0
    if not np.isfinite(cost):  # a point behind the camera: no place to start from
        return T, cost, np.zeros((6, 6)), iterations, evaluations, False
    mu, nu = tau * np.max(np.diag(A)), 2.0
    converged = _largest(g) <= gradient_eps
    while not converged and iterations < max_iterations and np.isfinite(mu):
        iterations += 1
        if not solve_positive(A + mu * np.eye(6), g, step):
            mu *= nu
            nu *= 2.0
            continue
        if _norm(step) <= step_eps * (motion + step_eps):
            converged = True
            # The paper drops this last step; taking it when it helps costs one evaluation.
        retract(T, step * scale, T_new)
        new_cost = _linearise(T_new, points, observed, weights, camera, scale, A_new, g_new)
        evaluations += 1
        predicted = 0.5 * (mu * np.dot(step, step) + np.dot(step, g))
        gain = (cost - new_cost) / predicted if predicted > 0.0 else -1.0
        if gain > 0.0:
            T[:] = T_new
            cost = new_cost
            A[:] = A_new
            g[:] = g_new
            converged = converged or _largest(g) <= gradient_eps
            mu *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            nu = 2.0
        else:
            mu *= nu
            nu *= 2.0
    return T, cost, _unscaled(A, scale), iterations, evaluations, converged


@njit(cache=True, nogil=True)
def double_dogleg(  # type: ignore[no-untyped-def]
    T_start,
    points,
    observed,
    weights,
    camera,
    scale,
    motion,
    max_iterations,
    gradient_eps,
    step_eps,
    radius,
):
    """P1 Algorithm 2 after Dennis & Mei: the double dogleg path cut by the trust region."""
    T, T_new = T_start.copy(), T_start.copy()
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    A_new, g_new = np.zeros((6, 6)), np.zeros(6)
    cost = _linearise(T, points, observed, weights, camera, scale, A, g)
    evaluations, iterations = 1, 0
    if not np.isfinite(cost):  # a point behind the camera: no place to start from
        return T, cost, np.zeros((6, 6)), iterations, evaluations, False
    converged = _largest(g) <= gradient_eps
    while not converged and iterations < max_iterations:
        iterations += 1
        if not double_dogleg_step(A, g, radius, step):
            break
        length = _norm(step)
        small = length <= step_eps * (motion + step_eps)
        retract(T, step * scale, T_new)
        new_cost = _linearise(T_new, points, observed, weights, camera, scale, A_new, g_new)
        evaluations += 1
        predicted = np.dot(g, step) - 0.5 * np.dot(step, np.dot(A, step))
        gain = (cost - new_cost) / predicted if predicted > 0.0 else -1.0
        if gain < _SHRINK_BELOW:
            radius *= _SHRINK
        elif gain > _GROW_ABOVE and length > 0.99 * radius:
            radius *= _GROW
        if gain > 0.0:
            T[:] = T_new
            cost = new_cost
            A[:] = A_new
            g[:] = g_new
        converged = small or _largest(g) <= gradient_eps or radius <= step_eps * (motion + step_eps)
    return T, cost, _unscaled(A, scale), iterations, evaluations, converged


@njit(cache=True, nogil=True)
def double_dogleg_step(A, g, radius, step):  # type: ignore[no-untyped-def]
    """Write the point of the double dogleg path at distance ``radius`` (or its end) to ``step``.

    Dennis & Mei 1979, section 3.  Returns False when the model has no descent direction.
    """
    gg = np.dot(g, g)
    gAg = np.dot(g, np.dot(A, g))
    if not (gAg > 0.0 and gg > 0.0):
        return False
    cauchy = gg / gAg * g
    newton = np.zeros(len(g))
    if not solve_positive(A, g, newton):
        # A valley without a floor: follow the gradient as far as the region allows.
        step[:] = cauchy * min(1.0, radius / _norm(cauchy))
        return True
    newton_length, cauchy_length = _norm(newton), _norm(cauchy)
    # kappa, which the paper only bounds by [0, 1], is Dennis & Mei's ratio.
    kappa = gg * gg / (gAg * np.dot(g, newton))
    eta = _NEWTON_BIAS + (1.0 - _NEWTON_BIAS) * kappa
    if newton_length <= radius:
        step[:] = newton
    elif cauchy_length >= radius:
        step[:] = radius / cauchy_length * cauchy
    elif eta * newton_length <= radius:
        step[:] = radius / newton_length * newton
    else:
        along = eta * newton - cauchy
        a, b = np.dot(along, along), np.dot(cauchy, along)
        c = radius * radius - cauchy_length * cauchy_length
        root = np.sqrt(b * b + a * c)
        beta = c / (b + root) if b > 0.0 else (root - b) / a
        step[:] = cauchy + beta * along
    return True


@njit(cache=True, nogil=True)
def _linearise(T, points, observed, weights, camera, scale, A, g):  # type: ignore[no-untyped-def]
    cost = linearise_reprojection(T, points, observed, weights, camera, A, g)
    for i in range(6):
        g[i] *= scale[i]
        for j in range(6):
            A[i, j] *= scale[i] * scale[j]
    return cost


@njit(cache=True, nogil=True)
def _unscaled(A, scale):  # type: ignore[no-untyped-def]
    result = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            result[i, j] = A[i, j] / (scale[i] * scale[j])
    return result


@njit(cache=True, nogil=True)
def _norm(v):  # type: ignore[no-untyped-def]
    return np.sqrt(np.dot(v, v))


@njit(cache=True, nogil=True)
def _largest(v):  # type: ignore[no-untyped-def]
    return np.max(np.abs(v))
