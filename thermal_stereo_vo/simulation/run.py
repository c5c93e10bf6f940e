"""One run, made concrete: where the rig is at any time, and which cameras look."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import flatten
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.trajectory import Motion
from thermal_stereo_vo.simulation.weather import Weather

PICTURE_VERSION = 6
"""Raised whenever the same settings give other pictures, so that old caches are refused."""

_IN_PICTURE = (
    "rate_hz",
    "world.",
    "flight.",
    "render.scale",
    "render.edge_rays",
    "render.lag",
    "render.row_time_us",
    "timing.skew_ms",
    "timing.jitter_ms",
    "thermal.time_constant_ms",
    "thermal.counts_per_kelvin",
    "visible.full_well",
    "visible.electrons",
    "visible.longest_ms",
)
"""Beginnings of the settings that change the noise-free pictures."""


@dataclass(frozen=True)
class RunPlan:
    """Preset, settings, motion, weather and rig of one run."""

    preset: str
    config: SimulationConfig
    motion: Motion
    weather: Weather
    rig: RigCalibration

    @property
    def roles(self) -> tuple[str, ...]:
        """Cameras in order."""
        return tuple(self.rig.cameras)

    def T_map_rig(self, time_s: float) -> NDArray[np.float64]:
        """(4, 4) pose of the rig in the map (east, north, up)."""
        assert self.rig.T_base_rig is not None
        return self.motion.T_map_base(time_s) @ self.rig.T_base_rig

    def camera_poses(self, role: str) -> Callable[[float], NDArray[np.float64]]:
        """Time (s) -> (4, 4) pose of one camera in the map."""
        T_rig_camera = self.rig[role].T_rig_camera
        return lambda time_s: self.T_map_rig(time_s) @ T_rig_camera

    def picture_key(self) -> str:
        """A digest of every setting that changes the noise-free pictures."""
        values = {
            path: value
            for path, value in flatten(self.config).items()
            if path.startswith(_IN_PICTURE)
        }
        if self.config.rig != "preset":
            values["rig"] = self.config.rig
        values |= {"preset": self.preset, "version": PICTURE_VERSION}
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
