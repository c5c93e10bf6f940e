"""Keyframes of a run, seen densely, fused into one model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.radiometry.thermometer import Thermometer
from thermal_stereo_vo.reconstruction.volume import SurfaceModel, Volume, VolumeConfig
from thermal_stereo_vo.stereo.dense import DenseConfig, DenseStereo, DisparityMap
from thermal_stereo_vo.stereo.dense_cloud import camera_cloud, points_of

_MEASURED = (TrackingStatus.INITIALISING, TrackingStatus.TRACKING)


@dataclass(frozen=True)
class ModelConfig:
    """Which frames make the model."""

    keyframe_m: float = setting(
        0.4, "Distance from one keyframe to the next.", unit="m", minimum=0.0, maximum=100.0
    )
    keyframe_deg: float = setting(
        5.0, "Or the angle between them.", unit="deg", minimum=0.0, maximum=180.0
    )
    max_range_m: float = setting(
        15.0, "Farther points of a keyframe are left out.", unit="m", minimum=0.5, maximum=1000.0
    )
    point_step: int = setting(
        2, "Every so many pixels and rows of a keyframe a point; neighbours err alike.", unit="px",
        minimum=1, maximum=32,
    )  # fmt: skip
    volume: VolumeConfig = group(VolumeConfig, "How clouds become one model.")


class Reconstructor(Observer):
    """Fuses the keyframes among the frames that the odometry has tracked.

    The model is in the world frame.  ``sample`` is the densest map seen, for a picture.
    """

    def __init__(
        self, dense: DenseConfig, config: ModelConfig, thermometer: Thermometer | None = None
    ) -> None:
        self._config = config
        self._kelvin = None if thermometer is None else thermometer.kelvin
        self._stereo = DenseStereo(dense)
        self._volume = Volume(config.volume)
        self._frame: RigFrame | None = None
        self._last: NDArray[np.float64] | None = None
        self.sample: DisparityMap | None = None
        self.keyframes = 0
        self.measured_points = 0

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._frame = frame

    def on_result(self, result: OdometryResult) -> None:
        frame, self._frame = self._frame, None
        if frame is None or result.T_world_rig is None or result.status not in _MEASURED:
            return
        if self._is_keyframe(result.T_world_rig):
            self.add(frame, result.T_world_rig)

    def add(self, frame: RigFrame, T_world_rig: NDArray[np.float64]) -> None:
        """Fuse a rectified frame seen from this pose; nothing while an eye is blind."""
        disparities = self._stereo.process(frame)
        if disparities is None:
            return
        self._last = T_world_rig
        self.keyframes += 1
        if self.sample is None or disparities.density > self.sample.density:
            self.sample = disparities
        range_m, step = self._config.max_range_m, self._config.point_step
        cloud = camera_cloud(disparities, self._kelvin, max_range_m=range_m, step=step)
        rows, columns, depth_m = points_of(disparities, max_range_m=range_m, step=step)
        # Z = f B / d: an error of the disparity grows with the square of the distance.
        focal_baseline = disparities.camera.fx * disparities.baseline_m
        sigma_m = disparities.sigma_px[rows, columns] * depth_m**2 / focal_baseline
        world = PointCloud(
            transform_points(T_world_rig, cloud.xyz).astype(np.float32),
            cloud.intensity,
            cloud.temperature_kelvin,
        )
        self.measured_points += len(world.xyz)
        self._volume.add(world, T_world_rig[:3, 3], sigma_m)

    def model(self) -> SurfaceModel:
        """What all keyframes agree on."""
        return self._volume.surface()

    def _is_keyframe(self, T_world_rig: NDArray[np.float64]) -> bool:
        if self._last is None:
            return True
        T = inverse(self._last) @ T_world_rig
        angle_deg = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        moved_m = np.linalg.norm(T[:3, 3])
        return bool(moved_m >= self._config.keyframe_m or angle_deg >= self._config.keyframe_deg)


def in_axes(T_a_world: NDArray[np.float64], model: SurfaceModel) -> SurfaceModel:
    """The model in other axes."""
    xyz = transform_points(T_a_world, model.cloud.xyz).astype(np.float32)
    return replace(model, cloud=replace(model.cloud, xyz=xyz))
