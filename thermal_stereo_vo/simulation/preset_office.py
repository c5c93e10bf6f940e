"""Hand-held visible + thermal paths of Dai et al. 2019, Table I."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.simulation.preset import MakeMotion, MakeScene, Preset, settings_of
from thermal_stereo_vo.simulation.rig import visible_thermal_rig
from thermal_stereo_vo.simulation.room import build_room
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.trajectory import Motion, wander


def _rig(config: SimulationConfig) -> RigCalibration:
    return visible_thermal_rig(config.render.scale)


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

    def office(person: bool) -> MakeScene:
        def scene(plan: RunPlan) -> Scene:
            return build_room(plan.config.world.seed, plan.weather.air_kelvin, person=person)

        return scene

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
                   office(person), _rig)
        )  # fmt: skip
    return tuple(presets)
