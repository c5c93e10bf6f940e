"""Pose of one stereo frame against points of a keyframe window whose depths are uncertain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.kernels import retract, solve_positive
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.feature_based.inverse_depth import (
    COMPONENTS,
    cauchy_cost,
    cauchy_weight,
    point_in_camera,
    predict_pixels_reference,
    relative_transform,
    residual_row,
    uses_component,
)
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.information import inverse_information


@dataclass(frozen=True)
class FramePose:
    """A pose and how well it fits.

    ``T_camera_world`` (4, 4); ``covariance`` (6, 6) of its left perturbation, given the keyframes;
    ``residuals`` (N, 4) px, NaN where unused; ``sigma_px`` robust noise.
    """

    T_camera_world: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    sigma_px: float


def refine_frame_pose(
    T_start: NDArray[np.float64],
    T_hosts: NDArray[np.float64],
    hosts: NDArray[np.int64],
    bearings: NDArray[np.float64],
    rhos: NDArray[np.float64],
    rho_information: NDArray[np.float64],
    observed: NDArray[np.float64],
    weights: NDArray[np.float64],
    eyes: NDArray[np.float64],
    *,
    sigma_floor_px: float,
    iterations: int = 12,
) -> FramePose | None:
    """Robust joint estimate of the pose and the inverse depths, depths held by what is known.

    ``T_start`` (4, 4) T_camera_world; ``T_hosts`` (slots, 4, 4) T_keyframe_world; ``hosts`` (N,);
    ``bearings`` (N, 3); ``rhos`` (N,) with ``rho_information`` (N,) px^2 m^2; ``observed`` (N, 4);
    ``weights`` (N,).  The width of the Cauchy kernel follows the residuals' median.  None when the
    equations have no solution.
    """
    T = T_start.copy()
    residuals = np.full(observed.shape, np.nan)
    A, g = np.zeros((6, 6)), np.zeros(6)
    sigma_px = 4.0 * sigma_floor_px
    for round_ in range(2):
        # Two rounds: the first kernel is wide, the second as wide as the noise that was found.
        frame_residuals(T, T_hosts, hosts, bearings, rhos, observed, eyes, residuals)
        sigma_px = max(robust_sigma(residuals), sigma_floor_px)
        if round_ == 0:
            sigma_px *= 2.0
        if not iterate_frame_pose(
            T, T_hosts, hosts, bearings, rhos, rho_information, observed, weights, eyes,
            2.385 * sigma_px, iterations, A, g,
        ):  # fmt: skip
            return None
    frame_residuals(T, T_hosts, hosts, bearings, rhos, observed, eyes, residuals)
    unit_covariance = inverse_information(A)
    if unit_covariance is None:
        return None
    return FramePose(T, sigma_px**2 * unit_covariance, residuals, sigma_px)


def robust_sigma(residuals: NDArray[np.float64]) -> float:
    """Standard deviation of the residuals (px) from their median size; 0 without residuals."""
    sizes = np.abs(residuals[np.isfinite(residuals)])
    return 1.4826 * float(np.median(sizes)) if len(sizes) else 0.0


@njit(cache=True, nogil=True)
def frame_residuals(T, T_hosts, hosts, bearings, rhos, observed, eyes, out):  # type: ignore[no-untyped-def]
    """Write the (N, 4) residuals in px, NaN for components that do not count."""
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    last = -1
    for n in range(len(hosts)):
        if hosts[n] != last:
            last = hosts[n]
            relative_transform(T, T_hosts[last], R, t)
        point_in_camera(R, t, bearings[n], rhos[n], p)
        for k in range(COMPONENTS):
            out[n, k] = np.nan
            if uses_component(k, observed[n]):
                out[n, k] = residual_row(k, p, rhos[n], observed[n, k], eyes, row, q)


def frame_residuals_reference(
    T: NDArray[np.float64],
    T_hosts: NDArray[np.float64],
    hosts: NDArray[np.int64],
    bearings: NDArray[np.float64],
    rhos: NDArray[np.float64],
    observed: NDArray[np.float64],
    camera: StereoCamera,
    right_turn_rad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N, 4) residuals in px, the plain numpy form of ``frame_residuals``."""
    predicted = np.full(observed.shape, np.nan)
    for host in np.unique(hosts):
        mine = hosts == host
        predicted[mine] = predict_pixels_reference(
            T @ inverse(T_hosts[host]), bearings[mine], rhos[mine], camera, right_turn_rad
        )
    residuals: NDArray[np.float64] = observed - predicted
    residuals[np.isfinite(observed[:, 0]), 3] = np.nan
    return residuals


