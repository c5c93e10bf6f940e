"""Normal equations of a window of keyframes, points eliminated.

Photometric bundle adjustment after Engel et al. (DSO, TPAMI 2018); scale after Dai et al. 2019.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.direct.frame_alignment import invert
from thermal_stereo_vo.odometry.direct.photometric import (
    COLUMNS,
    LAG,
    PIXELS,
    RHO,
    SCALE,
    huber_weight,
    linearise_patch,
    patch_energy,
    resample_patch,
)

POSE = 6
_PAIR = 10
"""Motion of the target, its brightness, and scale and lag, which all pairs share."""


@njit(cache=True, nogil=True)
def linearise_window(  # type: ignore[no-untyped-def]
    images, slots, T_k_w, twists, late, T_then_now, brightness, cameras, T_rig_camera, hosts,
    host_cameras, bearings, rhos, rho_priors, prior_information, patches, trusts, seen, bands,
    bolometers, trust_gradient, huber, gate, A, g, W, h_rho, b_rho, energies
):  # fmt: skip
    """Reduced normal equations of all keyframes; keeps W, h_rho and b_rho for the depths.

    For T = T_t T_h^-1 and left perturbations of both, d r / d host = -(d r / d target) Ad(T), so
    the equations of each pair are gathered for the target alone and carried over to the host at
    the end of its points.  Returns the cost.
    """
    K, C = len(T_k_w), len(cameras)
    D = POSE + 2 * C
    r, J = np.empty(PIXELS), np.zeros((PIXELS, COLUMNS))
    drifts, drift_c, Ad_c = np.zeros((K, C, 6)), np.zeros((C, 6)), np.zeros((6, 6))
    patch, trusts_here, slopes = np.empty(PIXELS), np.empty(PIXELS), np.zeros((3, PIXELS))
    T, T_h_inv = np.empty((4, 4)), np.empty((4, 4))
    T_c_hc, arms = np.empty((C, 4, 4)), np.empty((K, C, 2, 3))
    # Of the rig at the stamp, though the camera looked a little earlier.
    T_camera_now, T_now_camera = np.empty((K, C, 4, 4)), np.empty((K, C, 4, 4))
    own_arms, arms_now, arms_c = np.empty((C, 3)), np.empty((K, C, 3)), np.empty((C, 3))
    for c in range(C):
        invert(T_rig_camera[c], T)
        own_arms[c] = T[:3, 3]
        for t in range(K):
            T_camera_now[t, c] = T @ T_then_now[t, c]
            invert(T_camera_now[t, c], T_now_camera[t, c])
            invert(T_then_now[t, c], T_h_inv)
            arms_now[t, c] = turned(T_h_inv, T_rig_camera[c, :3, 3])
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
                flush_pairs(h, hc, bands, Ad, brightness, pair_A, pair_g, A, g)
            h, hc = hosts[n], host_cameras[n]
            for c in range(C):
                T_c_hc[c] = T_camera_now[h, c] @ T_now_camera[h, hc]
                arms_c[c] = own_arms[c] + turned(T_camera_now[h, c], arms_now[h, hc])
                write_adjoint(T_camera_now[h, c], Ad_c)
                drift_c[c] = (late[c] - late[hc]) * (Ad_c @ twists[h])
            invert(T_k_w[h], T_h_inv)
            for t in range(K):
                T[:] = T_k_w[t] @ T_h_inv
                write_adjoint(T, Ad[t])
                T_rel[t] = T @ T_now_camera[h, hc]
                for c in range(C):
                    arms[t, c, 0] = turned(T, arms_now[h, hc])
                    arms[t, c, 1] = own_arms[c]
                    drifts[t, c] = late[c] * twists[t] - late[hc] * (Ad[t] @ twists[h])
        off = rho_priors[n] - rhos[n]
        h_rho[n] = prior_information[n]
        b_rho[n] = prior_information[n] * off
        cost += prior_information[n] * off * off
        for t in range(K):
            for c in range(C):
                energies[n, t, c] = np.nan
                if not seen[n, t, c]:
                    continue
                across = bands and c != hc
                # Whose brightness the patch has: that of the host, or of the other camera then.
                owner = c if across else hc
                if across:
                    if not resample_patch(
                        images[c][slots[h]], cameras[c], T_c_hc[c], arms_c[c], drift_c[c],
                        bearings[n], rhos[n], steps[hc], trust_gradient, patch, trusts_here, slopes,
                    ):  # fmt: skip
                        continue
                else:
                    for k in range(PIXELS):
                        patch[k] = patches[n, k]
                        trusts_here[k] = trusts[n, k]
                trust = 0.0
                for k in range(PIXELS):
                    trust += trusts_here[k]
                if not trust > 0.0:
                    continue
                if bolometers[c]:
                    trust = PIXELS
                gain = np.exp(brightness[t, c, 0] - brightness[h, owner, 0])
                if not linearise_patch(
                    images[c][slots[t]], cameras[c], 1.0, T_rel[t], T_camera_now[t, c], arms[t, c],
                    bearings[n], rhos[n], steps[hc], patch, gain, brightness[h, owner, 1],
                    brightness[t, c, 1], r, J,
                ):  # fmt: skip
                    cost += limit * trust
                    continue
                for k in range(PIXELS):
                    J[k, LAG] = 0.0
                    for i in range(POSE):
                        J[k, LAG] += J[k, i] * drifts[t, c, i]
                    if across:
                        J[k, SCALE] -= gain * slopes[0, k]
                        J[k, LAG] -= gain * slopes[1, k]
                        J[k, RHO] -= gain * slopes[2, k]
                energy = patch_energy(r, trusts_here, huber)
                energies[n, t, c] = energy / trust
                if energy > limit * trust:
                    cost += limit * trust
                    continue
                cost += energy
                w[:] = 0.0
                # In its own host a point moves with the rig: only depth and brightness count.
                first = POSE if t == h else 0
                H, v = pair_A[t, c], pair_g[t, c]
                for k in range(PIXELS):
                    weight = trusts_here[k] * huber_weight(r[k], huber)
                    j_rho = J[k, RHO]
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
                    for i in range(POSE):
                        row[at + i] += w[i]
                        total = 0.0
                        for m in range(POSE):
                            total += Ad[t, m, i] * w[m]
                        row[ah + i] -= total
                row[at + POSE + 2 * c] += w[6]
                row[at + POSE + 2 * c + 1] += w[7]
                row[ah + POSE + 2 * owner] -= w[6]
                row[ah + POSE + 2 * owner + 1] -= gain * w[7]
                row[K * D] += w[8]
                row[K * D + 1] += w[9]
    if h >= 0:
        flush_pairs(h, hc, bands, Ad, brightness, pair_A, pair_g, A, g)
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
def turned(T, direction):  # type: ignore[no-untyped-def]
    """(3,) a direction after the rotation of a motion (4, 4)."""
    out = np.empty(3)
    for i in range(3):
        out[i] = T[i, 0] * direction[0] + T[i, 1] * direction[1] + T[i, 2] * direction[2]
    return out


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
def flush_pairs(h, hc, bands, Ad, brightness, pair_A, pair_g, A, g):  # type: ignore[no-untyped-def]
    """Add the equations of one host's pairs to those of the keyframes, and clear them."""
    K, C = pair_g.shape[0], pair_g.shape[1]
    D = POSE + 2 * C
    own = POSE + 2
    B = np.zeros((_PAIR, _PAIR + own))
    index = np.empty(_PAIR + own, np.int64)
    index[_PAIR - 2], index[_PAIR - 1] = K * D, K * D + 1
    for t in range(K):
        for c in range(C):
            H, v = pair_A[t, c], pair_g[t, c]
            owner = c if bands else hc
            B[:] = 0.0
            for i in range(_PAIR):
                B[i, i] = 1.0
            for i in range(POSE):
                for m in range(POSE):
                    B[i, _PAIR + m] = -Ad[t, i, m]
                index[i], index[_PAIR + i] = t * D + i, h * D + i
            B[6, _PAIR + 6] = -1.0
            B[7, _PAIR + 7] = -np.exp(brightness[t, c, 0] - brightness[h, owner, 0])
            for i in range(2):
                index[6 + i] = t * D + POSE + 2 * c + i
                index[_PAIR + 6 + i] = h * D + POSE + 2 * owner + i
            for i in range(_PAIR):
                for m in range(i):
                    H[i, m] = H[m, i]
            full = B.T @ H @ B
            right = B.T @ v
            for i in range(_PAIR + own):
                g[index[i]] += right[i]
                for m in range(_PAIR + own):
                    A[index[i], index[m]] += full[i, m]
            H[:] = 0.0
            v[:] = 0.0
