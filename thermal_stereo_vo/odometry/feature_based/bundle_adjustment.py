"""Joint refinement of a few keyframes and their points (local bundle adjustment).

Unknowns: poses of all keyframes but the oldest, inverse depths of all points.  Each point has one
unknown, so eliminating it (Schur complement; Triggs et al., Bundle Adjustment, 2000) is a division.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.kernels import retract, solve_positive
from thermal_stereo_vo.odometry.clustered_covariance import clustered_covariance
from thermal_stereo_vo.odometry.feature_based.frame_pose import (
    frame_residuals_reference,
    robust_sigma,
)
from thermal_stereo_vo.odometry.feature_based.inverse_depth import (
    COMPONENTS,
    cauchy_cost,
    cauchy_weight,
    counts,
    point_in_camera,
    pose_rows,
    relative_transform,
    residual_row,
)
from thermal_stereo_vo.odometry.feature_based.point_scatter import point_pulls
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.information import inverse_information

RHO_MIN = 1e-5


@dataclass(frozen=True)
class BundleProblem:
    """Keyframes and what they saw.

    ``T_k_w`` (K, 4, 4) keyframes, oldest first, the oldest held fixed; points with ``hosts`` (N,)
    index of keyframe, ``bearings`` (N, 3), ``rhos`` (N,) 1/m; ``observed`` (K, N, 4) px with NaN
    where unseen; ``weights`` (K, N); ``eyes`` (9,), see ``KeyframeWindow.eyes``.
    """

    T_k_w: NDArray[np.float64]
    hosts: NDArray[np.int64]
    bearings: NDArray[np.float64]
    rhos: NDArray[np.float64]
    observed: NDArray[np.float64]
    weights: NDArray[np.float64]
    eyes: NDArray[np.float64]


@dataclass(frozen=True)
class BundleSolution:
    """Keyframes and depths at the minimum.

    ``T_k_w`` (K, 4, 4); ``rhos`` (N,) with ``rho_information`` (N,) px^2 m^2 given the poses;
    ``covariance`` (6 (K-1), 6 (K-1)) of the left perturbations of all keyframes but the oldest;
    ``residuals`` (K, N, 4) px.  ``turn_information`` (3, 3) 1/rad^2 and ``turn_score`` (3,) 1/rad
    say how a turn of the right eye would lower the cost further: by about
    ``information^-1 score``, everything else adjusted.
    """

    T_k_w: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_information: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    sigma_px: float
    iterations: int
    turn_information: NDArray[np.float64]
    turn_score: NDArray[np.float64]


def adjust_bundle(
    problem: BundleProblem, *, sigma_floor_px: float, iterations: int
) -> BundleSolution | None:
    """Minimise the robust reprojection error; None when the equations have no solution."""
    T, rhos = problem.T_k_w.copy(), problem.rhos.copy()
    residuals = np.full(problem.observed.shape, np.nan)
    free = 6 * (len(T) - 1)
    A, g = np.zeros((free, free)), np.zeros(free)
    W, h_rho, b_rho = np.zeros((len(rhos), free)), np.zeros(len(rhos)), np.zeros(len(rhos))
    fixed = (
        problem.hosts, problem.bearings, problem.observed, problem.weights, problem.eyes,
    )  # fmt: skip
    done = 0
    sigma_px = sigma_floor_px
    for half in (iterations // 2, iterations - iterations // 2):
        window_residuals(T, rhos, *fixed, residuals)
        sigma_px = max(robust_sigma(residuals), sigma_floor_px)
        used = iterate_bundle(T, rhos, *fixed, 2.385 * sigma_px, half, A, g, W, h_rho, b_rho)
        if used < 0:
            return None
        done += used
    window_residuals(T, rhos, *fixed, residuals)
    unit_covariance = inverse_information(A)
    if unit_covariance is None:
        return None
    pulls = np.zeros_like(W)
    steepness = point_pulls(T, rhos, *fixed, 2.385 * sigma_px, pulls)
    covariance = clustered_covariance(A, unit_covariance, pulls, steepness, sigma_floor_px)
    if covariance is None:
        covariance = sigma_px**2 * unit_covariance
    D, d = np.zeros((3, 3)), np.zeros(3)
    turn_information(T, rhos, *fixed, 2.385 * sigma_px, unit_covariance, g, W, h_rho, b_rho, D, d)
    return BundleSolution(
        T,
        rhos,
        h_rho,
        covariance,
        residuals,
        sigma_px,
        done,
        D / sigma_px**2,
        d / sigma_px**2,
    )


@njit(cache=True, nogil=True)
def window_residuals(T, rhos, hosts, bearings, observed, weights, eyes, out):  # type: ignore[no-untyped-def]
    """Write (K, N, 4) residuals in px; NaN where unseen or without weight."""
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    for n in range(len(hosts)):
        for c in range(len(T)):
            relative_transform(T[c], T[hosts[n]], R, t)
            point_in_camera(R, t, bearings[n], rhos[n], p)
            for k in range(COMPONENTS):
                out[c, n, k] = np.nan
                if weights[c, n] > 0.0 and counts(k, c, hosts[n], observed[c, n]):
                    out[c, n, k] = residual_row(k, p, rhos[n], observed[c, n, k], eyes, row, q)


def window_residuals_reference(
    T_k_w: NDArray[np.float64],
    rhos: NDArray[np.float64],
    problem: BundleProblem,
    right_turn_rad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(K, N, 4) residuals in px, the plain numpy form of ``window_residuals``."""
    camera = StereoCamera(*problem.eyes[:6])
    out = np.stack(
        [
            frame_residuals_reference(
                T, T_k_w, problem.hosts, problem.bearings, rhos, seen, camera, right_turn_rad
            )
            for T, seen in zip(T_k_w, problem.observed, strict=True)
        ]
    )
    at_home = np.arange(len(T_k_w))[:, None] == problem.hosts
    out[at_home] = np.where(np.arange(COMPONENTS) == 2, out[at_home], np.nan)
    out[problem.weights <= 0.0] = np.nan
    return out


