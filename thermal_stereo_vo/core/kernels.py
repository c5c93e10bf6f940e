"""Small compiled pieces of linear algebra that the hot loops share.

Each has its plain form in ``transforms`` or numpy, and a test that holds it to it.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def retract(T, delta, out):  # type: ignore[no-untyped-def]
    """Write ``Exp(delta) T`` to ``out``; ``delta`` (6,) = (rho, phi), matrices (4, 4).

    The plain form is ``transforms.exp_se3(delta) @ T``.
    """
    x, y, z = delta[3], delta[4], delta[5]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-10:
        s, c, d = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = np.sqrt(angle2)
        s = np.sin(angle) / angle
        c = (1.0 - np.cos(angle)) / angle2
        d = (angle - np.sin(angle)) / (angle2 * angle)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    K2 = np.array(
        [
            [-(y * y + z * z), x * y, x * z],
            [x * y, -(x * x + z * z), y * z],
            [x * z, y * z, -(x * x + y * y)],
        ]
    )
    E = np.zeros((4, 4))
    for i in range(3):
        E[i, i] = 1.0
        for j in range(3):
            E[i, j] += s * K[i, j] + c * K2[i, j]
            left = c * K[i, j] + d * K2[i, j]
            if i == j:
                left += 1.0
            E[i, 3] += left * delta[j]
    for i in range(3):
        for j in range(4):
            total = 0.0
            for k in range(3):
                total += E[i, k] * T[k, j]
            out[i, j] = total
        out[i, 3] += E[i, 3]
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@njit(cache=True, nogil=True)
def solve_positive(A, b, x):  # type: ignore[no-untyped-def]
    """Solve ``A x = b`` for a symmetric positive definite (n, n) matrix by Cholesky.

    Returns False, leaving ``x`` undefined, when A is not positive definite.
    """
    n = len(b)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]
    return True


@njit(cache=True, nogil=True)
def invert_positive(A, least_pivot, out):  # type: ignore[no-untyped-def]
    """Write the inverse of a symmetric (n, n) matrix to ``out`` by Cholesky, exactly symmetric.

    Returns False, leaving ``out`` undefined, when a pivot does not exceed ``least_pivot``; with a
    unit diagonal a pivot is the share of a parameter that those before it do not explain.  LAPACK
    would do, but its threads spin for longer than a matrix of this size takes.
    """
    n = len(A)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > least_pivot:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    inverse_L = np.zeros((n, n))
    for j in range(n):
        inverse_L[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= L[i, k] * inverse_L[k, j]
            inverse_L[i, j] = total / L[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += inverse_L[k, i] * inverse_L[k, j]
            out[i, j] = out[j, i] = total
    return True
