"""Covariances from the normal equations of a solved problem."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.kernels import invert_positive

_LEAST_PIVOT = 1e-12
"""Of the information with unit diagonal: below this it is rounding, not information."""


def inverse_information(A: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Inverse of a symmetric (N, N) information matrix: symmetric and positive definite.

    None when it leaves a direction open, whatever the units of the parameters are.

    >>> inverse_information(np.diag([4.0, 1e8])).diagonal()
    array([2.5e-01, 1.0e-08])
    >>> inverse_information(np.ones((2, 2))) is None
    True
    """
    diagonal = np.diag(A)
    if not np.all(np.isfinite(A)) or not np.all(diagonal > 0.0):
        return None
    scale = np.sqrt(np.outer(diagonal, diagonal))
    inverse = np.empty_like(scale)
    if not invert_positive(A / scale, _LEAST_PIVOT, inverse):
        return None
    return inverse / scale


def positive(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest symmetric (N, N) matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
