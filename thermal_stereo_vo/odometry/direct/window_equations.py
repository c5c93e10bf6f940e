"""Normal equations of a window of keyframes, points eliminated.

Photometric bundle adjustment after Engel et al. (DSO, TPAMI 2018); scale after Dai et al. 2019.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.direct.frame_alignment import invert
from thermal_stereo_vo.odometry.direct.patch_sums import (
    AA,
    AB,
    AR,
    BB,
    BR,
    BY_LAG,
    BY_RHO,
    SLOPES,
    SUMS,
    XA,
    XB,
    XR,
    XX,
    XY,
    YA,
    YB,
    YR,
    YY,
    compare_patch,
    gather_patch,
    middle_slopes,
    middle_slopes_at_home,
    relative_to_home,
    share_slopes,
    view_patch,
    warp_of_patch,
)
from thermal_stereo_vo.odometry.direct.photometric import PIXELS

POSE = 6
_PAIR, _TAIL = 10, 2
"""Motion of the target, its brightness, and scale and lag, which all pairs share."""


@njit(cache=True, nogil=True)
def linearise_window(  # type: ignore[no-untyped-def]
    images, slots, T_k_w, twists, late, T_then_now, brightness, T_slopes, brightness_slopes,
    cameras, T_rig_camera, hosts, host_cameras, bearings, rhos, rho_priors, prior_information,
    patches, trusts, seen, bands, bolometers, trust_gradient, looseness, huber, gate, A, g, W,
    h_rho, b_rho, energies, pulls
):  # fmt: skip
    """Reduced normal equations of all keyframes; keeps W, h_rho and b_rho for the depths.

    For T = T_t T_h^-1 and left perturbations of both, d r / d host = -(d r / d target) Ad(T), so
    the equations of each pair are gathered for the target alone and carried over to the host at
    the end of its points.  Residuals and slopes of images are those at ``T_k_w`` and
    ``brightness``; how pixels move with the poses is taken at ``T_slopes`` (K, 4, 4) and
    ``brightness_slopes`` (K, C, 2), which are the first estimates of what has a prior.  ``pulls``
    (N, U) gets the part of each point in ``g``; without rows nothing is asked.  Returns the cost,
    and by how much less than the weights say residuals pull as they grow: the mean slope of Huber's
    influence over its mean weight (Robust Statistics, 1981, sec. 7.6), 1 where nothing is asked.
    """
    K, C = len(T_k_w), len(cameras)
    D = POSE + 2 * C
    count = len(hosts)
    view, r, weights = np.empty((3, PIXELS)), np.empty(PIXELS), np.empty(PIXELS)
    sums, G, w, tail = np.empty(SUMS), np.zeros((2, SLOPES)), np.empty(_PAIR), np.empty(_TAIL)
    # What all targets are compared with, of each point of a host and of the one at work.
    group, group_slopes = np.empty((count, 2, PIXELS)), np.empty((count, 2, PIXELS))
    group_trust, group_G = np.empty(count), np.empty((count, 2, 3))
    patch, trusts_here = np.empty(PIXELS), np.empty(PIXELS)
    home, G_home = np.empty((3, PIXELS)), np.empty((2, 3))
    warp, warp_back = np.empty((2, 2)), np.empty((2, 2))
    T, T_h_inv, T_w_hc = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    T_c_hc, arms = np.empty((C, 4, 4)), np.empty((K * C, 2, 3))
    drifts, drift_c, Ad_c = np.zeros((K, C, 6)), np.zeros((C, 6)), np.zeros((6, 6))
    # Of the rig at the stamp, though the camera looked a little earlier.
    T_camera_now, T_now_camera = np.empty((K * C, 4, 4)), np.empty((K * C, 4, 4))
    own_arms, arms_now, arms_c = np.empty((C, 3)), np.empty((K, C, 3)), np.empty((C, 3))
    for c in range(C):
        invert(T_rig_camera[c], T)
        own_arms[c] = T[:3, 3]
        for t in range(K):
            compose(T, T_then_now[t, c], T_camera_now[t * C + c])
            invert(T_camera_now[t * C + c], T_now_camera[t * C + c])
            invert(T_then_now[t, c], T_h_inv)
            arms_now[t, c] = turned(T_h_inv, T_rig_camera[c, :3, 3])
    pair_A, pair_g = np.zeros((K * C, _PAIR, _PAIR)), np.zeros((K * C, _PAIR))
    T_there, T_slope = np.empty((K * C, 4, 4)), np.empty((K, 4, 4))
    gains, slope_gains = np.empty((K, C)), np.empty((K, C))
    Ad = np.zeros((K, 6, 6))
    A[:] = 0.0
    g[:] = 0.0
    W[:] = 0.0
    pulls[:] = 0.0
    asked, own = len(pulls) > 0, np.empty(_PAIR)
    slopes = total_weight = 0.0
    cost = 0.0
    limit = gate * gate
    c2 = trust_gradient * trust_gradient
    energies[:] = np.nan
    start = 0
    while start < count:
        h, hc = hosts[start], host_cameras[start]
        stop = start + 1
        while stop < count and hosts[stop] == h and host_cameras[stop] == hc:
            stop += 1
        for c in range(C):
            compose(T_camera_now[h * C + c], T_now_camera[h * C + hc], T_c_hc[c])
            arms_c[c] = own_arms[c] + turned(T_camera_now[h * C + c], arms_now[h, hc])
            write_adjoint(T_camera_now[h * C + c], Ad_c)
            drift_c[c] = (late[c] - late[hc]) * (Ad_c @ twists[h])
        invert(T_k_w[h], T)
        compose(T, T_now_camera[h * C + hc], T_w_hc)
        invert(T_slopes[h], T_h_inv)
        for t in range(K):
            compose(T_k_w[t], T_w_hc, T)
            for c in range(C):
                compose(T_camera_now[t * C + c], T, T_there[t * C + c])
            compose(T_slopes[t], T_h_inv, T)
            write_adjoint(T, Ad[t])
            compose(T, T_now_camera[h * C + hc], T_slope[t])
            for c in range(C):
                owner = c if bands else hc
                for i in range(3):
                    arms[t * C + c, 0, i] = (
                        T[i, 0] * arms_now[h, hc, 0]
                        + T[i, 1] * arms_now[h, hc, 1]
                        + T[i, 2] * arms_now[h, hc, 2]
                    )
                    arms[t * C + c, 1, i] = own_arms[c, i]
                for i in range(POSE):
                    total = 0.0
                    for m in range(POSE):
                        total += Ad[t, i, m] * twists[h, m]
                    drifts[t, c, i] = late[c] * twists[t, i] - late[hc] * total
                gains[t, c] = np.exp(brightness[t, c, 0] - brightness[h, owner, 0])
                slope_gains[t, c] = np.exp(
                    brightness_slopes[t, c, 0] - brightness_slopes[h, owner, 0]
                )
        for n in range(start, stop):
            off = rho_priors[n] - rhos[n]
            h_rho[n] = prior_information[n]
            b_rho[n] = prior_information[n] * off
            cost += prior_information[n] * off * off
        sx, sy = 1.0 / cameras[hc, 0], 1.0 / cameras[hc, 1]
        ah = h * D
        for c in range(C):
            across = bands and c != hc
            stack = images[c]
            camera = cameras[c, 0], cameras[c, 1], cameras[c, 2], cameras[c, 3]
            # Whose brightness the patch has: that of the host, or of the other camera then.
            owner = c if across else hc
            loose = 0.0 if across else looseness[c]
            b_host, b_slope = brightness[h, owner, 1], brightness_slopes[h, owner, 1]
            for n in range(start, stop):
                m = n - start
                x, y = bearings[n, 0], bearings[n, 1]
                group_trust[m] = 0.0
                if across:
                    if not view_patch(
                        stack, slots[h], camera, T_c_hc, c, x, y, rhos[n], sx, sy, home
                    ):
                        continue
                    middle_slopes_at_home(T_c_hc, arms_c, drift_c, c, x, y, rhos[n], G_home)
                    group_G[m] = G_home
                for k in range(PIXELS):
                    if across:
                        u, v = home[1, k] / camera[0], home[2, k] / camera[1]
                        group[m, 0, k] = home[0, k]
                        group[m, 1, k] = c2 / (c2 + u * u + v * v)
                        group_slopes[m, 0, k], group_slopes[m, 1, k] = home[1, k], home[2, k]
                    else:
                        group[m, 0, k], group[m, 1, k] = patches[n, k], trusts[n, k]
                    group_trust[m] += group[m, 1, k]
                if bolometers[c] and group_trust[m] > 0.0:
                    group_trust[m] = PIXELS
            # One image after the other: they are larger than caches.
            for t in range(K):
                pair, at, gain = t * C + c, t * D, slope_gains[t, c]
                for n in range(start, stop):
                    trust = group_trust[n - start]
                    if not seen[n, t, c] or not trust > 0.0:
                        continue
                    x, y = bearings[n, 0], bearings[n, 1]
                    shown = view_patch(
                        stack, slots[t], camera, T_there, pair, x, y, rhos[n], sx, sy, view
                    )
                    if shown and across:
                        shown = warp_of_patch(
                            T_there, pair, T_c_hc, c, x, y, rhos[n], warp, warp_back
                        )
                    if not shown:
                        cost += limit * trust
                        continue
                    for k in range(PIXELS):
                        patch[k] = group[n - start, 0, k]
                        trusts_here[k] = group[n - start, 1, k]
                    energy = compare_patch(
                        view, patch, trusts_here, gains[t, c], b_host, brightness[t, c, 1], huber,
                        r, weights,
                    )  # fmt: skip
                    energies[n, t, c] = energy / trust
                    if energy > limit * trust:
                        cost += limit * trust
                        continue
                    cost += energy
                    if across:
                        share_slopes(group_slopes, n - start, gain, warp_back, view)
                    cost -= gather_patch(view, patch, gain, b_slope, loose, r, weights, sums)
                    if asked:
                        own[:] = pair_g[pair]
                        for k in range(PIXELS):
                            total_weight += weights[k]
                            if abs(r[k]) <= huber:
                                slopes += weights[k]
                    middle_slopes(T_slope, t, T_camera_now, pair, arms, x, y, rhos[n], G)
                    for m in range(2):
                        G[m, BY_LAG] = 0.0
                        for i in range(POSE):
                            G[m, BY_LAG] += G[m, i] * drifts[t, c, i]
                    if across:
                        relative_to_home(warp, group_G, n - start, G)
                    # In its own host a point moves with the rig: only depth and brightness count.
                    first = POSE if t == h else 0
                    add_slopes(G, sums, first, pair, pair_A, pair_g, w, tail)
                    if asked:
                        for i in range(_PAIR):
                            own[i] = pair_g[pair, i] - own[i]
                        carry_pull(own, Ad[t], t, h, c, owner, C, gain, pulls[n])
                    h_rho[n] += tail[0]
                    b_rho[n] -= tail[1]
                    if t != h:
                        for i in range(POSE):
                            W[n, at + i] += w[i]
                            total = 0.0
                            for m in range(POSE):
                                total += Ad[t, m, i] * w[m]
                            W[n, ah + i] -= total
                    W[n, at + POSE + 2 * c] += w[6]
                    W[n, at + POSE + 2 * c + 1] += w[7]
                    W[n, ah + POSE + 2 * owner] -= w[6]
                    W[n, ah + POSE + 2 * owner + 1] -= gain * w[7]
                    W[n, K * D] += w[8]
                    W[n, K * D + 1] += w[9]
        flush_pairs(h, hc, bands, Ad, slope_gains, pair_A, pair_g, A, g)
        start = stop
    eliminate_points(W, h_rho, b_rho, A, g)
    for n in range(len(pulls)):
        if h_rho[n] > 0.0:
            for i in range(len(g)):
                pulls[n, i] -= W[n, i] / h_rho[n] * b_rho[n]
    return cost, slopes / total_weight if total_weight > 0.0 else 1.0


@njit(cache=True, nogil=True)
def add_slopes(G, sums, first, pair, H, v, w, tail):  # type: ignore[no-untyped-def]
    """Add a patch to the upper half of ``H`` (P, 10, 10) and to ``v`` (P, 10) of a ``pair``.

    ``G`` (2, SLOPES) and ``sums`` as ``patch_sums`` writes them; columns of the motion before
    ``first`` are left out.  Writes ``w`` (10,), the products with the inverse depth, and ``tail``:
    information and right side of that.
    """
    x_rho, y_rho = G[0, BY_RHO], G[1, BY_RHO]
    tx_rho = sums[XX] * x_rho + sums[XY] * y_rho
    ty_rho = sums[XY] * x_rho + sums[YY] * y_rho
    tail[0] = x_rho * tx_rho + y_rho * ty_rho
    tail[1] = x_rho * sums[XR] + y_rho * sums[YR]
    for i in range(first):
        w[i] = 0.0
    for i in range(first, SLOPES - 1):
        at = i if i < POSE else i + 2
        x, y = G[0, i], G[1, i]
        tx = sums[XX] * x + sums[XY] * y
        ty = sums[XY] * x + sums[YY] * y
        v[pair, at] -= x * sums[XR] + y * sums[YR]
        w[at] = x * tx_rho + y * ty_rho
        by_a, by_b = x * sums[XA] + y * sums[YA], x * sums[XB] + y * sums[YB]
        if i < POSE:
            H[pair, i, 6] += by_a
            H[pair, i, 7] += by_b
        else:
            H[pair, 6, at] += by_a
            H[pair, 7, at] += by_b
        for m in range(first, i + 1):
            H[pair, m if m < POSE else m + 2, at] += G[0, m] * tx + G[1, m] * ty
    v[pair, 6] -= sums[AR]
    v[pair, 7] -= sums[BR]
    w[6] = x_rho * sums[XA] + y_rho * sums[YA]
    w[7] = x_rho * sums[XB] + y_rho * sums[YB]
    H[pair, 6, 6] += sums[AA]
    H[pair, 6, 7] += sums[AB]
    H[pair, 7, 7] += sums[BB]


@njit(cache=True, nogil=True)
def eliminate_points(W, h_rho, b_rho, A, g):  # type: ignore[no-untyped-def]
    """Take the inverse depths, (N, U) ``W`` with ``h_rho`` and ``b_rho`` (N,), out of A and g."""
    count = len(g)
    for n in range(len(h_rho)):
        # A point that nothing shows has no row in W either.
        if not h_rho[n] > 0.0:
            continue
        row = W[n]
        for i in range(count):
            if row[i] == 0.0:
                continue
            factor = row[i] / h_rho[n]
            g[i] -= factor * b_rho[n]
            out = A[i]
            for m in range(i, count):
                out[m] -= factor * row[m]
    for i in range(count):
        for m in range(i):
            A[i, m] = A[m, i]


@njit(cache=True, nogil=True)
def carry_pull(own, Ad, t, h, c, owner, cameras, gain, out):  # type: ignore[no-untyped-def]
    """Add what a patch pulls at its pair, ``own`` (10,), to all unknowns (U,), as ``flush_pairs``.

    Seen by camera ``c`` at ``t``; its brightness is that of ``owner`` at ``h``.
    """
    D = POSE + 2 * cameras
    for i in range(POSE):
        out[t * D + i] += own[i]
        for k in range(POSE):
            out[h * D + i] -= Ad[k, i] * own[k]
    out[t * D + POSE + 2 * c] += own[6]
    out[t * D + POSE + 2 * c + 1] += own[7]
    out[h * D + POSE + 2 * owner] -= own[6]
    out[h * D + POSE + 2 * owner + 1] -= gain * own[7]
    out[-2] += own[8]
    out[-1] += own[9]


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
def flush_pairs(h, hc, bands, Ad, gains, pair_A, pair_g, A, g):  # type: ignore[no-untyped-def]
    """Add the equations of one host's pairs to those of the keyframes, and clear them.

    A host's motion and brightness act as -Ad^T and -1, -gain times those of the target.
    """
    K, C = gains.shape
    D = POSE + 2 * C
    own = POSE + 2
    mixed, at, ah = np.empty((_PAIR, own)), np.empty(_PAIR, np.int64), np.empty(own, np.int64)
    at[8], at[9] = K * D, K * D + 1
    for i in range(POSE):
        ah[i] = h * D + i
    for t in range(K):
        for i in range(POSE):
            at[i] = t * D + i
        for c in range(C):
            H, v = pair_A[t * C + c], pair_g[t * C + c]
            if H[7, 7] == 0.0:  # every patch adds to it
                continue
            owner, gain = c if bands else hc, gains[t, c]
            for i in range(2):
                at[6 + i] = t * D + POSE + 2 * c + i
                ah[6 + i] = h * D + POSE + 2 * owner + i
            for i in range(_PAIR):
                for m in range(i):
                    H[i, m] = H[m, i]
            for i in range(_PAIR):
                g[at[i]] += v[i]
                for m in range(_PAIR):
                    A[at[i], at[m]] += H[i, m]
                for m in range(POSE):
                    total = 0.0
                    for k in range(POSE):
                        total -= H[i, k] * Ad[t, k, m]
                    mixed[i, m] = total
                mixed[i, 6] = -H[i, 6]
                mixed[i, 7] = -gain * H[i, 7]
                for m in range(own):
                    A[at[i], ah[m]] += mixed[i, m]
                    A[ah[m], at[i]] += mixed[i, m]
            for i in range(POSE):
                right = 0.0
                for k in range(POSE):
                    right -= Ad[t, k, i] * v[k]
                g[ah[i]] += right
                for m in range(own):
                    total = 0.0
                    for k in range(POSE):
                        total -= Ad[t, k, i] * mixed[k, m]
                    A[ah[i], ah[m]] += total
            g[ah[6]] -= v[6]
            g[ah[7]] -= gain * v[7]
            for m in range(own):
                A[ah[6], ah[m]] -= mixed[6, m]
                A[ah[7], ah[m]] -= gain * mixed[7, m]
            H[:] = 0.0
            v[:] = 0.0


@njit(cache=True, nogil=True)
def compose(A, B, out):  # type: ignore[no-untyped-def]
    """Write the product of two (4, 4) matrices; BLAS takes longer to call than this takes."""
    for i in range(4):
        for j in range(4):
            out[i, j] = (
                A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j] + A[i, 3] * B[3, j]
            )
