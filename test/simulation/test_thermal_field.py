from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.shading import sky_radiance, thermal_band
from thermal_stereo_vo.simulation.thermal_field import Responsivity
from thermal_stereo_vo.simulation.weather import find_weather

from .small_worlds import BENT_LENS, LOOK_NORTH, renderer_of, wall_scene


def test_the_responsivity_is_what_was_asked_for() -> None:
    responsivity = Responsivity(30.0)
    low, high = responsivity.counts([299.5, 300.5])
    assert high - low == pytest.approx(30.0, rel=1e-4)
    assert responsivity.kelvin(responsivity.counts(263.0)) == pytest.approx(263.0, abs=1e-9)


def test_a_kelvin_gives_fewer_counts_in_the_cold() -> None:
    """So that the same noise is worth 1.4 to 1.8 times as much at -10 degC as at 27 degC."""
    low, high = Responsivity(30.0).counts([262.65, 263.65])
    assert 1.4 < 30.0 / (high - low) < 1.8


@pytest.mark.parametrize(
    ("weather", "lowest", "highest"),
    [("sunny_day", -45, -25), ("cloudy_day", -10, 7), ("foggy_day", 11, 13),
     ("clear_cold_night", -80, -50)],
)  # fmt: skip
def test_the_sky_is_as_cold_as_skies_are(lattice, weather, lowest, highest) -> None:
    band = thermal_band(find_weather(weather), Responsivity(30.0), lattice)
    zenith = Responsivity(30.0).kelvin(sky_radiance(band, 0.0, 0.0, 1.0, False)) - 273.15
    assert lowest < zenith < highest
    horizon = Responsivity(30.0).kelvin(sky_radiance(band, 1.0, 0.0, 0.0, False))
    air = find_weather(weather).air_kelvin
    assert air - 1.0 < horizon < air + 0.01


def wall_kelvin(lattice, weather, material, distance_m=8.0) -> float:
    """Apparent temperature in the middle of a wall."""
    band = thermal_band(weather, Responsivity(30.0), lattice)
    renderer = renderer_of(wall_scene(distance_m, material))
    from thermal_stereo_vo.simulation.render import Lens

    picture = renderer.render(Lens(BENT_LENS), band, lambda _: LOOK_NORTH, 0.0).radiance
    return float(Responsivity(30.0).kelvin(np.median(picture[50:70, 70:90])))


def test_a_black_body_shows_its_own_temperature(lattice) -> None:
    weather = find_weather("indoor", 300.0)
    assert wall_kelvin(lattice, weather, Material.BLACKBODY) == pytest.approx(300.0, abs=0.01)


def test_polished_aluminium_shows_what_it_mirrors(lattice) -> None:
    """A wall mirrors the horizon, which is as warm as the air; its own heat hardly shows."""
    weather = find_weather("clear_cold_night")
    found = wall_kelvin(lattice, weather, Material.ALUMINIUM)
    assert found == pytest.approx(weather.air_kelvin, abs=1.5)


def test_fog_hides_what_is_far(lattice) -> None:
    weather = find_weather("foggy_day")
    near = wall_kelvin(lattice, weather, Material.ASPHALT, 2.0) - weather.air_kelvin
    far = wall_kelvin(lattice, weather, Material.ASPHALT, 60.0) - weather.air_kelvin
    assert near > 0.5
    # exp(-0.012 * 58) of the contrast is left.
    assert far / near == pytest.approx(np.exp(-0.012 * 58.0), rel=0.15)


def test_an_unknown_weather_is_refused_with_the_known_ones() -> None:
    with pytest.raises(SimulationError, match=r"unknown weather 'hail': choose one of sunny_day"):
        find_weather("hail")
