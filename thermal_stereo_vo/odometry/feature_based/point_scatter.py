"""How far the points of a window disagree: covariances without a guess of the noise.

Errors of one point in successive keyframes and in both eyes hang together (one patch, one bit of
fixed pattern), points differ in how good they are, and a fit leaves residuals smaller than the
noise.  The inverse of the normal equations knows none of this.  Points among each other are
independent, so that the scatter of what each of them pulls tells the covariance: the sandwich
estimate with clusters (Liang & Zeger, Longitudinal data analysis using generalized linear models,
Biometrika 73, 1986), here with the points as clusters.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.feature_based.inverse_depth import (
    COMPONENTS,
    cauchy_weight,
    counts,
    point_in_camera,
    pose_rows,
    relative_transform,
    residual_row,
)

LEAST_POINTS = 2
"""Times as many points as unknowns of the poses, or their scatter says nothing."""
LEAST_STEEPNESS = 0.3
"""Where the kernel flattens nearly everything, there is no minimum to speak of."""


def clustered_covariance(
    information: NDArray[np.float64],
    unit_covariance: NDArray[np.float64],
    pulls: NDArray[np.float64],
    steepness: float,
    sigma_floor_px: float,
) -> NDArray[np.float64] | None:
    """(F, F) covariance of the poses by the scatter of the (N, F) ``pulls`` of the points.

    ``information`` (F, F) are the reduced normal equations, ``unit_covariance`` their inverse,
    ``steepness`` as ``point_pulls`` returns it.  None when too few points pull to tell, or less
    than noise of ``sigma_floor_px`` would make them.
    """
    scattered = np.zeros_like(unit_covariance)
    pulling, free = scatter_steps(unit_covariance, pulls, scattered), len(unit_covariance)
    if pulling < LEAST_POINTS * free or not steepness > LEAST_STEEPNESS:
        return None
    # What the points have determined themselves they do not show.
    scattered *= pulling / (pulling - free) / steepness**2
    # Of many directions a few points always hardly tell one: as many more of them as there are
    # unknowns are taken to be as the equations say, at the noise that the scatter shows.
    noise = float(np.sum(information * scattered)) / free
    if noise < sigma_floor_px**2:
        return None
    share = free / (free + pulling)
    covariance: NDArray[np.float64] = (1.0 - share) * scattered + share * noise * unit_covariance
    return 0.5 * (covariance + covariance.T)


@njit(cache=True, nogil=True)
def scatter_steps(unit_covariance, pulls, scattered):  # type: ignore[no-untyped-def]
    """Write the sum over the points of s s^T, s = ``unit_covariance`` pull; returns how many pull.

    A kernel, since matrix products of a library may differ in the last bit with its threads.
    """
    free = len(unit_covariance)
    step = np.empty(free)
    pulling = 0
    scattered[:] = 0.0
    for n in range(len(pulls)):
        pull = pulls[n]
        if not np.any(pull != 0.0):
            continue
        pulling += 1
        for i in range(free):
            total = 0.0
            for m in range(free):
                total += unit_covariance[i, m] * pull[m]
            step[i] = total
        for i in range(free):
            for m in range(free):
                scattered[i, m] += step[i] * step[m]
    return pulling


@njit(cache=True, nogil=True)
def point_pulls(  # type: ignore[no-untyped-def]
    T, rhos, hosts, bearings, observed, weights, eyes, width, pulls
):
    """Write the (N, 6F) gradients of the poses by each point alone, its depth eliminated.

    Their sum is the ``g`` of ``linearise_bundle``.  Returns by how much less than the weights say
    the kernel gives way: the mean slope of its influence over its mean weight (Huber, Robust
    Statistics, 1981, sec. 7.6); 1 without outliers and with a wide kernel.
    """
    baseline = eyes[5]
    R, t, p = np.empty((3, 3)), np.empty(3), np.empty(3)
    row, q = np.empty(3), np.empty(3)
    Jc, Jh = np.empty(6), np.empty(6)
    free = pulls.shape[1]
    w = np.empty(free)
    slopes = total = 0.0
    for n in range(len(hosts)):
        h, rho, b = hosts[n], rhos[n], bearings[n]
        g = pulls[n]
        g[:] = 0.0
        w[:] = 0.0
        h_rho = b_rho = 0.0
        for c in range(len(T)):
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
                trust = cauchy_weight(r, width)
                weight = weights[c, n] * trust
                total += weight
                slopes += weight * (2.0 * trust - 1.0)
                j_rho = row[0] * t[0] + row[1] * t[1] + row[2] * t[2]
                if k >= 2:
                    j_rho -= row[0] * baseline
                h_rho += weight * j_rho * j_rho
                b_rho += weight * j_rho * r
                if c == h:
                    continue
                pose_rows(row, R, p, b, rho, Jc, Jh)
                for i in range(6):
                    if c > 0:
                        g[6 * (c - 1) + i] += weight * Jc[i] * r
                        w[6 * (c - 1) + i] += weight * Jc[i] * j_rho
                    if h > 0:
                        g[6 * (h - 1) + i] += weight * Jh[i] * r
                        w[6 * (h - 1) + i] += weight * Jh[i] * j_rho
        if h_rho > 0.0:
            for i in range(free):
                g[i] -= w[i] / h_rho * b_rho
    return slopes / total if total > 0.0 else 0.0
