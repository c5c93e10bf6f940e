from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.noise import (
    LATTICE,
    NOISE_SIGMA,
    NOISE_SLOPE,
    value_noise_reference,
)
from thermal_stereo_vo.simulation.texture import empty_patches, vary
from thermal_stereo_vo.simulation.thermal_field import Column, thermal_table
from thermal_stereo_vo.simulation.weather import find_weather

LINE_M = 0.015
CRACKS_AT, PATCHES_AT = np.array([7.7, 40.9]), np.array([29.3, 11.9])
OCTAVE_AT = np.array([17.31, 5.77])
OCTAVE = 2.0 * np.array([[0.6, -0.8], [0.8, 0.6]])


@pytest.fixture
def row() -> np.ndarray:
    """A material with nothing but octaves: 1 K, from 1 m to 1/64 m."""
    row = np.zeros(len(Column))
    row[Column.SPACING], row[Column.OCTAVES], row[Column.PERSISTENCE] = 1.0, 7, 0.8
    row[Column.AMPLITUDE] = 1.0 / np.sqrt(np.sum(0.8 ** (2 * np.arange(7))))
    return row


def varied(lattice, row, points, across_m, along_m, way=(1.0, 0.0)) -> np.ndarray:
    """The kernel at (N, 2) points of one material."""
    patches = empty_patches(len(points))
    patches.material[:] = 0
    patches.a[:], patches.b[:] = points.T
    patches.way_a[:], patches.way_b[:] = way
    patches.across_m[:], patches.along_m[:] = across_m, along_m
    out = np.empty(len(points))
    vary(lattice, row[None], patches, len(points), out)
    return out


def reference(lattice, row, points, across_m, along_m, way) -> np.ndarray:
    """The same in plain numpy, part by part."""
    spacing, p = row[Column.SPACING], points / row[Column.SPACING]
    line_m = max(LINE_M, across_m)

    def noise(at):
        return value_noise_reference(lattice, np.asarray(at))

    off = np.abs(noise(p + CRACKS_AT)) * spacing / NOISE_SLOPE / line_m
    total = row[Column.CRACKS] * LINE_M / line_m * np.clip(1.0 - off, 0.0, None)
    if across_m >= 20 * LINE_M:
        total *= 0.0
    border = noise(0.4 * p + PATCHES_AT) * 2.5 * spacing / NOISE_SLOPE / max(2 * LINE_M, across_m)
    total += row[Column.PATCHES] * (np.clip(0.5 + border, 0.0, 1.0) - 0.5)
    if row[Column.CELL_ALONG] > 0.0:
        along, up = row[Column.CELL_ALONG], row[Column.CELL_UP]
        b = points[:, 1] / up
        a = points[:, 0] / along + 0.5 * (np.floor(b).astype(int) % 2)
        number = (np.floor(a).astype(np.int64) * 73856093) ^ (
            np.floor(b).astype(np.int64) * 19349663
        )
        fade = np.clip(min(along, up) / across_m - 1.0, 0.0, 1.0)
        total += row[Column.CELLS] * lattice[number % LATTICE**2] * fade
        edge = np.minimum(np.abs(a - np.rint(a)) * along, np.abs(b - np.rint(b)) * up)
        joint = LINE_M / line_m * np.clip(1.0 - edge / line_m, 0.0, None)
        total += row[Column.JOINTS] * joint * fade
    d = np.asarray(way) * along_m / spacing
    for octave in range(int(row[Column.OCTAVES])):
        size = spacing / 2**octave
        samples = min(4, int(2 * along_m / size) + 1) if along_m > 0.5 * size else 1
        weight = np.clip(size / max(across_m, along_m / samples) - 1.0, 0.0, 1.0)
        f = (np.arange(samples) + 0.5) / samples - 0.5
        mean = np.mean([noise(p + x * d) for x in f], axis=0)
        strength = row[Column.AMPLITUDE] * row[Column.PERSISTENCE] ** octave / NOISE_SIGMA
        total += strength * weight**2 * (3.0 - 2.0 * weight) * mean
        p, d = p @ OCTAVE.T + OCTAVE_AT, OCTAVE @ d
    return total


@pytest.mark.parametrize("material", [Material.ASPHALT, Material.CONCRETE, Material.GRASS])
@pytest.mark.parametrize("pixel_m", [(0.002, 0.002), (0.03, 0.14), (0.2, 0.9)])
def test_the_kernel_agrees_with_plain_numpy(lattice, rng, material, pixel_m) -> None:
    row = thermal_table(find_weather("sunny_day"))[material]
    points = rng.uniform(-300, 300, (2000, 2))
    way = (0.8, -0.6)
    np.testing.assert_allclose(
        varied(lattice, row, points, *pixel_m, way),
        reference(lattice, row, points, *pixel_m, way),
        atol=2e-5 * row[Column.AMPLITUDE] * 10,
    )


def test_what_is_no_surface_has_no_texture(lattice, row) -> None:
    patches, out = empty_patches(3), np.ones(3)
    patches.material[:] = -1
    vary(lattice, row[None], patches, 2, out)
    np.testing.assert_array_equal(out, [0.0, 0.0, 1.0])


def spread(lattice, row, across_m, along_m, count=20_000) -> float:
    points = np.random.default_rng(8).uniform(0, 50.0, (count, 2))
    return float(varied(lattice, row, points, across_m, along_m).std())


def test_a_fine_pixel_sees_the_whole_amplitude(lattice, row) -> None:
    assert 0.95 < spread(lattice, row, 1e-3, 1e-3, 40_000) < 1.05


def test_octaves_finer_than_the_pixel_fade_away(lattice, row) -> None:
    """Neighbouring pixels must differ little: otherwise the texture would alias."""
    assert 0.3 < spread(lattice, row, 0.4, 0.4) < 0.75
    assert spread(lattice, row, 1.0, 1.0) == 0.0


def test_a_stretched_pixel_averages_along_its_stretch(lattice, row) -> None:
    """Detail across the stretch survives where an isotropic filter would lose it."""
    fine, stretched, blurred = (
        spread(lattice, row, *pixel) for pixel in ((0.05, 0.05), (0.05, 0.4), (0.4, 0.4))
    )
    assert blurred < stretched < fine


def test_weather_scales_the_texture_of_passive_materials_only() -> None:
    day, night = (thermal_table(find_weather(n)) for n in ("cloudy_day", "clear_cold_night"))
    ratio = find_weather("clear_cold_night").contrast / find_weather("cloudy_day").contrast
    found = night[Material.GRASS, Column.AMPLITUDE] / day[Material.GRASS, Column.AMPLITUDE]
    assert found == pytest.approx(ratio, rel=1e-9)
    assert night[Material.SKIN, Column.AMPLITUDE] == day[Material.SKIN, Column.AMPLITUDE]
