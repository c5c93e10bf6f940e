"""Inverses of normal equations: right, symmetric, positive, or none at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.odometry.information import inverse_information


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_inverse_in_any_units(seed, n):
    """Metres beside radians: factors of up to 10^4 between parameters do not matter."""
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n + 3, n))
    units = 10.0 ** rng.uniform(-4, 4, n)
    A = B.T @ B * np.outer(units, units)
    C = inverse_information(A)
    expected = np.linalg.inv(B.T @ B) / np.outer(units, units)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(C / scale, expected / scale, atol=1e-6)
    assert np.array_equal(C, C.T)
    assert np.linalg.eigvalsh(C / scale).min() > 0


@pytest.mark.parametrize("units", [1.0, 1e6])
def test_an_open_direction_is_no_information(rng, units):
    """Rank 5 up to rounding, where numpy's inverse gives variances below zero."""
    B = rng.normal(size=(40, 6)) * [units, 1, 1, 1, 1, 1]
    B[:, 5] = B[:, 4] - B[:, 3]
    assert inverse_information(B.T @ B) is None


@pytest.mark.parametrize(
    "A",
    [np.zeros((2, 2)), np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.diag([1.0, np.nan]),
     np.diag([1.0, np.inf]), np.array([[1.0, 2.0], [2.0, 1.0]])],
    ids=["zero", "blank", "negative", "nan", "inf", "indefinite"],
)  # fmt: skip
def test_what_is_no_information_matrix(A):
    assert inverse_information(A) is None
