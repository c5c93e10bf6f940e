from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.simulation.noise import (
    LATTICE,
    NOISE_SIGMA,
    NOISE_SLOPE,
    random_lattice,
    value_noise,
    value_noise_reference,
)


@given(st.floats(-500, 500), st.floats(-500, 500))
@settings(max_examples=100, deadline=None)
def test_the_kernel_agrees_with_plain_numpy(a: float, b: float) -> None:
    lattice = random_lattice(np.random.default_rng(3))
    expected = value_noise_reference(lattice, np.array([[a, b]]))[0]
    assert value_noise(lattice, a, b) == pytest.approx(expected, abs=1e-6)


def test_noise_meets_the_lattice_and_repeats_only_after_it(lattice) -> None:
    assert value_noise(lattice, 17.0, 4.0) == pytest.approx(lattice[4 * LATTICE + 17], abs=1e-7)
    assert value_noise(lattice, 17.3, 4.6) == pytest.approx(
        value_noise(lattice, 17.3 + LATTICE, 4.6 - LATTICE), abs=1e-9
    )


def test_constants_of_the_noise_are_those_of_the_noise(lattice, rng) -> None:
    points = rng.uniform(0, 200, (200_000, 2))
    values = value_noise_reference(lattice, points)
    assert 0.97 * NOISE_SIGMA < values.std() < 1.03 * NOISE_SIGMA
    step = 1e-4
    slope = np.hypot(
        *(
            (value_noise_reference(lattice, points + step * way) - values) / step
            for way in np.eye(2)
        )
    )
    mean = slope[np.abs(values) < 0.02].mean()
    assert 0.95 * NOISE_SLOPE < mean < 1.05 * NOISE_SLOPE
