"""Weather and time of day as the few numbers that set temperatures, sky and visibility."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import SimulationError


@dataclass(frozen=True)
class Weather:
    """What the sky does to the scene.

    ``sun`` is the direct sunshine (0..1) that made the surfaces warm, ``daylight`` the diffuse one.
    ``sky_emissivity`` is that of the zenith in 8-14 um (Smith & Toumi 2008: clear 0.2-0.4, low
    overcast near 1); the horizon always radiates like air.  ``cloud_variation`` is how much it
    varies between thin and thick cloud.  ``sky_cooling`` is the part of the clear-night loss that
    surfaces facing the sky suffer, ``heat_storage`` what walls and roads still hold from the day.
    ``contrast`` scales the small-scale temperature texture; 1 is a bright day without sun.
    ``extinction_per_m`` is that of the air in 8-14 um.  ``illumination`` is the visible light
    relative to full daylight, ``ambient`` the part of it that comes from everywhere; ``lamps`` says
    whether street lamps are lit.
    """

    name: str
    air_kelvin: float
    sun: float
    daylight: float
    sky_emissivity: float
    cloud_variation: float
    sky_cooling: float
    heat_storage: float
    contrast: float
    extinction_per_m: float
    illumination: float
    lamps: bool
    ambient: float = 0.15
    sun_elevation_deg: float = 35.0
    sun_azimuth_deg: float = 215.0

    @property
    def sun_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector towards the sun, east north up."""
        elevation = np.radians(self.sun_elevation_deg)
        azimuth = np.radians(self.sun_azimuth_deg)
        level = np.cos(elevation)
        return np.array([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)])


WEATHERS = {
    weather.name: weather
    for weather in (
        Weather(
            name="sunny_day",
            air_kelvin=292.0,
            sun=1.0,
            daylight=1.0,
            sky_emissivity=0.35,
            cloud_variation=0.08,
            sky_cooling=0.3,
            heat_storage=0.3,
            contrast=2.0,
            extinction_per_m=2e-4,
            illumination=1.0,
            lamps=False,
        ),
        Weather(
            name="cloudy_day",
            air_kelvin=280.0,
            sun=0.0,
            daylight=0.5,
            sky_emissivity=0.88,
            cloud_variation=0.10,
            sky_cooling=0.15,
            heat_storage=0.4,
            contrast=0.45,
            extinction_per_m=3e-4,
            illumination=0.3,
            lamps=False,
        ),
        Weather(
            name="foggy_day",
            air_kelvin=285.0,
            sun=0.0,
            daylight=0.25,
            sky_emissivity=1.0,
            cloud_variation=0.0,
            sky_cooling=0.05,
            heat_storage=0.4,
            contrast=0.40,
            extinction_per_m=0.012,
            illumination=0.2,
            lamps=False,
        ),
        Weather(
            name="cloudy_night",
            air_kelvin=277.0,
            sun=0.0,
            daylight=0.0,
            sky_emissivity=0.88,
            cloud_variation=0.08,
            sky_cooling=0.2,
            heat_storage=0.8,
            contrast=0.35,
            extinction_per_m=3e-4,
            illumination=3e-4,
            lamps=True,
        ),
        Weather(
            name="clear_cold_night",
            air_kelvin=265.0,
            sun=0.0,
            daylight=0.0,
            sky_emissivity=0.25,
            cloud_variation=0.0,
            sky_cooling=1.0,
            heat_storage=0.6,
            contrast=0.12,
            extinction_per_m=2e-4,
            illumination=5e-5,
            lamps=True,
        ),
        Weather(
            name="indoor",
            air_kelvin=295.0,
            sun=0.0,
            daylight=0.0,
            sky_emissivity=1.0,
            cloud_variation=0.0,
            sky_cooling=0.0,
            heat_storage=1.0,
            contrast=0.3,
            extinction_per_m=0.0,
            illumination=0.01,
            lamps=False,
            ambient=0.75,
        ),
    )
}


def find_weather(name: str, air_kelvin: float | None = None) -> Weather:
    """The weather of that name, at another air temperature if one is given.

    Raises SimulationError for an unknown name.
    """
    if name not in WEATHERS:
        raise SimulationError(f"unknown weather '{name}': choose one of {', '.join(WEATHERS)}")
    weather = WEATHERS[name]
    return weather if air_kelvin is None else replace(weather, air_kelvin=air_kelvin)
