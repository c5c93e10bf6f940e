"""Pose and brightness of one frame against the patches of the keyframes, coarse to fine."""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.core.kernels import retract, solve_positive
from thermal_stereo_vo.odometry.direct.patch_sums import (
    AA,
    AB,
    AR,
    BB,
    BR,
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
    view_patch,
)
from thermal_stereo_vo.odometry.direct.photometric import PIXELS

POSE = 6
MIN_DAMPING, MAX_DAMPING = 1e-6, 1e5


@njit(cache=True, nogil=True)
def linearise_frame(  # type: ignore[no-untyped-def]
    T_rig_world, brightness, images, use, cameras, T_camera_rig, scale,
    T_host_world, host_brightness, T_rig_host, hosts, host_cameras, bearings, rhos, rho_information,
    steps, patches, trusts, bands, bolometers, looseness, huber, gate, free_depth, A, g, energies
):  # fmt: skip
    """Normal equations of pose and brightness of one frame at one pyramid level.

    ``images`` one (1, H, W, 3) per camera, ``use`` (C,) which of them count; ``T_host_world``
    (slots, 4, 4), ``host_brightness`` (slots, C, 2), ``T_rig_host`` (slots, C, 4, 4) rig from
    camera; points sorted by host; ``looseness`` (C,) that of ``gather_patch``.  With ``bands`` a
    point is only looked for with the camera that hosts it; in the images of ``bolometers`` (C,)
    residuals count as they weigh.  With ``free_depth`` inverse depths move too, held by
    ``rho_information`` (N,), and are eliminated.  A patch with a mean squared residual above
    ``gate`` squared costs that much and pulls no more.
    Writes A, g and ``energies`` (C, N); returns the mean cost of what is seen (infinite where
    nothing is) and how much that is.
    """
    C = len(use)
    size = POSE + 2 * C
    view, r, weights = np.empty((3, PIXELS)), np.empty(PIXELS), np.empty(PIXELS)
    sums, G, tx, ty = np.empty(SUMS), np.zeros((2, SLOPES)), np.empty(POSE), np.empty(POSE)
    w = np.empty(size)
    patch, trusts_here = np.empty(PIXELS), np.empty(PIXELS)
    arms = np.zeros((C, 2, 3))  # the scale is not asked for here
    T, T_world_host = np.empty((1, 4, 4)), np.empty((4, 4))
    T_camera_host, gains = np.empty((C, 4, 4)), np.empty(C)
    A[:] = 0.0
    g[:] = 0.0
    total, seen = 0.0, 0
    last_host, last_camera = -1, -1
    limit = gate * gate
    for n in range(len(hosts)):
        h, hc = hosts[n], host_cameras[n]
        if h != last_host or hc != last_camera:
            last_host, last_camera = h, hc
            invert(T_host_world[h], T_world_host)
            T[0] = T_rig_world @ T_world_host @ T_rig_host[h, hc]
            for c in range(C):
                T_camera_host[c] = T_camera_rig[c] @ T[0]
                gains[c] = np.exp(brightness[c, 0] - host_brightness[h, hc, 0])
        b_host = host_brightness[h, hc, 1]
        h_rho, b_rho = rho_information[n], 0.0
        for i in range(size):
            w[i] = 0.0
        touched = False
        for c in range(C):
            energies[c, n] = np.nan
            if not use[c] or (bands and c != hc):
                continue
            camera = (
                cameras[c, 0] * scale, cameras[c, 1] * scale, cameras[c, 2] * scale,
                cameras[c, 3] * scale,
            )  # fmt: skip
            if not view_patch(
                images[c], 0, camera, T_camera_host, c, bearings[n, 0], bearings[n, 1], rhos[n],
                steps[hc, 0], steps[hc, 1], view,
            ):  # fmt: skip
                continue
            trust = 0.0
            for k in range(PIXELS):
                patch[k], trusts_here[k] = patches[n, k], trusts[n, k]
                trust += trusts[n, k]
            if not trust > 0.0:
                continue
            if bolometers[c]:
                trust = PIXELS
            gain = gains[c]
            energy = compare_patch(
                view, patch, trusts_here, gain, b_host, brightness[c, 1], huber, r, weights
            )
            energies[c, n] = energy / trust
            seen += 1
            if energy > limit * trust:
                total += limit * trust
                continue
            total += energy
            touched = True
            total -= gather_patch(view, patch, gain, b_host, looseness[c], r, weights, sums)
            middle_slopes(T, 0, T_camera_rig, c, arms, bearings[n, 0], bearings[n, 1], rhos[n], G)
            x_rho, y_rho = G[0, BY_RHO], G[1, BY_RHO]
            tx_rho = sums[XX] * x_rho + sums[XY] * y_rho
            ty_rho = sums[XY] * x_rho + sums[YY] * y_rho
            h_rho += x_rho * tx_rho + y_rho * ty_rho
            b_rho -= x_rho * sums[XR] + y_rho * sums[YR]
            a = POSE + 2 * c
            for i in range(POSE):
                x, y = G[0, i], G[1, i]
                tx[i] = sums[XX] * x + sums[XY] * y
                ty[i] = sums[XY] * x + sums[YY] * y
                g[i] -= x * sums[XR] + y * sums[YR]
                w[i] += x * tx_rho + y * ty_rho
                A[i, a] += x * sums[XA] + y * sums[YA]
                A[i, a + 1] += x * sums[XB] + y * sums[YB]
                for m in range(i + 1):
                    A[m, i] += G[0, m] * tx[i] + G[1, m] * ty[i]
            g[a] -= sums[AR]
            g[a + 1] -= sums[BR]
            w[a] += x_rho * sums[XA] + y_rho * sums[YA]
            w[a + 1] += x_rho * sums[XB] + y_rho * sums[YB]
            A[a, a] += sums[AA]
            A[a, a + 1] += sums[AB]
            A[a + 1, a + 1] += sums[BB]
        if free_depth and touched and h_rho > 0.0:
            for i in range(size):
                factor = w[i] / h_rho
                g[i] -= factor * b_rho
                for m in range(i, size):
                    A[i, m] -= factor * w[m]
    for i in range(size):
        for m in range(i):
            A[i, m] = A[m, i]
    if seen == 0:
        return np.inf, 0
    return total / seen, seen


