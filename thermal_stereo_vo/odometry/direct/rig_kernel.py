"""How the second camera's own patches pull at where the rig says that it is."""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.direct.frame_alignment import POSE, invert
from thermal_stereo_vo.odometry.direct.photometric import (
    COLUMNS,
    PIXELS,
    RHO,
    linearise_patch,
)


@njit(cache=True, nogil=True)
def linearise_rig(  # type: ignore[no-untyped-def]
    images, slots, T_then, camera, T_camera_rig, rhos, hosts, bearings, rho_priors,
    prior_information, patches, trusts, seen, gate, A, g, W, h_rho, b_rho, energies
):  # fmt: skip
    """Normal equations of the left perturbation (6,) of one camera's ``T_camera_rig`` (4, 4).

    ``images`` (slots, H, W, 3), ``camera`` (4,) and ``seen`` (N, K) of that camera, which hosts the
    N points; ``T_then`` (K, 4, 4) rig from world when it looked.  Perturbed by xi, the way from one
    of its views to another, M, becomes exp(xi) M exp(-xi), so that the Jacobian of a patch is that
    by the target's pose times (I - Ad_M).  The mean residual of a patch does not count; beyond
    ``gate`` its pull fades.  Depths (N,) are eliminated from ``A`` (6, 6) and ``g`` (6,): they
    follow by ``W`` (N, 6), ``h_rho`` and ``b_rho`` (N,).  ``energies`` (N, K) are mean squared
    residuals, NaN where a patch is not seen.  Returns the cost of everything seen.
    """
    K, N = len(T_then), len(hosts)
    r, J = np.empty(PIXELS), np.empty((PIXELS, COLUMNS))
    T_camera, T_inv = np.empty((K, 4, 4)), np.empty((K, 4, 4))
    M, ways, here = np.empty((K, K, 4, 4)), np.empty((K, K, POSE, POSE)), np.eye(4)
    arms, mean, w = np.zeros((2, 3)), np.empty(POSE + 1), np.empty(POSE)
    hold, pull = np.zeros((K, K, POSE, POSE)), np.zeros((K, K, POSE))
    step = np.array([1.0 / camera[0], 1.0 / camera[1]])
    for t in range(K):
        T_camera[t] = T_camera_rig @ T_then[t]
        invert(T_camera[t], T_inv[t])
    for h in range(K):
        for t in range(K):
            M[h, t] = T_camera[t] @ T_inv[h]
            one_minus_adjoint(M[h, t], ways[h, t])
    limit = gate * gate
    A[:] = 0.0
    g[:] = 0.0
    energies[:] = np.nan
    total = 0.0
    for n in range(N):
        h = hosts[n]
        W[n] = 0.0
        off = rho_priors[n] - rhos[n]
        h_rho[n], b_rho[n] = prior_information[n], prior_information[n] * off
        total += prior_information[n] * off * off
        trust = 0.0
        for k in range(PIXELS):
            trust += trusts[n, k]
        if not trust > 0.0:
            continue
        for t in range(K):
            if not seen[n, t]:
                continue
            if not linearise_patch(
                images[slots[t]], camera, 1.0, M[h, t], here, arms, bearings[n], rhos[n], step,
                patches[n], 1.0, 0.0, 0.0, r, J,
            ):  # fmt: skip
                total += limit * trust
                continue
            middle = 0.0
            mean[:] = 0.0
            for k in range(PIXELS):
                J[k, POSE] = J[k, RHO]
                middle += trusts[n, k] * r[k] / trust
                for m in range(POSE + 1):
                    mean[m] += trusts[n, k] * J[k, m] / trust
            energy = 0.0
            for k in range(PIXELS):
                r[k] -= middle
                energy += trusts[n, k] * r[k] * r[k]
            energies[n, t] = energy / trust
            share = limit * trust / (limit * trust + energy)
            total += share * energy
            for k in range(PIXELS):
                for m in range(POSE + 1):
                    J[k, m] -= mean[m]
            w[:] = 0.0
            for k in range(PIXELS):
                weight = share * share * trusts[n, k]
                h_rho[n] += weight * J[k, POSE] * J[k, POSE]
                b_rho[n] -= weight * J[k, POSE] * r[k]
                for m in range(POSE):
                    w[m] += weight * J[k, m] * J[k, POSE]
                    pull[h, t, m] -= weight * J[k, m] * r[k]
                    for i in range(POSE):
                        hold[h, t, m, i] += weight * J[k, m] * J[k, i]
            for m in range(POSE):
                for i in range(POSE):
                    W[n, m] += ways[h, t, i, m] * w[i]
        if not h_rho[n] > 0.0:
            continue
        for m in range(POSE):
            g[m] -= W[n, m] * b_rho[n] / h_rho[n]
            for i in range(POSE):
                A[m, i] -= W[n, m] * W[n, i] / h_rho[n]
    for h in range(K):
        for t in range(K):
            A += ways[h, t].T @ hold[h, t] @ ways[h, t]
            g += ways[h, t].T @ pull[h, t]
    return total


@njit(cache=True, nogil=True)
def one_minus_adjoint(M, out):  # type: ignore[no-untyped-def]
    """Write I - Ad (6, 6) of the motion ``M`` (4, 4); tangent vectors are (rho, phi)."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            out[i, m] = out[3 + i, 3 + m] = -M[i, m]
            out[3 + i, m] = 0.0
            out[i, 3 + m] = M[b, 3] * M[a, m] - M[a, 3] * M[b, m]
    for i in range(POSE):
        out[i, i] += 1.0
