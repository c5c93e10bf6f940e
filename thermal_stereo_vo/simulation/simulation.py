"""One simulated run: a preset made concrete, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.simulation.noise import random_lattice
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.render import Lens, Poses, Renderer
from thermal_stereo_vo.simulation.rig import stereo_rig
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.shading import open_field, thermal_band
from thermal_stereo_vo.simulation.thermal_camera import ThermalCamera
from thermal_stereo_vo.simulation.thermal_field import Responsivity
from thermal_stereo_vo.simulation.town import TownOptions, build_town
from thermal_stereo_vo.simulation.weather import find_weather

START_NS = 1_400_000_000_000_000_000
"""Stamp of the first frame; any will do, but a stamp should look like one."""

_ZERO_CELSIUS_KELVIN = 273.15


class Simulation:
    """World, motion, rig and sensors of one run."""

    def __init__(self, preset: str, config: SimulationConfig, seed: int) -> None:
        self.preset = find_preset(preset)
        self.config = config
        self.seed = seed
        self.motion = self.preset.motion(config, np.random.default_rng([seed, 10]))
        self.rig = stereo_rig(config.scale)
        air = config.air_celsius
        self.weather = find_weather(
            config.weather, None if air is None else air + _ZERO_CELSIUS_KELVIN
        )

    @property
    def instants(self) -> int:
        return int(self.motion.duration_s * self.config.rate_hz) + 1

    def time_s(self, index: int) -> float:
        return index / self.config.rate_hz

    def stamp_ns(self, index: int) -> int:
        return START_NS + round(index * 1e9 / self.config.rate_hz)

    def T_map_rig(self, time_s: float) -> NDArray[np.float64]:
        T_base_rig = self.rig.T_base_rig
        assert T_base_rig is not None
        return self.motion.T_map_base(time_s) @ T_base_rig

    def T_map_camera(self, role: str) -> Poses:
        """Time (s) -> (4, 4) pose of one camera."""
        T_rig_camera = self.rig[role].T_rig_camera
        return lambda time_s: self.T_map_rig(time_s) @ T_rig_camera

    def ground_truth(self) -> Trajectory:
        """Poses of the rig relative to the first."""
        poses = np.array([self.T_map_rig(self.time_s(i)) for i in range(self.instants)])
        stamps = np.array([self.stamp_ns(i) for i in range(self.instants)], dtype=np.int64)
        return Trajectory(stamps, inverse(poses[0]) @ poses)

    def frames(self) -> Iterator[RawFrame]:
        path = np.array(
            [self.motion.T_map_base(t)[:3, 3] for t in np.arange(0, self.motion.duration_s, 0.5)]
        )
        scene = build_town(path, TownOptions(seed=1, weather=self.weather), self.weather.air_kelvin)
        responsivity = Responsivity(self.config.thermal.counts_per_kelvin)
        lattice = random_lattice(np.random.default_rng(3))
        renderer = Renderer(scene, open_field())
        band = thermal_band(self.weather, responsivity, lattice)
        roles = list(self.rig.cameras)
        lenses = {role: Lens(self.rig[role].camera) for role in roles}
        cameras = {
            role: ThermalCamera(self.config.thermal, (self.seed, 20, number))
            for number, role in enumerate(roles)
        }
        for index in range(self.instants):
            time_s = self.time_s(index)
            for role in roles:
                radiance = renderer.render(
                    lenses[role], band, self.T_map_camera(role), time_s
                ).radiance
                image = cameras[role].expose(radiance, index)
                yield RawFrame(image, self.stamp_ns(index), role, index)
