"""Runs by name: where they lead, when, in which weather, and with which cameras."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation.preset import Preset, stereo, visible_thermal
from thermal_stereo_vo.simulation.preset_flights import dusk_flights, paper_flights, short_flights
from thermal_stereo_vo.simulation.preset_office import critical_motions, hand_held
from thermal_stereo_vo.simulation.preset_targets import targets
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.weather import find_weather

_ZERO_CELSIUS_KELVIN = 273.15


@functools.cache
def all_presets() -> tuple[Preset, ...]:
    """Every preset, flights first."""
    return (
        *paper_flights(),
        *short_flights(),
        *hand_held(),
        *critical_motions(),
        *dusk_flights(),
        *targets(),
    )


def find_preset(name: str) -> Preset:
    """The preset of that name.  Raises SimulationError that lists the known ones."""
    for preset in all_presets():
        if preset.name == name:
            return preset
    known = ", ".join(preset.name for preset in all_presets())
    raise SimulationError(f"there is no preset '{name}': choose one of {known}")


def plan_run(preset: str, config: SimulationConfig) -> RunPlan:
    """Fly ``preset`` with these settings.

    Raises SimulationError for an unknown preset or a flight that cannot be flown.
    """
    chosen = find_preset(preset)
    air = config.world.air_celsius
    weather = find_weather(
        config.world.weather, None if air is None else air + _ZERO_CELSIUS_KELVIN
    )
    weather = dataclasses.replace(weather, contrast=weather.contrast * config.world.contrast)
    if config.world.illumination is not None:
        weather = dataclasses.replace(weather, illumination=config.world.illumination)
    motion = chosen.motion(config, np.random.default_rng([config.flight.seed, 10]))
    rig = {"stereo": stereo, "visible_thermal": visible_thermal}.get(config.rig, chosen.rig)
    return RunPlan(preset, config, motion, weather, rig(config))
