"""Compiled linear algebra against its plain form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from thermal_stereo_vo.core.kernels import invert_positive, retract, solve_positive
from thermal_stereo_vo.core.transforms import exp_se3

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.floats(-12.0, 0.45))
@example(seed=1, exponent=-5.0)
@example(seed=2, exponent=-5.0001)
@example(seed=3, exponent=-4.9999)
def test_retract_is_exp_times_pose(seed, exponent):
    rng = np.random.default_rng(seed)
    T = exp_se3(rng.normal(0, 2, 6))
    direction = rng.normal(size=3)
    phi = direction / np.linalg.norm(direction) * 10.0**exponent
    delta = np.concatenate([rng.normal(0, 3, 3), phi])
    out = np.full((4, 4), np.nan)
    retract(T, delta, out)
    np.testing.assert_allclose(out, exp_se3(delta) @ T, atol=1e-10)


def test_retract_by_nothing_changes_nothing(rng):
    T = exp_se3(rng.normal(size=6))
    out = np.empty((4, 4))
    retract(T, np.zeros(6), out)
    assert np.array_equal(out, T)


@given(seeds, st.integers(1, 12))
def test_solve_positive_is_solve(seed, n):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n, n))
    A = B @ B.T + 0.1 * np.eye(n)
    A = 0.5 * (A + A.T)
    b, x = rng.normal(size=n), np.full(n, np.nan)
    before = A.copy(), b.copy()
    assert solve_positive(A, b, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8, atol=1e-8)
    assert np.array_equal(A, before[0])
    assert np.array_equal(b, before[1])


@pytest.mark.parametrize(
    "A",
    [
        np.zeros((6, 6)),
        np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-12]),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.array([[1.0, np.nan], [np.nan, 1.0]]),
        np.array([[np.nan, 0.0], [0.0, 1.0]]),
    ],
    ids=["zero", "rank 5", "negative", "indefinite", "nan beside", "nan on diagonal"],
)
def test_solve_positive_refuses_what_is_not_positive(A):
    assert not solve_positive(A, np.ones(len(A)), np.zeros(len(A)))


@given(seeds, st.integers(1, 42))
def test_invert_positive_is_inv(seed, n):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(n, n))
    A = B @ B.T + 0.1 * np.eye(n)
    before, out = A.copy(), np.full((n, n), np.nan)
    assert invert_positive(A, 0.0, out)
    np.testing.assert_allclose(out, np.linalg.inv(A), rtol=1e-7, atol=1e-8)
    assert np.array_equal(out, out.T)
    assert np.array_equal(A, before)


@pytest.mark.parametrize(("least_pivot", "inverted"), [(0.1, True), (0.2, False)])
def test_invert_positive_refuses_small_pivots(least_pivot, inverted):
    """The second parameter is explained by the first but for 0.19 = 1 - 0.9^2."""
    A = np.array([[1.0, 0.9], [0.9, 1.0]])
    assert invert_positive(A, least_pivot, np.empty((2, 2))) is inverted


@pytest.mark.parametrize("A", [np.zeros((2, 2)), np.array([[np.nan, 0.0], [0.0, 1.0]])])
def test_invert_positive_refuses_what_is_not_positive(A):
    assert not invert_positive(A, 0.0, np.empty((2, 2)))
