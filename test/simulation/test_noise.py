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
from thermal_stereo_vo.simulation.shading import texture
from thermal_stereo_vo.simulation.thermal_field import Column, thermal_table
from thermal_stereo_vo.simulation.weather import find_weather


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


@pytest.fixture
def row() -> np.ndarray:
    """A material with nothing but octaves: 1 K, from 1 m to 1/64 m."""
    row = np.zeros(len(Column))
    row[Column.SPACING], row[Column.OCTAVES], row[Column.PERSISTENCE] = 1.0, 7, 0.8
    row[Column.AMPLITUDE] = 1.0 / np.sqrt(np.sum(0.8 ** (2 * np.arange(7))))
    return row


def along_a_line(lattice, row, pixel_m, count=40_000, spread_m=50.0) -> np.ndarray:
    rng = np.random.default_rng(8)
    points = rng.uniform(0, spread_m, (count, 2))
    return np.array([texture(lattice, row, a, b, 1.0, 0.0, pixel_m, pixel_m) for a, b in points])


def test_a_fine_pixel_sees_the_whole_amplitude(lattice, row) -> None:
    assert 0.95 < along_a_line(lattice, row, 1e-3).std() < 1.05


def test_octaves_finer_than_the_pixel_fade_away(lattice, row) -> None:
    """Neighbouring pixels must differ little: otherwise the texture would alias."""
    coarse = along_a_line(lattice, row, 0.4, 20_000).std()
    assert 0.3 < coarse < 0.75
    assert along_a_line(lattice, row, 1.0, 2_000).std() == 0.0


def test_a_stretched_pixel_averages_along_its_stretch(lattice, row) -> None:
    """Detail across the stretch survives where an isotropic filter would lose it."""
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 50, (20_000, 2))

    def spread(across_m: float, along_m: float) -> float:
        return float(
            np.std([texture(lattice, row, a, b, 1.0, 0.0, across_m, along_m) for a, b in points])
        )

    fine, stretched, blurred = spread(0.05, 0.05), spread(0.05, 0.4), spread(0.4, 0.4)
    assert blurred < stretched < fine


def test_weather_scales_the_texture_of_passive_materials_only() -> None:
    from thermal_stereo_vo.simulation.materials import Material

    day, night = (thermal_table(find_weather(n)) for n in ("cloudy_day", "clear_cold_night"))
    ratio = find_weather("clear_cold_night").contrast / find_weather("cloudy_day").contrast
    found = night[Material.GRASS, Column.AMPLITUDE] / day[Material.GRASS, Column.AMPLITUDE]
    assert found == pytest.approx(ratio, rel=1e-9)
    assert night[Material.SKIN, Column.AMPLITUDE] == day[Material.SKIN, Column.AMPLITUDE]