@njit(cache=True, nogil=True)
def linearise_bundle(  # type: ignore[no-untyped-def]
    T, rhos, hosts, bearings, observed, weights, eyes, width, A, g, W, h_rho, b_rho
):
    """Reduced normal equations ``A`` (6F, 6F), ``g`` (6F,) of the F = K - 1 free keyframes.

    Keeps ``W`` (N, 6F), ``h_rho`` and ``b_rho`` (N,) for the back substitution.  Returns the cost.
    For T = T_c T_h^-1 and left perturbations: dp = [rho I, -skew(p)] of the camera,
    dp = -R [rho I, -skew(b)] of the host, dp = t of the inverse depth.
    """
    baseline = eyes[5]
    keyframes = len(T)
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    Jc, Jh = np.empty(6), np.empty(6)
    A[:] = 0.0
    g[:] = 0.0
    W[:] = 0.0
    cost = 0.0
    for n in range(len(hosts)):
        h = hosts[n]
        rho = rhos[n]
        b = bearings[n]
        w = W[n]
        h_rho[n] = b_rho[n] = 0.0
        for c in range(keyframes):
            if weights[c, n] <= 0.0:
                continue
            relative_transform(T[c], T[h], R, t)
            point_in_camera(R, t, b, rho, p)
            for k in range(COMPONENTS):
                if not counts(k, c, h, observed[c, n]):
                    continue
                r = residual_row(k, p, rho, observed[c, n, k], eyes, row, q)
                if np.isnan(r):
                    continue
                weight = weights[c, n] * cauchy_weight(r, width)
                cost += weights[c, n] * cauchy_cost(r, width)
                j_rho = row[0] * t[0] + row[1] * t[1] + row[2] * t[2]
                if k >= 2:
                    j_rho -= row[0] * baseline
                h_rho[n] += weight * j_rho * j_rho
                b_rho[n] += weight * j_rho * r
                if c == h:
                    continue
                pose_rows(row, R, p, b, rho, Jc, Jh)
                ci, hi = 6 * (c - 1), 6 * (h - 1)
                for i in range(6):
                    if c > 0:
                        wj = weight * Jc[i]
                        g[ci + i] += wj * r
                        w[ci + i] += wj * j_rho
                        for m in range(6):
                            A[ci + i, ci + m] += wj * Jc[m]
                            if h > 0:
                                A[ci + i, hi + m] += wj * Jh[m]
                    if h > 0:
                        wj = weight * Jh[i]
                        g[hi + i] += wj * r
                        w[hi + i] += wj * j_rho
                        for m in range(6):
                            A[hi + i, hi + m] += wj * Jh[m]
                            if c > 0:
                                A[hi + i, ci + m] += wj * Jc[m]
        if h_rho[n] > 0.0:
            for i in range(len(g)):
                if w[i] == 0.0:
                    continue
                factor = w[i] / h_rho[n]
                g[i] -= factor * b_rho[n]
                for m in range(len(g)):
                    A[i, m] -= factor * w[m]
    return cost


