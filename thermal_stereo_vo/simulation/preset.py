"""What a named run consists of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import from_mapping
from thermal_stereo_vo.simulation.rig import stereo_rig, visible_thermal_rig
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.trajectory import Motion

MakeMotion = Callable[[SimulationConfig, np.random.Generator], Motion]
MakeScene = Callable[[RunPlan], Scene]
MakeRig = Callable[[SimulationConfig], RigCalibration]


@dataclass(frozen=True)
class Preset:
    """A named run: a sentence, its settings, and how to make motion, scene and rig."""

    name: str
    summary: str
    config: SimulationConfig
    motion: MakeMotion
    scene: MakeScene
    rig: MakeRig


def settings_of(mapping: Mapping[str, Any]) -> SimulationConfig:
    """The defaults but for these keys."""
    return from_mapping(SimulationConfig, mapping)


def stereo(config: SimulationConfig) -> RigCalibration:
    """The thermal stereo rig of Mouats et al. 2015."""
    return stereo_rig(config.render.scale, config.flight.tilt_down_deg)


def visible_thermal(config: SimulationConfig) -> RigCalibration:
    """A visible camera beside a thermal one, as held by Dai et al. 2019."""
    return visible_thermal_rig(config.render.scale)
