"""The results of a pipeline as topics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.ros_fields import (
    odometry_fields,
    point_cloud_fields,
    status_fields,
)

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not every machine with rclpy has it; publish_tf says so
    TFMessage = None


class ResultPublisher(Observer):
    """Publishes ``odom``, ``status``, ``points`` and, when asked to, the transform.

    While the odometry is lost there is no pose, so ``odom`` and the transform fall silent, but
    ``status`` goes on.  So they do, and ``points`` too, while lengths are in an arbitrary unit,
    unless ``any_unit``.  All carry the stamp of the image.
    """

    wants_points = True

    def __init__(
        self,
        node: Node,
        T_base_rig: NDArray[np.float64],
        *,
        odom_frame: str,
        base_frame: str,
        any_unit: bool = False,
    ) -> None:
        self._T_base_rig = T_base_rig
        self._odom_frame = odom_frame
        self._base_frame = base_frame
        self._any_unit = any_unit
        self._odom = node.create_publisher(
            Odometry, "odom", runtime.RELIABLE, qos_overriding_options=runtime.overridable()
        )
        self._status = node.create_publisher(DiagnosticArray, "status", runtime.LATCHED)
        self._points = node.create_publisher(
            PointCloud2, "points", runtime.RELIABLE, qos_overriding_options=runtime.overridable()
        )
        self._tf = None if TFMessage is None else node.create_publisher(TFMessage, "/tf", 100)
        self.publish_tf = False
        self.last: OdometryResult | None = None
        self.last_pose: NDArray[np.float64] | None = None
        self._resets_before = 0

    def expect_another_pipeline(self) -> None:
        """Results of another pipeline follow, which counts its resets from zero."""
        self._resets_before = 0 if self.last is None else self.last.reset_counter

    @property
    def has_tf(self) -> bool:
        """Whether transforms can be published on this machine."""
        return self._tf is not None

    def on_result(self, result: OdometryResult) -> None:
        result = replace(result, reset_counter=result.reset_counter + self._resets_before)
        fields = None
        if self._may_be_told(result):
            fields = odometry_fields(
                result,
                self._T_base_rig,
                frame_id=self._odom_frame,
                child_frame_id=self._base_frame,
            )
        if fields is not None:
            self._odom.publish(conversions.odometry_to_msg(fields))
            if self.publish_tf and self._tf is not None:
                self._tf.publish(TFMessage(transforms=[conversions.transform_to_msg(fields)]))
            self.last_pose = result.T_world_rig
        self.last = result
        # Last, so that whoever waits for the status has been sent the rest.
        self._status.publish(conversions.diagnostics_to_msg(status_fields(result)))

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        told = self.last is not None and self._may_be_told(self.last)
        if told and self._points.get_subscription_count() > 0:
            fields = point_cloud_fields(
                stamp_ns, cloud, self._T_base_rig, frame_id=self._odom_frame
            )
            self._points.publish(conversions.point_cloud_to_msg(fields))

    def _may_be_told(self, result: OdometryResult) -> bool:
        return result.is_metric or self._any_unit
