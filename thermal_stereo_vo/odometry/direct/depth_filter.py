"""Inverse depths of points whose frames have been aligned: searched along the epipolar line."""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.direct.frame_alignment import invert
from thermal_stereo_vo.odometry.direct.photometric import (
    COLUMNS,
    PIXELS,
    RHO,
    huber_weight,
    linearise_patch,
    patch_energy,
)

MOST_STEPS = 80
RHO_MIN = 1e-5


@njit(cache=True, nogil=True)
def filter_depths(  # type: ignore[no-untyped-def]
    T_rig_world, brightness, images, use, cameras, T_camera_rig, T_host_world, host_brightness,
    T_rig_host, hosts, host_cameras, bearings, steps, patches, trusts, bolometers, huber, gate,
    sigma, information_gain, rhos, rho_information
):  # fmt: skip
    """Refine ``rhos`` (N,) and their information in place by one aligned frame.

    Each point is looked for with the camera that hosts it, within two standard deviations
    (``sigma`` is the noise of a pixel): in steps of a pixel where that is far, then by Gauss-Newton
    with what is known as the prior.  Neighbouring frames share errors, so that only the share
    ``information_gain`` of what a frame says is believed.  In images of ``bolometers`` (C,)
    residuals count as they weigh.  Returns how many were refined.
    """
    r, J = np.empty(PIXELS), np.empty((PIXELS, COLUMNS))
    T, T_world_host, arms = np.empty((4, 4)), np.empty((4, 4)), np.zeros((2, 3))
    last_host, last_camera, refined = -1, -1, 0
    for n in range(len(hosts)):
        h, c = hosts[n], host_cameras[n]
        if not use[c]:
            continue
        if h != last_host or c != last_camera:
            last_host, last_camera = h, c
            invert(T_host_world[h], T_world_host)
            T[:] = T_rig_world @ T_world_host @ T_rig_host[h, c]
        trust = 0.0
        for k in range(PIXELS):
            trust += trusts[n, k]
        if not trust > 0.0:
            continue
        if bolometers[c]:
            trust = PIXELS
        gain = np.exp(brightness[c, 0] - host_brightness[h, c, 0])
        b_host, b_target = host_brightness[h, c, 1], brightness[c, 1]
        prior, known = rhos[n], rho_information[n]
        spread = 2.0 * sigma / np.sqrt(max(known, 1e-12))
        low, high = max(prior - spread, RHO_MIN), prior + spread
        rho = prior
        C = T_camera_rig[c]
        length = epipolar_px(T, C, cameras[c], bearings[n], low, high)
        if length > 2.0:
            count = min(int(np.ceil(length)), MOST_STEPS)
            best, rival, at = np.inf, np.inf, -1
            for i in range(count + 1):
                tried = low + (high - low) * i / count
                if not linearise_patch(
                    images[c], cameras[c], 1.0, T, C, arms, bearings[n], tried, steps[c],
                    patches[n], gain, b_host, b_target, r, J,
                ):  # fmt: skip
                    continue
                energy = patch_energy(r, trusts[n], huber)
                if energy < best:
                    if i - at > 3:
                        rival = best
                    best, at, rho = energy, i, tried
                elif i - at > 3:
                    rival = min(rival, energy)
            if at < 0 or best > gate * gate * trust or rival < 1.3 * best:
                continue
        good = False
        h_data = 0.0
        for _ in range(5):
            if not linearise_patch(
                images[c], cameras[c], 1.0, T, C, arms, bearings[n], rho, steps[c], patches[n],
                gain, b_host, b_target, r, J,
            ):  # fmt: skip
                good = False
                break
            good = patch_energy(r, trusts[n], huber) < gate * gate * trust
            h_data, b_data = 0.0, 0.0
            for k in range(PIXELS):
                weight = trusts[n, k] * huber_weight(r[k], huber)
                h_data += weight * J[k, RHO] * J[k, RHO]
                b_data -= weight * J[k, RHO] * r[k]
            h_data *= information_gain
            move = (information_gain * b_data + known * (prior - rho)) / (h_data + known + 1e-12)
            move = min(max(move, -0.5 * spread), 0.5 * spread)
            rho = max(rho + move, RHO_MIN)
            if abs(move) < 1e-3 * rho:
                break
        if good and low - spread <= rho <= high + spread:
            rhos[n] = rho
            rho_information[n] = known + h_data
            refined += 1
    return refined


@njit(cache=True, nogil=True)
def epipolar_px(T, C, camera, bearing, low, high):  # type: ignore[no-untyped-def]
    """Length (px) of the epipolar line between two inverse depths; 0 where it leaves the front."""
    ends = np.empty((2, 2))
    for e in range(2):
        rho = low if e == 0 else high
        p = T[:3, 0] * bearing[0] + T[:3, 1] * bearing[1] + T[:3, 2] + rho * T[:3, 3]
        q0 = C[0, 0] * p[0] + C[0, 1] * p[1] + C[0, 2] * p[2] + rho * C[0, 3]
        q1 = C[1, 0] * p[0] + C[1, 1] * p[1] + C[1, 2] * p[2] + rho * C[1, 3]
        q2 = C[2, 0] * p[0] + C[2, 1] * p[1] + C[2, 2] * p[2] + rho * C[2, 3]
        if q2 < 1e-3:
            return 0.0
        ends[e, 0], ends[e, 1] = camera[0] * q0 / q2, camera[1] * q1 / q2
    return np.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])
