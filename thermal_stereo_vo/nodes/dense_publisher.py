"""Dense stereo as topics, beside the odometry and never before it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from stereo_msgs.msg import DisparityImage

from thermal_stereo_vo.core.cameras import LEFT
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.core.transforms import transform_points
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_odometry_config import StereoOdometryNodeConfig
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.ros_fields import disparity_fields, point_cloud_fields
from thermal_stereo_vo.radiometry.thermometer import Thermometer
from thermal_stereo_vo.stereo.dense import DenseStereo, DisparityMap
from thermal_stereo_vo.stereo.dense_cloud import camera_cloud

NICENESS = 10
"""So that the odometry goes first where both want the same core."""


class DensePublisher(Observer):
    """``disparity`` in the left camera and ``points2`` in the odometry's frame.

    Works on a thread of its own, on the newest frame, at most ``rate_hz`` times a second and only
    while somebody listens.  While the odometry is lost ``points2`` is silent.
    """

    def __init__(
        self,
        node: Node,
        config: StereoOdometryNodeConfig,
        on_error: Callable[[BaseException], None],
    ) -> None:
        self._config = config.dense
        thermometer = Thermometer.of(config.thermometer)
        self._kelvin = None if thermometer is None else thermometer.kelvin
        self._T_base_rig = config.mount.T_base_rig
        self._odom_frame = config.odom_frame
        self._period_ns = round(1e9 / config.dense.rate_hz)
        self._stereo = DenseStereo(config.dense)
        self._disparity = node.create_publisher(
            DisparityImage,
            "disparity",
            runtime.IMAGES_OUT,
            qos_overriding_options=runtime.overridable(),
        )
        self._points = node.create_publisher(
            PointCloud2,
            "points2",
            runtime.IMAGES_OUT,
            qos_overriding_options=runtime.overridable(),
        )
        self._worker = runtime.Worker(newest_only=True, on_error=on_error)
        self._worker.submit(_step_back)
        self._frame: RigFrame | None = None
        self._next_ns = 0
        self.made = 0

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._frame = frame

    def on_result(self, result: OdometryResult) -> None:
        frame, self._frame = self._frame, None
        if frame is None or not (_wanted(self._disparity) or _wanted(self._points)):
            return
        if self._is_due(frame.stamp_ns):
            self._worker.submit(partial(self._make, frame, result.T_world_rig), frame=True)

    def counters(self) -> tuple[tuple[str, str], ...]:
        """For diagnostics."""
        return (("dense_maps", str(self.made)), ("dense_dropped", str(self._worker.dropped)))

    def stop(self) -> None:
        """End the thread; the node is about to go."""
        self._worker.close()

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a period has gone by; stamps that went back begin anew."""
        if 0 < self._next_ns - stamp_ns <= self._period_ns:
            return False
        in_step = 0 <= stamp_ns - self._next_ns < self._period_ns
        self._next_ns = (self._next_ns if in_step else stamp_ns) + self._period_ns
        return True

    def _make(self, frame: RigFrame, T_world_rig: NDArray[np.float64] | None) -> None:
        disparities = self._stereo.process(frame)
        if disparities is None:
            return
        self.made += 1
        if _wanted(self._disparity):
            fields = disparity_fields(disparities, frame_id=f"{LEFT}_optical")
            self._disparity.publish(conversions.disparity_to_msg(fields))
        if T_world_rig is not None and _wanted(self._points):
            self._send_points(disparities, T_world_rig)

    def _send_points(self, disparities: DisparityMap, T_world_rig: NDArray[np.float64]) -> None:
        cloud = camera_cloud(
            disparities,
            self._kelvin,
            max_range_m=self._config.max_range_m,
            step=self._config.point_step,
        )
        world = replace(cloud, xyz=transform_points(T_world_rig, cloud.xyz).astype(np.float32))
        fields = point_cloud_fields(
            disparities.stamp_ns, world, self._T_base_rig, frame_id=self._odom_frame
        )
        self._points.publish(conversions.point_cloud_to_msg(fields))


def _wanted(publisher: object) -> bool:
    return bool(publisher.get_subscription_count() > 0)  # type: ignore[attr-defined]


def _step_back() -> None:
    """Linux gives each thread its own niceness."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
