"""What the tests of the simulator share: a noise lattice, a band, a world built once."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.simulation.noise import random_lattice
from thermal_stereo_vo.simulation.presets import find_preset, plan_run
from thermal_stereo_vo.simulation.shading import thermal_band
from thermal_stereo_vo.simulation.studio import Studio
from thermal_stereo_vo.simulation.thermal_field import Responsivity
from thermal_stereo_vo.simulation.weather import find_weather

from .small_worlds import SMALL


@pytest.fixture(scope="session")
def lattice():
    return random_lattice(np.random.default_rng(5))


@pytest.fixture(scope="session")
def band(lattice):
    return thermal_band(find_weather("cloudy_day"), Responsivity(30.0), lattice)


@pytest.fixture(scope="session")
def hover_studio():
    """The world of ``hover`` at quarter size."""
    config = with_overrides(find_preset("hover").config, SMALL)
    return Studio(plan_run("hover", config))
