"""Whether a covariance tells the truth: the normalised estimation error squared.

Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), sec.
5.4: of a consistent estimator the NEES is chi-squared with as many degrees of freedom as the state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import log_so3

Array = NDArray[np.float64]


def pose_errors(T_world_true: Array, T_world_est: Array) -> Array:
    """(N, 6) errors of (N, 4, 4) poses, translation (m), then rotation (rad), in world axes.

    ``p_true = p + e[:3]`` and ``R_true = Exp(e[3:]) R``, as ``core`` defines the covariance.
    """
    errors = np.empty((len(T_world_est), 6))
    for error, T_true, T_est in zip(errors, T_world_true, T_world_est, strict=True):
        error[:3] = T_true[:3, 3] - T_est[:3, 3]
        error[3:] = log_so3(T_true[:3, :3] @ T_est[:3, :3].T)
    return errors


def nees(T_world_true: Array, T_world_est: Array, covariance: Array) -> Array:
    """(N,) ``e^T P^-1 e`` of (N, 4, 4) poses with (N, 6, 6) covariances.

    Both worlds must be the same (align at the origin first).  NaN where the covariance is not
    positive definite, as at the start pose, which is certain by definition.
    """
    values = np.full(len(covariance), np.nan)
    errors = pose_errors(T_world_true, T_world_est)
    for i, (error, P) in enumerate(zip(errors, covariance, strict=True)):
        try:
            whitened = np.linalg.solve(np.linalg.cholesky(P), error)
        except np.linalg.LinAlgError:
            continue
        values[i] = whitened @ whitened
    return values


def nees_band(n: int, dof: int = 6, confidence: float = 0.95) -> tuple[float, float]:
    """Where the mean of ``n`` independent NEES values of a consistent estimator lies.

    The chi-squared quantiles with n * dof degrees of freedom, over n.

    >>> low, high = nees_band(100, 6, 0.95)
    >>> low < 6.0 < high
    True
    """
    from scipy.stats import chi2

    tail = 0.5 * (1.0 - confidence)
    low = float(chi2.ppf(tail, n * dof)) / n
    high = float(chi2.ppf(1.0 - tail, n * dof)) / n
    return low, high
