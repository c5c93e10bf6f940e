"""Clouds of a simulated visible camera painted by the thermal one, against true temperatures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.reconstruction import thermometer_of
from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.transforms import transform_points
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.radiometry.thermometer import Thermometer
from thermal_stereo_vo.reconstruction.painting import painted
from thermal_stereo_vo.simulation.render import Lens
from thermal_stereo_vo.simulation.schedule import Exposure, stamp_ns
from thermal_stereo_vo.simulation.studio import Studio


@dataclass(frozen=True)
class PaintedView:
    """Points of the visible camera (N, 3) in its axes, painted and true temperatures (N,) in K.

    ``hidden`` (N,) bool: what the thermal camera cannot see, as its true depths tell.
    """

    xyz_m: NDArray[np.float64]
    painted_kelvin: NDArray[np.float32]
    true_kelvin: NDArray[np.float64]
    hidden: NDArray[np.bool_]

    def report(self) -> str:
        """For people."""
        given = np.isfinite(self.painted_kelvin)
        error = (self.painted_kelvin - self.true_kelvin)[given & ~self.hidden]
        offset = np.median(error)
        rest = np.abs(error - offset)
        return (
            f"{len(given)} points, {100 * given.mean():.1f} % painted; "
            f"{100 * (given & self.hidden).sum() / max(self.hidden.sum(), 1):.1f} % of the "
            f"{self.hidden.sum()} hidden ones wrongly; the camera's offset is {offset:+.2f} K, "
            f"beside it the median error is {np.median(rest):.2f} K, 90 % below "
            f"{np.percentile(rest, 90):.2f} K"
        )


def painted_view(preset: str, fraction: float, overrides: tuple[str, ...] = ()) -> PaintedView:
    """The view at this fraction of a simulated visible + thermal run.

    The cloud is that of the true depths of the visible camera, so that only the painting errs.
    """
    dataset = open_simulated(preset, SourceOptions(overrides=overrides))
    simulation, plan = dataset.simulation, dataset.simulation.plan
    index = round(fraction * (simulation.instants - 1))
    time_s = index / simulation.config.rate_hz
    studio = Studio(plan)
    visible, thermal = plan.rig[VISIBLE], plan.rig[THERMAL]
    true_kelvin, depth_m = studio.temperatures(
        Lens(visible.camera), plan.camera_poses(VISIBLE), time_s
    )
    rows, columns = np.nonzero(np.isfinite(depth_m))
    rays = visible.camera.unproject(np.column_stack([columns, rows]).astype(np.float64))
    xyz_m = rays * depth_m[rows, columns][:, None]
    number = plan.roles.index(THERMAL)
    raw = simulation.sensor(number, corrections=False).frame(
        studio.picture(THERMAL, time_s).signal,
        Exposure(number, index, time_s, stamp_ns(time_s), False),
    )
    assert raw is not None
    T_thermal_visible = plan.rig.T_a_b(THERMAL, VISIBLE)
    kelvin = Thermometer(thermometer_of(dataset)).kelvin(raw.image)
    seen = transform_points(T_thermal_visible, xyz_m)
    truth_m = studio.temperatures(Lens(thermal.camera), plan.camera_poses(THERMAL), time_s)[1]
    return PaintedView(
        xyz_m,
        painted(xyz_m, kelvin, thermal.camera, T_thermal_visible, point_size_m=0.02),
        true_kelvin[rows, columns],
        _hidden(thermal.camera.project(seen), seen[:, 2], truth_m),
    )


def _hidden(
    pixels: NDArray[np.float64], depth_m: NDArray[np.float64], nearest_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(N,) True where something stands at least a tenth nearer in all pixels around."""
    height, width = nearest_m.shape
    hidden = np.zeros(len(pixels), np.bool_)
    at = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.intp)
    inside = np.all((at >= 1) & (at < [width - 1, height - 1]), axis=1)
    x, y = at[inside].T
    farthest = np.max([nearest_m[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=0)
    hidden[inside] = farthest < 0.9 * depth_m[inside]
    return hidden
