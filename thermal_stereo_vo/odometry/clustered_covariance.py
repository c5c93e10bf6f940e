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

LEAST_POINTS = 2
"""Times as many points as unknowns of the poses, or their scatter says nothing."""
LEAST_STEEPNESS = 0.3
"""Where the kernel flattens nearly everything, there is no minimum to speak of."""


def clustered_covariance(
    information: NDArray[np.float64],
    unit_covariance: NDArray[np.float64],
    pulls: NDArray[np.float64],
    steepness: float,
    sigma_floor: float,
    behind: NDArray[np.float64] | None = None,
) -> NDArray[np.float64] | None:
    """(F, F) covariance of the unknowns by the scatter of the (N, F) ``pulls`` of the points.

    ``information`` (F, F) are the reduced normal equations, ``unit_covariance`` their inverse,
    ``steepness`` by how much less than their weights say residuals pull as they grow; ``behind``
    (F, F) the sum of squares of the pulls of points that have gone, where the equations still
    count them.  None when too few points pull to tell, or less than noise of ``sigma_floor`` would
    make them.
    """
    scattered = np.zeros_like(unit_covariance)
    pulling, free = scatter_steps(unit_covariance, pulls, scattered), len(unit_covariance)
    if pulling < LEAST_POINTS * free or not steepness > LEAST_STEEPNESS:
        return None
    if behind is not None:
        scattered += unit_covariance @ behind @ unit_covariance
    # What the points have determined themselves they do not show.
    scattered *= pulling / (pulling - free) / steepness**2
    # Of many directions a few points always hardly tell one: as many more of them as there are
    # unknowns are taken to be as the equations say, at the noise that the scatter shows.
    noise = float(np.sum(information * scattered)) / free
    if noise < sigma_floor**2:
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
