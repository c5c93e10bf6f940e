"""Hand-held visible + thermal paths of Dai et al. 2019, Table I."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.simulation.preset import (
    MakeMotion,
    MakeScene,
    Preset,
    settings_of,
    visible_thermal,
)
from thermal_stereo_vo.simulation.room import build_room
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.trajectory import Motion, glide, wander


def hand_held() -> tuple[Preset, ...]:
    """Walks through an office with a visible and a thermal camera."""
    table = (
        (113.81, 0.0688, 29.1738, "indoor"), (89.19, 0.0690, 39.6421, "indoor"),
        (88.99, 0.0581, 33.0630, "indoor"), (102.44, 0.0969, 39.5428, "indoor"),
        (110.47, 0.0724, 28.6348, "indoor"), (159.19, 0.0575, 45.4522, "indoor"),
        (60.94, 0.1162, 31.6708, "indoor"),
    )  # fmt: skip

    def path(duration_s: float, speed_m_s: float, rotation_deg_s: float) -> MakeMotion:
        def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
            return wander(
                (-2.2, 0.2, 1.5), (1.6, 2.0, 0.8), duration_s, speed_m_s, rotation_deg_s, rng
            )

        return motion

    presets = []
    for n, (duration_s, speed, rotation, weather) in enumerate(table, start=1):
        config = settings_of(
            {"rate_hz": 20.0, "world.weather": weather, "world.seed": n, "flight.seed": n,
             "ffc.mode": "periodic", "ffc.first_s": 12.0, "ffc.period_s": 25.0}
        )  # fmt: skip
        person = n in (2, 4, 6)
        summary = f"{duration_s:.0f} s by hand in an office, {rotation:.0f} deg/s" + (
            ", somebody sits there" if person else ""
        )
        presets.append(
            Preset(f"ms-{n:02d}", summary, config, path(duration_s, speed, rotation),
                   _office(person), visible_thermal)
        )  # fmt: skip
    return tuple(presets)


def critical_motions() -> tuple[Preset, ...]:
    """Motions that do not tell the scale of a visible + thermal rig: straight ahead, and none."""

    def glided(start_m: tuple[float, ...], end_m: tuple[float, ...]) -> MakeMotion:
        def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
            return glide(start_m, end_m, 12.0)

        return motion

    config = settings_of({"rate_hz": 20.0, "world.weather": "indoor"})
    place, ahead = (-2.6, 0.2, 1.5), (-0.8, 0.2, 1.5)
    return (
        Preset("ms-forward", "12 s straight ahead through the office", config,
               glided(place, ahead), _office(False), visible_thermal),
        Preset("ms-still", "12 s on the spot in the office", config,
               glided(place, place), _office(False), visible_thermal),
    )  # fmt: skip


def _office(person: bool) -> MakeScene:
    def scene(plan: RunPlan) -> Scene:
        return build_room(plan.config.world.seed, plan.weather.air_kelvin, person=person)

    return scene
