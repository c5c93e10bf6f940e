"""What each point of a window pulls at the poses: the clusters of ``clustered_covariance``."""

from __future__ import annotations

import numpy as np
from numba import njit

from thermal_stereo_vo.odometry.feature_based.inverse_depth import (
    COMPONENTS,
    cauchy_weight,
    counts,
    point_in_camera,
    pose_rows,
    relative_transform,
    residual_row,
)


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
