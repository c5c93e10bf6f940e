"""The double dogleg path (Dennis & Mei 1979, section 3) and where a radius cuts it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.odometry.solvers import double_dogleg_step

seeds = st.integers(0, 2**32 - 1)


def model(seed, n=6, spread=3.0):
    """A random quadratic with condition numbers up to 10^(2 * spread)."""
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    A = Q @ np.diag(10.0 ** rng.uniform(-spread, spread, n)) @ Q.T
    A = 0.5 * (A + A.T)
    return A, rng.normal(size=n)


def corners(A, g):
    """Cauchy point, intermediate Newton point, Newton point."""
    gg, gAg = g @ g, g @ A @ g
    newton = np.linalg.solve(A, g)
    eta = 0.2 + 0.8 * gg**2 / (gAg * (g @ newton))
    return gg / gAg * g, eta * newton, newton


def reference_step(A, g, radius):
    """Walk the path of straight lines and stop at the radius, found by bisection."""
    path = [np.zeros_like(g), *corners(A, g)]
    for start, end in pairwise(path):
        if np.linalg.norm(end) >= radius:
            low, high = 0.0, 1.0
            for _ in range(200):
                middle = 0.5 * (low + high)
                inside = np.linalg.norm(start + middle * (end - start)) < radius
                low, high = (middle, high) if inside else (low, middle)
            return start + high * (end - start)
    return path[-1]


def step_of(A, g, radius):
    step = np.full(len(g), np.nan)
    assert double_dogleg_step(A, g, radius, step)
    return step


def gain(A, g, step):
    """L(0) - L(step)."""
    return g @ step - 0.5 * step @ A @ step


@given(seeds, st.floats(-4.0, 4.0))
def test_step_is_where_the_radius_cuts_the_path(seed, exponent):
    A, g = model(seed)
    cauchy, _, newton = corners(A, g)
    radius = 10.0**exponent * np.sqrt(np.linalg.norm(cauchy) * np.linalg.norm(newton))
    step = step_of(A, g, radius)
    np.testing.assert_allclose(step, reference_step(A, g, radius), rtol=1e-5, atol=1e-7 * radius)


@given(seeds, st.floats(0.0, 1.0))
def test_a_restricted_step_ends_on_the_border(seed, fraction):
    A, g = model(seed)
    newton = np.linalg.norm(corners(A, g)[2])
    radius = max(fraction * newton, 1e-9 * newton)
    assert np.linalg.norm(step_of(A, g, radius)) == pytest.approx(radius, rel=1e-7)


@given(seeds)
def test_the_path_goes_outward_and_downhill(seed):
    A, g = model(seed, spread=2.0)
    cauchy, _, newton = corners(A, g)
    radii = np.geomspace(1e-3 * np.linalg.norm(cauchy), 1.2 * np.linalg.norm(newton), 60)
    steps = [step_of(A, g, radius) for radius in radii]
    lengths = [np.linalg.norm(step) for step in steps]
    gains = [gain(A, g, step) for step in steps]
    slack = 1e-9 * gains[-1]
    assert np.all(np.diff(lengths) >= -1e-9 * lengths[-1])
    assert np.all(np.diff(gains) >= -slack)
    assert gains[0] > 0


@given(seeds)
def test_both_ends_of_the_path(seed):
    A, g = model(seed)
    cauchy, _, newton = corners(A, g)
    at_cauchy = step_of(A, g, np.linalg.norm(cauchy))
    np.testing.assert_allclose(at_cauchy, cauchy, rtol=1e-9)
    half = step_of(A, g, 0.5 * np.linalg.norm(cauchy))
    np.testing.assert_allclose(half, 0.5 * cauchy, rtol=1e-9)
    for factor in (1.0 + 1e-9, 10.0):
        at_newton = step_of(A, g, factor * np.linalg.norm(newton))
        np.testing.assert_allclose(at_newton, newton, rtol=1e-6, atol=1e-9 * np.abs(newton).max())
    assert gain(A, g, newton) == pytest.approx(0.5 * g @ newton, rel=1e-5)


@given(seeds)
def test_the_last_leg_is_the_newton_direction(seed):
    """Between eta * Newton and Newton the step is the shortened Newton step itself."""
    A, g = model(seed)
    _, intermediate, newton = corners(A, g)
    radius = 0.5 * (np.linalg.norm(intermediate) + np.linalg.norm(newton))
    step = step_of(A, g, radius)
    np.testing.assert_allclose(
        step, radius / np.linalg.norm(newton) * newton, rtol=1e-4, atol=1e-6 * radius
    )


def test_the_bias_towards_newton_is_real():
    """A single dogleg would run from the Cauchy point to the Newton point: this one does not."""
    A, g = np.diag([1.0, 100.0]), np.array([1.0, 10.0])
    cauchy, intermediate, newton = corners(A, g)
    radius = 0.5 * (np.linalg.norm(cauchy) + np.linalg.norm(intermediate))
    step = step_of(A, g, radius)
    v = newton - cauchy
    along = (step - cauchy) @ v / (v @ v)
    assert np.linalg.norm(step - cauchy - along * v) > 0.01 * radius
    assert 0.2 < np.linalg.norm(intermediate) / np.linalg.norm(newton) < 0.9


def test_a_valley_without_a_floor_is_followed_down_the_gradient():
    """A singular model has no Newton point: the Cauchy point, cut by the radius, is left."""
    A, g = np.diag([1.0, 0.0]), np.array([1.0, 1.0])
    cauchy = g @ g / (g @ A @ g) * g
    np.testing.assert_allclose(step_of(A, g, 100.0), cauchy)
    short = step_of(A, g, 0.1)
    np.testing.assert_allclose(short, 0.1 * g / np.linalg.norm(g))


@pytest.mark.parametrize(
    ("A", "g"),
    [
        (np.eye(2), np.zeros(2)),
        (np.zeros((2, 2)), np.ones(2)),
        (-np.eye(2), np.ones(2)),
        (np.full((2, 2), np.nan), np.ones(2)),
    ],
    ids=["no gradient", "flat", "upside down", "nan"],
)
def test_no_descent_no_step(A, g):
    assert not double_dogleg_step(A, g, 1.0, np.zeros(2))
