"""Joint refinement of a few keyframes, their brightness and the inverse depths of their points.

Photometric bundle adjustment after Engel et al. (DSO, TPAMI 2018) and Wang et al. (Stereo DSO,
ICCV 2017).  Unknowns of a keyframe: left perturbation of its pose, then a and b of each camera.
Each point has one unknown, so eliminating it (Schur complement) is a division.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.kernels import solve_positive
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry.direct.frame_alignment import invert
from thermal_stereo_vo.odometry.direct.photometric import (
    COLUMNS,
    PIXELS,
    huber_weight,
    linearise_patch,
    patch_energy,
)
from thermal_stereo_vo.odometry.information import inverse_information

RHO_MIN = 1e-5
_POSE = 6
_PAIR = 8
_BRIGHTNESS_DAMPING = 1.0
"""Holds brightness that nothing shows, as that of a camera that was blind."""


@dataclass(frozen=True)
class PhotometricProblem:
    """Keyframes, their images and their points.

    ``images`` one (slots, H, W, 3) float32 stack per camera and ``slots`` (K,) where the keyframes
    stand in it, oldest first; ``T_k_w`` (K, 4, 4); ``brightness`` (K, C, 2); ``cameras`` (C, 4) fx
    fy cx cy; ``T_rig_camera`` (C, 4, 4); points sorted by host: ``hosts`` (N,) index of keyframe,
    ``host_cameras`` (N,), ``bearings`` (N, 3), ``rhos`` (N,) 1/m, ``patches`` and ``trusts``
    (N, 8); ``seen`` (N, K, C) bool, which residuals there are.
    """

    images: tuple[NDArray[np.float32], ...]
    slots: NDArray[np.int64]
    T_k_w: NDArray[np.float64]
    brightness: NDArray[np.float64]
    cameras: NDArray[np.float64]
    T_rig_camera: NDArray[np.float64]
    hosts: NDArray[np.int64]
    host_cameras: NDArray[np.int64]
    bearings: NDArray[np.float64]
    rhos: NDArray[np.float64]
    patches: NDArray[np.float64]
    trusts: NDArray[np.float64]
    seen: NDArray[np.bool_]


@dataclass(frozen=True)
class PhotometricSolution:
    """Keyframes, brightness and depths at the minimum.

    ``energies`` (N, K, C) mean squared residual of each patch, NaN where it is not seen;
    ``rho_information`` (N,) and ``covariance`` (6 (K-1), 6 (K-1)) of the left perturbations of all
    keyframes but the oldest are for the noise ``sigma`` that was found.
    """

    T_k_w: NDArray[np.float64]
    brightness: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_information: NDArray[np.float64]
    covariance: NDArray[np.float64]
    energies: NDArray[np.float64]
    sigma: float
    iterations: int


@dataclass
class _Equations:
    """Normal equations at one state, reduced to the keyframes."""

    A: NDArray[np.float64]
    g: NDArray[np.float64]
    W: NDArray[np.float64]
    h_rho: NDArray[np.float64]
    b_rho: NDArray[np.float64]
    energies: NDArray[np.float64]
    cost: float = 0.0

    @classmethod
    def of(cls, problem: PhotometricProblem) -> _Equations:
        n, k, c = problem.seen.shape
        size = k * (_POSE + 2 * c)
        return cls(
            np.zeros((size, size)), np.zeros(size), np.zeros((n, size)), np.zeros(n), np.zeros(n),
            np.full((n, k, c), np.nan),
        )  # fmt: skip


def adjust_photometrically(
    problem: PhotometricProblem, *, huber: float, gate: float, iterations: int
) -> PhotometricSolution | None:
    """Minimise the photometric error, the oldest pose and its first camera's brightness held.

    None when the equations have no solution.
    """
    cameras = problem.seen.shape[2]
    size = _POSE + 2 * cameras
    free = np.ones(len(problem.T_k_w) * size, np.bool_)
    free[: _POSE + 2] = False
    is_brightness = np.arange(len(free)) % size >= _POSE
    T, brightness, rhos = problem.T_k_w.copy(), problem.brightness.copy(), problem.rhos.copy()
    now, then = _Equations.of(problem), _Equations.of(problem)
    _linearise(problem, T, brightness, rhos, huber, gate, now)
    damping, done = 1e-5, 0
    while done < iterations:
        done += 1
        damped = now.A.copy()
        damped[np.diag_indices_from(damped)] += damping * np.diag(now.A) + 1e-6
        damped[is_brightness, is_brightness] += _BRIGHTNESS_DAMPING
        moves = np.zeros(np.count_nonzero(free))
        if not solve_positive(damped[np.ix_(free, free)], now.g[free], moves):
            return None
        step = np.zeros(len(free))
        step[free] = moves
        T_new, brightness_new, rhos_new = _moved(T, brightness, rhos, now, step)
        _linearise(problem, T_new, brightness_new, rhos_new, huber, gate, then)
        if then.cost < now.cost:
            small = now.cost - then.cost < 1e-4 * now.cost
            T, brightness, rhos = T_new, brightness_new, rhos_new
            now, then = then, now
            damping = max(0.2 * damping, 1e-8)
            if small:
                break
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e3:
                break
    A = now.A
    A[is_brightness, is_brightness] += _BRIGHTNESS_DAMPING
    unit_covariance = inverse_information(A[np.ix_(free, free)])
    if unit_covariance is None:
        return None
    is_pose = ~is_brightness[free]
    sigma = noise_of(now.energies, gate)
    return PhotometricSolution(
        T, brightness, rhos, now.h_rho, sigma**2 * unit_covariance[np.ix_(is_pose, is_pose)],
        now.energies, sigma, done,
    )  # fmt: skip


def noise_of(energies: NDArray[np.float64], gate: float) -> float:
    """Root of the mean energy of the patches that are believed; that of the gate when none is."""
    good = energies[energies < gate * gate]
    return float(np.sqrt(np.mean(good))) if len(good) else gate


def _moved(
    T: NDArray[np.float64],
    brightness: NDArray[np.float64],
    rhos: NDArray[np.float64],
    equations: _Equations,
    step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    per_frame = step.reshape(len(T), -1)
    T_new = np.stack([exp_se3(d[:_POSE]) @ T_k for d, T_k in zip(per_frame, T, strict=True)])
    brightness_new = brightness + per_frame[:, _POSE:].reshape(brightness.shape)
    shown = equations.h_rho > 0.0
    delta = np.zeros(len(rhos))
    delta[shown] = (equations.b_rho - equations.W @ step)[shown] / equations.h_rho[shown]
    return T_new, brightness_new, np.maximum(rhos + delta, RHO_MIN)


def _linearise(
    problem: PhotometricProblem,
    T: NDArray[np.float64],
    brightness: NDArray[np.float64],
    rhos: NDArray[np.float64],
    huber: float,
    gate: float,
    out: _Equations,
) -> None:
    out.cost = linearise_window(
        problem.images, problem.slots, T, brightness, problem.cameras, problem.T_rig_camera,
        problem.hosts, problem.host_cameras, problem.bearings, rhos, problem.patches,
        problem.trusts, problem.seen, huber, gate,
        out.A, out.g, out.W, out.h_rho, out.b_rho, out.energies,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def linearise_window(  # type: ignore[no-untyped-def]
    images, slots, T_k_w, brightness, cameras, T_rig_camera, hosts, host_cameras, bearings, rhos,
    patches, trusts, seen, huber, gate, A, g, W, h_rho, b_rho, energies
):  # fmt: skip
    """Reduced normal equations of all keyframes; keeps W, h_rho and b_rho for the depths.

    For T = T_t T_h^-1 and left perturbations of both, d r / d host = -(d r / d target) Ad(T), so
    the equations of each pair are gathered for the target alone and carried over to the host at
    the end of its points.  Returns the cost.
    """
    K, C = len(T_k_w), len(cameras)
    D = _POSE + 2 * C
    r, J = np.empty(PIXELS), np.empty((PIXELS, COLUMNS))
    T, T_h_inv = np.empty((4, 4)), np.empty((4, 4))
    T_camera_rig = np.empty((C, 4, 4))
    for c in range(C):
        invert(T_rig_camera[c], T_camera_rig[c])
    steps = np.empty((C, 2))
    for c in range(C):
        steps[c, 0] = 1.0 / cameras[c, 0]
        steps[c, 1] = 1.0 / cameras[c, 1]
    pair_A, pair_g = np.zeros((K, C, _PAIR, _PAIR)), np.zeros((K, C, _PAIR))
    T_rel = np.empty((K, 4, 4))
    Ad = np.zeros((K, 6, 6))
    w = np.empty(_PAIR)
    A[:] = 0.0
    g[:] = 0.0
    W[:] = 0.0
    cost = 0.0
    limit = gate * gate
    h, hc = -1, -1
    for n in range(len(hosts)):
        if hosts[n] != h or host_cameras[n] != hc:
            if h >= 0:
                flush_pairs(h, hc, Ad, brightness, pair_A, pair_g, A, g)
            h, hc = hosts[n], host_cameras[n]
            invert(T_k_w[h], T_h_inv)
            for t in range(K):
                T[:] = T_k_w[t] @ T_h_inv
                write_adjoint(T, Ad[t])
                T_rel[t] = T @ T_rig_camera[hc]
        h_rho[n] = b_rho[n] = 0.0
        trust = 0.0
        for k in range(PIXELS):
            trust += trusts[n, k]
        for t in range(K):
            for c in range(C):
                energies[n, t, c] = np.nan
                if not seen[n, t, c] or not trust > 0.0:
                    continue
                gain = np.exp(brightness[t, c, 0] - brightness[h, hc, 0])
                if not linearise_patch(
                    images[c][slots[t]], cameras[c], 1.0, T_rel[t], T_camera_rig[c], bearings[n],
                    rhos[n], steps[hc], patches[n], gain, brightness[h, hc, 1],
                    brightness[t, c, 1], r, J,
                ):  # fmt: skip
                    cost += limit * trust
                    continue
                energy = patch_energy(r, trusts[n], huber)
                energies[n, t, c] = energy / trust
                if energy > limit * trust:
                    cost += limit * trust
                    continue
                cost += energy
                w[:] = 0.0
                # In its own host a point moves with the rig: only depth and brightness count.
                first = _POSE if t == h else 0
                H, v = pair_A[t, c], pair_g[t, c]
                for k in range(PIXELS):
                    weight = trusts[n, k] * huber_weight(r[k], huber)
                    j_rho = J[k, 8]
                    h_rho[n] += weight * j_rho * j_rho
                    b_rho[n] -= weight * j_rho * r[k]
                    for i in range(first, _PAIR):
                        wj = weight * J[k, i]
                        v[i] -= wj * r[k]
                        w[i] += wj * j_rho
                        for m in range(i, _PAIR):
                            H[i, m] += wj * J[k, m]
                row = W[n]
                at, ah = t * D, h * D
                if t != h:
                    for i in range(_POSE):
                        row[at + i] += w[i]
                        total = 0.0
                        for m in range(_POSE):
                            total += Ad[t, m, i] * w[m]
                        row[ah + i] -= total
                row[at + _POSE + 2 * c] += w[6]
                row[at + _POSE + 2 * c + 1] += w[7]
                row[ah + _POSE + 2 * hc] -= w[6]
                row[ah + _POSE + 2 * hc + 1] -= gain * w[7]
    if h >= 0:
        flush_pairs(h, hc, Ad, brightness, pair_A, pair_g, A, g)
    scaled = np.empty_like(W)
    for n in range(len(hosts)):
        # A point that nothing shows has no row in W either.
        factor = 1.0 / h_rho[n] if h_rho[n] > 0.0 else 0.0
        for i in range(len(g)):
            scaled[n, i] = factor * W[n, i]
            g[i] -= scaled[n, i] * b_rho[n]
    A -= scaled.T @ W
    return cost


@njit(cache=True, nogil=True)
def write_adjoint(T, out):  # type: ignore[no-untyped-def]
    """Write the (6, 6) adjoint of a motion, order (rho, phi)."""
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for j in range(3):
        a, b, c = T[0, j], T[1, j], T[2, j]
        out[0, j] = out[3, 3 + j] = a
        out[1, j] = out[4, 3 + j] = b
        out[2, j] = out[5, 3 + j] = c
        out[0, 3 + j] = y * c - z * b
        out[1, 3 + j] = z * a - x * c
        out[2, 3 + j] = x * b - y * a


@njit(cache=True, nogil=True)
def flush_pairs(h, hc, Ad, brightness, pair_A, pair_g, A, g):  # type: ignore[no-untyped-def]
    """Add the equations of one host's pairs to those of the keyframes, and clear them."""
    K, C = pair_g.shape[0], pair_g.shape[1]
    D = _POSE + 2 * C
    B = np.zeros((_PAIR, 2 * _PAIR))
    index = np.empty(2 * _PAIR, np.int64)
    for t in range(K):
        for c in range(C):
            H, v = pair_A[t, c], pair_g[t, c]
            B[:] = 0.0
            for i in range(_PAIR):
                B[i, i] = 1.0
            for i in range(_POSE):
                for m in range(_POSE):
                    B[i, _PAIR + m] = -Ad[t, i, m]
                index[i], index[_PAIR + i] = t * D + i, h * D + i
            B[6, _PAIR + 6] = -1.0
            B[7, _PAIR + 7] = -np.exp(brightness[t, c, 0] - brightness[h, hc, 0])
            for i in range(2):
                index[6 + i] = t * D + _POSE + 2 * c + i
                index[_PAIR + 6 + i] = h * D + _POSE + 2 * hc + i
            for i in range(_PAIR):
                for m in range(i):
                    H[i, m] = H[m, i]
            full = B.T @ H @ B
            right = B.T @ v
            for i in range(2 * _PAIR):
                g[index[i]] += right[i]
                for m in range(2 * _PAIR):
                    A[index[i], index[m]] += full[i, m]
            H[:] = 0.0
            v[:] = 0.0


def residuals_of_window(problem: PhotometricProblem) -> NDArray[Any]:
    """(N, K, C, 8) residuals, NaN where there are none: the plain form for tests."""
    from thermal_stereo_vo.core.transforms import inverse
    from thermal_stereo_vo.odometry.direct.photometric import residuals_reference

    out = np.full((*problem.seen.shape, PIXELS), np.nan)
    for n, t, c in zip(*np.nonzero(problem.seen), strict=True):
        h, hc = problem.hosts[n], problem.host_cameras[n]
        T_rig_host = problem.T_k_w[t] @ inverse(problem.T_k_w[h]) @ problem.T_rig_camera[hc]
        out[n, t, c] = residuals_reference(
            problem.images[c][problem.slots[t]],
            problem.cameras[c],
            1.0,
            inverse(problem.T_rig_camera[c]) @ T_rig_host,
            problem.bearings[n],
            float(problem.rhos[n]),
            1.0 / problem.cameras[hc, :2],
            problem.patches[n],
            tuple(problem.brightness[h, hc]),
            tuple(problem.brightness[t, c]),
        )
    return out