@njit(cache=True, nogil=True)
def turn_information(  # type: ignore[no-untyped-def]
    T, rhos, hosts, bearings, observed, weights, eyes, width, A_inverse, g, W, h_rho, b_rho, D, d
):
    """Reduced normal equations ``D`` (3, 3), ``d`` (3,) of a turn of the right eye.

    ``A_inverse``, ``g``, ``W``, ``h_rho`` and ``b_rho`` as ``linearise_bundle`` left them at the
    minimum.  Only the columns of the right eye count: they tell a turn from motion by points of
    different depth.  The turned point is q = p + turn x p.
    """
    baseline = eyes[5]
    keyframes, free = len(T), len(g)
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    J, Jc, Jh = np.empty(3), np.empty(6), np.empty(6)
    cross, to_rho = np.zeros((3, free)), np.empty(3)
    D[:] = 0.0
    d[:] = 0.0
    for n in range(len(hosts)):
        h, rho, b = hosts[n], rhos[n], bearings[n]
        to_rho[:] = 0.0
        if h_rho[n] <= 0.0:
            continue
        for c in range(keyframes):
            if weights[c, n] <= 0.0 or not counts(2, c, h, observed[c, n]):
                continue
            relative_transform(T[c], T[h], R, t)
            point_in_camera(R, t, b, rho, p)
            r = residual_row(2, p, rho, observed[c, n, 2], eyes, row, q)
            if np.isnan(r):
                continue
            weight = weights[c, n] * cauchy_weight(r, width)
            iz = 1.0 / q[2]
            across, along = eyes[0] * iz, -eyes[0] * q[0] * iz * iz
            x, y, z = p[0] - rho * baseline, p[1], p[2]
            J[0], J[1], J[2] = along * y, across * z - along * x, -across * y
            j_rho = row[0] * (t[0] - baseline) + row[1] * t[1] + row[2] * t[2]
            for i in range(3):
                d[i] += weight * J[i] * r
                to_rho[i] += weight * J[i] * j_rho
                for m in range(3):
                    D[i, m] += weight * J[i] * J[m]
            if c == h:
                continue
            pose_rows(row, R, p, b, rho, Jc, Jh)
            for i in range(3):
                for m in range(6):
                    if c > 0:
                        cross[i, 6 * (c - 1) + m] += weight * J[i] * Jc[m]
                    if h > 0:
                        cross[i, 6 * (h - 1) + m] += weight * J[i] * Jh[m]
        for i in range(3):
            factor = to_rho[i] / h_rho[n]
            d[i] -= factor * b_rho[n]
            for m in range(3):
                D[i, m] -= factor * to_rho[m]
            for m in range(free):
                cross[i, m] -= factor * W[n, m]
    for i in range(3):
        for m in range(free):
            total = 0.0
            for k in range(free):
                total += cross[i, k] * A_inverse[k, m]
            d[i] -= total * g[m]
            for k in range(3):
                D[i, k] -= total * cross[k, m]


@njit(cache=True, nogil=True)
def iterate_bundle(  # type: ignore[no-untyped-def]
    T, rhos, hosts, bearings, observed, weights, eyes, width, iterations, A, g, W, h_rho, b_rho
):
    """Levenberg-Marquardt in place; returns the iterations used, -1 when there is no solution."""
    free = len(g)
    T_new, rhos_new = T.copy(), rhos.copy()
    A_new, g_new, W_new = np.zeros_like(A), np.zeros_like(g), np.zeros_like(W)
    h_new, b_new = np.zeros_like(h_rho), np.zeros_like(b_rho)
    damped, step = np.zeros_like(A), np.zeros(free)
    damping = 1e-6
    cost = linearise_bundle(
        T, rhos, hosts, bearings, observed, weights, eyes, width, A, g, W, h_rho, b_rho
    )
    for iteration in range(iterations):
        damped[:] = A
        for i in range(free):
            damped[i, i] += damping * A[i, i] + 1e-9
        if not solve_positive(damped, g, step):
            return -1
        for c in range(1, len(T)):
            retract(T[c], step[6 * (c - 1) : 6 * c], T_new[c])
        for n in range(len(rhos)):
            if h_rho[n] > 0.0:
                delta = (b_rho[n] - np.dot(W[n], step)) / h_rho[n]
                rhos_new[n] = max(rhos[n] + delta, RHO_MIN)
        new_cost = linearise_bundle(
            T_new, rhos_new, hosts, bearings, observed, weights, eyes, width,
            A_new, g_new, W_new, h_new, b_new,
        )  # fmt: skip
        if new_cost <= cost:
            small = cost - new_cost <= 1e-6 * cost
            cost = new_cost
            T[:] = T_new
            rhos[:] = rhos_new
            A[:] = A_new
            g[:] = g_new
            W[:] = W_new
            h_rho[:] = h_new
            b_rho[:] = b_new
            damping = max(0.1 * damping, 1e-9)
            if small:
                return iteration + 1
        else:
            damping = max(10.0 * damping, 1e-4)
    return iterations
