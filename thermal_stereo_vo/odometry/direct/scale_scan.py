"""How well the points of one camera fit a map of another for each length of the lever arm.

A map from one camera has no size.  When the rig turns, the other camera moves by its lever arm, a
known number of metres: the tracks of its own points tell how long the arm is in units of the map.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.direct.frame_alignment import invert
from thermal_stereo_vo.odometry.direct.photometric import COLUMNS, PIXELS, RHO, linearise_patch

_STEPS = 3


@njit(cache=True, nogil=True)
def scan_scales(  # type: ignore[no-untyped-def]
    images, slots, T_k_w, T_then_now, camera, T_rig_camera, hosts, bearings, rhos, rho_priors,
    prior_information, patches, trusts, seen, factors, gate, costs
):  # fmt: skip
    """Add to ``costs`` (S,) what the points of one camera cost with its arm ``factors`` as long.

    ``images`` (slots, H, W, 3), ``camera`` (4,), ``T_rig_camera`` (4, 4), ``T_then_now`` (K, 4, 4)
    and ``seen`` (N, K) of that camera; poses are held, depths follow.  The mean residual of a patch
    does not count, so that the brightness of the images need not be known.  Returns how many
    patches there are.
    """
    K, N = len(T_k_w), len(hosts)
    r, J = np.empty(PIXELS), np.empty((PIXELS, COLUMNS))
    T_rc, T_camera_now, T_now_camera = T_rig_camera.copy(), np.empty((K, 4, 4)), np.empty((K, 4, 4))
    T, T_inv, arms = np.empty((4, 4)), np.empty((4, 4)), np.zeros((2, 3))
    T_rel = np.empty((K, K, 4, 4))
    step = np.array([1.0 / camera[0], 1.0 / camera[1]])
    limit = gate * gate
    count = 0
    for i in range(len(factors)):
        for m in range(3):
            T_rc[m, 3] = factors[i] * T_rig_camera[m, 3]
        invert(T_rc, T)
        for t in range(K):
            T_camera_now[t] = T @ T_then_now[t]
            invert(T_camera_now[t], T_now_camera[t])
        for h in range(K):
            invert(T_k_w[h], T_inv)
            for t in range(K):
                T_rel[h, t] = T_k_w[t] @ T_inv @ T_now_camera[h]
        for n in range(N):
            h = hosts[n]
            trust = 0.0
            for k in range(PIXELS):
                trust += trusts[n, k]
            if not trust > 0.0:
                continue
            best = np.inf
            rho = rhos[n]
            for _ in range(_STEPS):
                off = rho_priors[n] - rho
                H, b = prior_information[n], prior_information[n] * off
                cost = prior_information[n] * off * off
                for t in range(K):
                    if not seen[n, t]:
                        continue
                    if not linearise_patch(
                        images[slots[t]], camera, 1.0, T_rel[h, t], T_camera_now[t], arms,
                        bearings[n], rho, step, patches[n], 1.0, 0.0, 0.0, r, J,
                    ):  # fmt: skip
                        cost += limit * trust
                        continue
                    mean, slope = 0.0, 0.0
                    for k in range(PIXELS):
                        mean += trusts[n, k] * r[k]
                        slope += trusts[n, k] * J[k, RHO]
                    mean /= trust
                    slope /= trust
                    energy = 0.0
                    h_patch, b_patch = 0.0, 0.0
                    for k in range(PIXELS):
                        e, j = r[k] - mean, J[k, RHO] - slope
                        energy += trusts[n, k] * e * e
                        h_patch += trusts[n, k] * j * j
                        b_patch -= trusts[n, k] * j * e
                    # Smoothly flat beyond the gate: a patch that fits nowhere says nothing.
                    share = limit * trust / (limit * trust + energy)
                    cost += share * energy
                    H += share * share * h_patch
                    b += share * share * b_patch
                best = min(best, cost)
                if not H > 0.0:
                    break
                rho = max(rho + b / H, 1e-5)
            costs[i] += best
    for n in range(N):
        for t in range(K):
            count += seen[n, t]
    return count