@njit(cache=True, nogil=True)
def linearise_frame(  # type: ignore[no-untyped-def]
    T, T_hosts, hosts, bearings, rhos, rho_information, observed, weights, eyes, width, A, g
):
    """Normal equations of the pose, inverse depths eliminated (Schur); returns the cost.

    Left perturbation T <- Exp(delta) T: dp = [rho I, -skew(p)] delta and dp = t drho.
    """
    baseline = eyes[5]
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    J, w = np.empty(6), np.empty(6)
    A[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    last = -1
    for n in range(len(hosts)):
        if hosts[n] != last:
            last = hosts[n]
            relative_transform(T, T_hosts[last], R, t)
        rho = rhos[n]
        point_in_camera(R, t, bearings[n], rho, p)
        h_rho, b_rho = rho_information[n], 0.0
        w[:] = 0.0
        for k in range(COMPONENTS):
            if not uses_component(k, observed[n]):
                continue
            r = residual_row(k, p, rho, observed[n, k], eyes, row, q)
            if np.isnan(r):
                continue
            weight = weights[n] * cauchy_weight(r, width)
            cost += weights[n] * cauchy_cost(r, width)
            # The right eye sees p shifted along x, which does not turn: the lever arm is p.
            J[0], J[1], J[2] = rho * row[0], rho * row[1], rho * row[2]
            J[3] = p[1] * row[2] - p[2] * row[1]
            J[4] = p[2] * row[0] - p[0] * row[2]
            J[5] = p[0] * row[1] - p[1] * row[0]
            j_rho = row[0] * t[0] + row[1] * t[1] + row[2] * t[2]
            if k >= 2:
                j_rho -= row[0] * baseline
            h_rho += weight * j_rho * j_rho
            b_rho += weight * j_rho * r
            for i in range(6):
                wj = weight * J[i]
                g[i] += wj * r
                w[i] += wj * j_rho
                for m in range(i, 6):
                    A[i, m] += wj * J[m]
        if h_rho > 0.0:
            for i in range(6):
                g[i] -= w[i] * b_rho / h_rho
                for m in range(i, 6):
                    A[i, m] -= w[i] * w[m] / h_rho
    for i in range(6):
        for m in range(i):
            A[i, m] = A[m, i]
    return cost


@njit(cache=True, nogil=True)
def iterate_frame_pose(  # type: ignore[no-untyped-def]
    T, T_hosts, hosts, bearings, rhos, rho_information, observed, weights, eyes, width,
    iterations, A, g
):  # fmt: skip
    """Damped Gauss-Newton on the pose alone; ``T``, ``A`` and ``g`` end at the minimum."""
    step, T_new = np.zeros(6), T.copy()
    damped, A_new, g_new = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    damping = 1e-6
    cost = linearise_frame(
        T, T_hosts, hosts, bearings, rhos, rho_information, observed, weights, eyes, width, A, g
    )
    for _ in range(iterations):
        damped[:] = A
        for i in range(6):
            damped[i, i] += damping * A[i, i] + 1e-9
        if not solve_positive(damped, g, step):
            return False
        retract(T, step, T_new)
        new_cost = linearise_frame(
            T_new, T_hosts, hosts, bearings, rhos, rho_information, observed, weights, eyes,
            width, A_new, g_new,
        )  # fmt: skip
        if new_cost <= cost:
            T[:] = T_new
            A[:] = A_new
            g[:] = g_new
            small = cost - new_cost <= 1e-7 * cost
            cost = new_cost
            damping = max(0.1 * damping, 1e-9)
            if small:
                break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e6:
                break
    return True


def prosac_samples(rng: np.random.Generator, count: int, iterations: int) -> NDArray[np.int64]:
    """(iterations, 3) indices into points sorted best first, from a pool that grows to all.

    After PROSAC (Chum & Matas, CVPR 2005): good triples are tried first.
    """
    first = min(count, max(10, count // 5))
    pool = np.minimum(count, np.linspace(first, 2 * count, iterations).astype(np.int64))
    return (rng.random((iterations, 3)) * pool[:, None]).astype(np.int64)


@njit(cache=True, nogil=True)
def samples_needed(inliers, count, confidence, most):  # type: ignore[no-untyped-def]
    """How many triples hold one of inliers alone with this confidence; at most ``most``.

    Fischler & Bolles, CACM 24, 1981, section II: log(1 - confidence) / log(1 - share^3).
    """
    share = (inliers / count) ** 3
    if share >= 1.0:
        return 0
    if share <= 1e-9:
        return most
    return min(most, int(np.ceil(np.log(1.0 - confidence) / np.log(1.0 - share))))


@njit(cache=True, nogil=True)
def ransac_frame_pose(  # type: ignore[no-untyped-def]
    T_start, T_hosts, hosts, bearings, rhos, observed, eyes, samples, inlier_px, confidence
):
    """Best of many 3-point poses by the number of inliers; works with one eye or two.

    ``T_start`` competes with them: where it is good already, few samples are tried.  Returns the
    number of inliers and (4, 4) T_camera_world.
    """
    n = len(hosts)
    ones, firm = np.ones(3), np.full(3, 1e30)
    h3, b3, r3, o3 = np.empty(3, np.int64), np.empty((3, 3)), np.empty(3), np.empty((3, 4))
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    best_T, T, T_new = T_start.copy(), T_start.copy(), T_start.copy()
    chosen = np.empty(n, np.bool_)
    best = mark_inliers(best_T, T_hosts, hosts, bearings, rhos, observed, eyes, inlier_px, chosen)
    needed = samples_needed(best, n, confidence, len(samples))
    for s in range(len(samples)):
        if s >= needed:
            break
        a, b, c = samples[s, 0], samples[s, 1], samples[s, 2]
        if a in (b, c) or b == c:
            continue
        for m in range(3):
            i = samples[s, m]
            h3[m], b3[m], r3[m], o3[m] = hosts[i], bearings[i], rhos[i], observed[i]
        T[:] = T_start
        good = False
        for _ in range(15):
            linearise_frame(T, T_hosts, h3, b3, r3, firm, o3, ones, eyes, 1e6, A, g)
            for i in range(6):
                A[i, i] = A[i, i] * (1.0 + 1e-9) + 1e-12
            if not solve_positive(A, g, step):
                break
            retract(T, step, T_new)
            T[:] = T_new
            largest = np.max(np.abs(step))
            if largest < 1e-5:
                good = True
                break
            if largest > 100.0:
                break
        if not good:
            continue
        count = mark_inliers(T, T_hosts, hosts, bearings, rhos, observed, eyes, inlier_px, chosen)
        if count > best:
            best = count
            best_T[:] = T
            needed = samples_needed(best, n, confidence, needed)
    return best, best_T


@njit(cache=True, nogil=True)
def mark_inliers(  # type: ignore[no-untyped-def]
    T, T_hosts, hosts, bearings, rhos, observed, eyes, inlier_px, out
):
    """Write (N,) bool, whether every seen component is within ``inlier_px``; returns how many."""
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    last, count = -1, 0
    for n in range(len(hosts)):
        if hosts[n] != last:
            last = hosts[n]
            relative_transform(T, T_hosts[last], R, t)
        point_in_camera(R, t, bearings[n], rhos[n], p)
        good, seen = True, 0
        for k in range(COMPONENTS):
            if uses_component(k, observed[n]):
                r = residual_row(k, p, rhos[n], observed[n, k], eyes, row, q)
                seen += 1
                # A NaN fails the comparison, as it should.
                good = good and abs(r) < inlier_px
        out[n] = good and seen >= 2
        if out[n]:
            count += 1
    return count
