"""Small scenes and faultless cameras for the tests of the simulator."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import Camera, DistortionModel
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.render import Renderer
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.settings import FfcConfig, ThermalCameraConfig
from thermal_stereo_vo.simulation.shading import open_field
from thermal_stereo_vo.simulation.thermal_camera import SIGNAL_STEP, ThermalCamera
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature
from thermal_stereo_vo.simulation.thermal_field import Responsivity

SMALL = ("render.scale=0.25", "render.workers=0", "world.density=0.2")

BENT_LENS = Camera(
    160, 120, 130.0, 129.5, 78.0, 62.0,
    DistortionModel.RADIAL_TANGENTIAL, (-0.285, 0.086, -0.0033, 0.0011),
)  # fmt: skip

LOOK_NORTH = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""T_map_camera at the origin: x east, y down, z north."""


def wall_scene(distance_m: float, material: Material = Material.BRICK, **quads) -> Scene:
    """A wall across the view to the north."""
    builder = MeshBuilder()
    far = 40.0
    corners = [
        [-far, distance_m, -far], [far, distance_m, -far],
        [far, distance_m, far], [-far, distance_m, far],
    ]  # fmt: skip
    builder.quads(np.array([corners]), material, **quads)
    return Scene(builder.build())


def renderer_of(scene: Scene) -> Renderer:
    return Renderer(scene, open_field())


def thermal_camera(
    shape=(60, 80), *, ffc: FfcConfig | None = None, corrections_s=(), seed=1, **settings
) -> ThermalCamera:
    """A camera at 300 K air; settings override the defaults."""
    config = ThermalCameraConfig(**settings)
    fpa = FpaTemperature(300.0, config, 0.0, wander_kelvin=0.0)
    return ThermalCamera(config, ffc or FfcConfig(), shape, fpa, corrections_s, (seed, 20, 0))


def uniform_signal(shape, kelvin=300.0) -> np.ndarray:
    """What a black body of this temperature sends, as the sensor takes it."""
    counts = float(Responsivity(30.0).counts(kelvin))
    return np.full(shape, round(counts / SIGNAL_STEP), np.uint16)


QUIET = {
    "netd_mk": 0.0, "slow_noise": 0.0, "row_noise": 0.0, "column_noise": 0.0, "gain_percent": 0.0,
    "fixed_pixel": 0.0, "fixed_column": 0.0, "fixed_row": 0.0, "creep_pixel": 0.0,
    "dome_kelvin": 0.0, "replaced_percent": 0.0, "stuck_pixels": 0, "flickering_pixels": 0,
    "drift_pixel_mk": 0.0, "drift_column_mk": 0.0, "drift_row_mk": 0.0, "drift_shading_mk": 0.0,
    "drift_mean_mk": 0.0, "blur_px": 0.0,
}  # fmt: skip
"""A camera without any fault."""
