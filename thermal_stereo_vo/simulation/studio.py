"""Everything needed to make the noise-free picture of one camera at one time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import VISIBLE
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.simulation import thermal_camera, visible_camera
from thermal_stereo_vo.simulation.lag import (
    backward_flow,
    exponential_delays,
    smear,
    uniform_delays,
)
from thermal_stereo_vo.simulation.lighting import light_scene
from thermal_stereo_vo.simulation.noise import random_lattice
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.ray_casting import RayCaster
from thermal_stereo_vo.simulation.render import Lens, Poses, Renderer, Rendering
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.shading import Band, thermal_band, visible_band
from thermal_stereo_vo.simulation.thermal_field import Column, Responsivity
from thermal_stereo_vo.simulation.visible_camera import VisibleCamera

_LATTICE_SEED = 77


@dataclass(frozen=True)
class Picture:
    """``signal`` (H, W) uint16 in the sensor's ``SIGNAL_STEP``; the sharp rendering behind it."""

    signal: NDArray[np.uint16]
    rendering: Rendering


class Studio:
    """The built world of a run, with its lenses.  Large: one in each process."""

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        config = plan.config
        scene = find_preset(plan.preset).scene(plan)
        static = RayCaster(scene.static.vertices)
        self._renderer = Renderer(scene, light_scene(scene, plan.weather, static), static)
        lattice = random_lattice(np.random.default_rng(_LATTICE_SEED))
        self._responsivity = Responsivity(config.thermal.counts_per_kelvin)
        self._thermal = thermal_band(plan.weather, self._responsivity, lattice)
        # Pictures of the visible band are kept relative to the light there is.
        self._visible = visible_band(replace(plan.weather, illumination=1.0), lattice)
        self._lenses = {
            role: Lens(plan.rig[role].camera, config.render.edge_rays) for role in plan.roles
        }
        self._exposure_s = VisibleCamera(config.visible, plan.weather.illumination, (0,)).exposure_s

    def render(self, role: str, time_s: float) -> Rendering:
        """The sharp picture at one time."""
        row_time_s = self._plan.config.render.row_time_us * 1e-6
        return self._renderer.render(
            self._lenses[role],
            self._band(role),
            self._plan.camera_poses(role),
            time_s,
            row_time_s=0.0 if role == VISIBLE else row_time_s,
        )

    def thermal_view(self, lens: Lens, poses: Poses, time_s: float) -> Rendering:
        """The sharp thermal picture, with its depths, through a lens that is not of the rig."""
        return self._renderer.render(lens, self._thermal, poses, time_s)

    def temperatures(
        self, lens: Lens, poses: Poses, time_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """(H, W) true temperatures (K) of the surfaces and (H, W) depths (m), inf in the sky."""
        table = self._thermal.table.copy()
        table[:, Column.EMISSIVITY] = 1.0
        black = self._thermal._replace(table=table, extinction_per_m=0.0)
        seen = self._renderer.render(lens, black, poses, time_s)
        return self._responsivity.kelvin(np.maximum(seen.radiance, 1e-3)), seen.depth_m

    def picture(self, role: str, time_s: float) -> Picture:
        """What the sensor takes in at one time, smeared by lag or exposure."""
        config = self._plan.config
        samples = config.render.lag_samples
        if role == VISIBLE:
            memory_s, spread = self._exposure_s, uniform_delays
            step = visible_camera.SIGNAL_STEP
        else:
            memory_s = config.thermal.time_constant_ms * 1e-3
            spread = exponential_delays
            step = thermal_camera.SIGNAL_STEP
        few, delays = spread(min(samples, 3)), spread(samples)
        sharp = self.render(role, time_s)
        radiance = sharp.radiance
        if config.render.lag == "rendered" and memory_s > 0.0:
            total = np.zeros(radiance.shape, np.float64)
            for delay in delays:
                total += self.render(role, time_s - delay * memory_s).radiance
            radiance = (total / samples).astype(np.float32)
        elif config.render.lag == "reprojected" and memory_s > 0.0:
            radiance = self._smeared(role, sharp, time_s, memory_s, few, delays)
        signal = np.rint(radiance / np.float32(step))
        return Picture(np.clip(signal, 0, 65535).astype(np.uint16), sharp)

    def _band(self, role: str) -> Band:
        return self._visible if role == VISIBLE else self._thermal

    def _smeared(
        self,
        role: str,
        sharp: Rendering,
        time_s: float,
        memory_s: float,
        few: NDArray[np.float64],
        delays: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        poses = self._plan.camera_poses(role)
        now, then = poses(time_s), inverse(poses(time_s - memory_s))
        movers_now = self._renderer.T_map_movers(time_s)
        movers_then = self._renderer.T_map_movers(time_s - memory_s)
        T_then_now = np.array(
            [
                then @ now,
                *(
                    then @ before @ inverse(after) @ now
                    for before, after in zip(movers_then, movers_now, strict=True)
                ),
            ]
        )
        lens = self._lenses[role]
        flow = np.empty((*sharp.radiance.shape, 2), np.float32)
        largest = backward_flow(
            lens.centres, lens.pixels_per_plane, sharp.depth_m, sharp.owner, T_then_now, flow
        )
        if largest < 0.01:
            return sharp.radiance
        out = np.empty_like(sharp.radiance)
        smear(sharp.radiance, flow, few, delays, out)
        return out