@njit(cache=True, nogil=True)
def invert(T, out):  # type: ignore[no-untyped-def]
    """Write the inverse of a rigid motion (4, 4)."""
    for i in range(3):
        out[i, 3] = 0.0
        for j in range(3):
            out[i, j] = T[j, i]
            out[i, 3] -= T[j, i] * T[j, 3]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@njit(cache=True, nogil=True)
def align_frame(  # type: ignore[no-untyped-def]
    T_rig_world, brightness, images, use, cameras, T_camera_rig, scale,
    T_host_world, host_brightness, T_rig_host, hosts, host_cameras, bearings, rhos, rho_information,
    steps, patches, trusts, bands, bolometers, looseness, huber, gate, free_depth, iterations, A,
    g, energies
):  # fmt: skip
    """Levenberg-Marquardt at one level, in place; returns the cost, what was seen, iterations."""
    C = len(use)
    size = POSE + 2 * C
    T_new, brightness_new = T_rig_world.copy(), brightness.copy()
    A_new, g_new, damped = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    energies_new, step = energies.copy(), np.zeros(size)
    damping = 1e-4
    cost, seen = linearise_frame(
        T_rig_world, brightness, images, use, cameras, T_camera_rig, scale, T_host_world,
        host_brightness, T_rig_host, hosts, host_cameras, bearings, rhos, rho_information, steps,
        patches, trusts, bands, bolometers, looseness, huber, gate, free_depth, A, g, energies,
    )  # fmt: skip
    done = 0
    for iteration in range(iterations):
        if not np.isfinite(cost):
            break
        done = iteration + 1
        damped[:] = A
        for i in range(size):
            damped[i, i] += damping * A[i, i] + 1e-6
        if not solve_positive(damped, g, step):
            break
        retract(T_rig_world, step[:POSE], T_new)
        for c in range(C):
            for i in range(2):
                brightness_new[c, i] = brightness[c, i] + step[POSE + 2 * c + i]
        new_cost, new_seen = linearise_frame(
            T_new, brightness_new, images, use, cameras, T_camera_rig, scale, T_host_world,
            host_brightness, T_rig_host, hosts, host_cameras, bearings, rhos, rho_information,
            steps, patches, trusts, bands, bolometers, looseness, huber, gate, free_depth, A_new,
            g_new, energies_new,
        )  # fmt: skip
        # A step that only shows fewer patches is no better.
        if new_cost < cost and 2 * new_seen > seen:
            small = cost - new_cost < 1e-4 * cost
            T_rig_world[:] = T_new
            brightness[:] = brightness_new
            A[:] = A_new
            g[:] = g_new
            energies[:] = energies_new
            cost, seen = new_cost, new_seen
            damping = max(0.2 * damping, MIN_DAMPING)
            if small:
                break
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > MAX_DAMPING:
                break
    return cost, seen, done
