"""A model of a simulated street against the triangles and temperatures it was made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thermal_stereo_vo.benchmarks.true_surface import TrueSurface
from thermal_stereo_vo.core.cameras import LEFT
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.datasets.simulated import SimulatedDataset
from thermal_stereo_vo.radiometry.thermometer import Thermometer, ThermometerConfig
from thermal_stereo_vo.reconstruction.config import ReconstructConfig
from thermal_stereo_vo.reconstruction.reconstructor import Reconstructor, in_axes
from thermal_stereo_vo.replay import replay
from thermal_stereo_vo.simulation.materials import SUBSTANCES, Material
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.render import Lens
from thermal_stereo_vo.simulation.studio import Studio
from thermal_stereo_vo.simulation.thermal_field import (
    PLANCK_B_KELVIN,
    PLANCK_F,
    Responsivity,
)
from thermal_stereo_vo.stereo.rectification import Rectifier

NEAR_PATH_M = 15.0
HIGH_EMISSIVITY = 0.9
_VIEW_EVERY_S = 1.0
_SAME_DEPTH_M = 0.15
_FOLIAGE = (Material.FOLIAGE, Material.HEDGE)


@dataclass(frozen=True)
class ModelFigures:
    """Of the points within 15 m of the path: distances (m) to the true surface, errors (K).

    ``temperature_*`` are of points on surfaces of an emissivity of 0.9 and more, as far as they are
    seen from the path; ``bias_kelvin`` is the median error with its sign.
    """

    points: int
    keyframes: int
    path_m: float
    distance_median_m: float
    distance_p90_m: float
    distance_without_foliage_m: float
    temperature_points: int
    temperature_median_kelvin: float
    temperature_p90_kelvin: float
    bias_kelvin: float

    def report(self) -> str:
        """For people."""
        return "\n".join(
            [
                f"{self.keyframes} keyframes along {self.path_m:.1f} m; {self.points} points "
                f"within {NEAR_PATH_M:g} m of the path",
                f"distance to the true surface: median {100 * self.distance_median_m:.1f} cm, "
                f"90 % below {100 * self.distance_p90_m:.1f} cm; median without foliage "
                f"{100 * self.distance_without_foliage_m:.1f} cm",
                f"temperature where the emissivity is {HIGH_EMISSIVITY:g} or more "
                f"({self.temperature_points} points): median error "
                f"{self.temperature_median_kelvin:.2f} K, 90 % below "
                f"{self.temperature_p90_kelvin:.2f} K, bias {self.bias_kelvin:+.2f} K",
            ]
        )


def thermometer_of(dataset: SimulatedDataset, emissivity: float = 1.0) -> ThermometerConfig:
    """What a radiometric calibration of the simulated camera would say."""
    thermal = dataset.simulation.config.thermal
    return ThermometerConfig(
        planck_r=Responsivity(thermal.counts_per_kelvin).planck_r,
        planck_b=PLANCK_B_KELVIN,
        planck_f=PLANCK_F,
        offset_counts=thermal.offset_counts,
        emissivity=emissivity,
        surroundings_kelvin=dataset.simulation.plan.weather.air_kelvin,
    )


def measure_model(
    dataset: SimulatedDataset,
    config: ReconstructConfig,
    on_progress: Callable[[], None] = lambda: None,
) -> ModelFigures:
    """Fly, reconstruct with the odometry's poses, compare."""
    simulation, plan = dataset.simulation, dataset.simulation.plan
    thermometer = Thermometer(thermometer_of(dataset))
    reconstructor = Reconstructor(config.dense, config.model, thermometer)
    replay(dataset, dataset.calibration(), config, [reconstructor], on_progress=on_progress)
    rectifier = Rectifier(plan.rig, config.rectification)

    def T_map_rectified(time_s: float) -> NDArray[np.float64]:
        return plan.T_map_rig(time_s) @ rectifier.T_rig_rectified

    model = in_axes(T_map_rectified(0.0), reconstructor.model())
    xyz = model.cloud.xyz.astype(np.float64)
    times_s = np.arange(0.0, simulation.duration_s, 0.1)
    path_m = np.array([plan.T_map_rig(t)[:3, 3] for t in times_s])
    near = np.asarray(cKDTree(path_m).query(xyz)[0]) <= NEAR_PATH_M
    surface = TrueSurface(
        find_preset(plan.preset).scene(plan).static,
        path_m,
        NEAR_PATH_M + 3.0,
        np.random.default_rng(0),
    )
    distance_m, material = surface.nearest(xyz[near])
    emissivity = np.array([SUBSTANCES[Material(m)].emissivity for m in range(len(Material))])
    assert model.cloud.temperature_kelvin is not None
    grey = emissivity[material] >= HIGH_EMISSIVITY
    errors = _temperature_errors(
        Studio(plan),
        Lens(rectifier.rectified_calibration[LEFT].camera),
        T_map_rectified,
        np.arange(0.0, simulation.duration_s, _VIEW_EVERY_S),
        xyz[near][grey],
        model.cloud.temperature_kelvin[near][grey],
    )
    return ModelFigures(
        points=int(near.sum()),
        keyframes=reconstructor.keyframes,
        path_m=float(np.linalg.norm(np.diff(path_m, axis=0), axis=1).sum()),
        distance_median_m=float(np.median(distance_m)),
        distance_p90_m=float(np.percentile(distance_m, 90)),
        distance_without_foliage_m=float(np.median(distance_m[~np.isin(material, _FOLIAGE)])),
        temperature_points=len(errors),
        temperature_median_kelvin=float(np.median(np.abs(errors))),
        temperature_p90_kelvin=float(np.percentile(np.abs(errors), 90)),
        bias_kelvin=float(np.median(errors)),
    )


def _temperature_errors(
    studio: Studio,
    lens: Lens,
    T_map_camera: Callable[[float], NDArray[np.float64]],
    times_s: NDArray[np.float64],
    xyz: NDArray[np.float64],
    kelvin: NDArray[np.float32],
) -> NDArray[np.float64]:
    """(N,) errors of the points that some true view shows, each against its last one."""
    errors = np.full(len(xyz), np.nan)
    camera = lens.camera
    for time_s in times_s:
        true_kelvin, depth_m = studio.temperatures(lens, T_map_camera, float(time_s))
        seen = transform_points(inverse(T_map_camera(float(time_s))), xyz)
        pixels = np.rint(np.nan_to_num(camera.project(seen), nan=-1.0)).astype(np.intp)
        inside = np.all((pixels >= 0) & (pixels < camera.size), axis=1)
        x, y = pixels[inside].T
        same = np.abs(depth_m[y, x] - seen[inside, 2]) < _SAME_DEPTH_M
        rows = np.nonzero(inside)[0][same]
        errors[rows] = kelvin[rows] - true_kelvin[y[same], x[same]]
    return np.asarray(errors[np.isfinite(errors)])
