"""Images of a pipeline for people and for other stages, made only while somebody looks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.snapshot import draw_points, with_display
from thermal_stereo_vo.radiometry.agc import AutomaticGain

MATCHES = "view/matches"


class ViewPublisher(Observer):
    """``<role>/image_rect`` of both cameras, ``view/<first>`` (8 bits), ``view/matches`` (colour).

    Of two eyes the last shows the points with their parallax, of other rigs with their depth.

    Published after the result of the frame, so that nobody waits for a picture.
    """

    wants_points = True

    def __init__(self, node: Node, roles: tuple[str, str] = EYES) -> None:
        self._roles = roles
        self._rectified = {role: f"{role}/image_rect" for role in roles}
        self._view = f"view/{roles[0]}"
        self._gain = AutomaticGain()
        self._out = {
            topic: node.create_publisher(
                Image, topic, runtime.IMAGES_OUT, qos_overriding_options=runtime.overridable()
            )
            for topic in (*self._rectified.values(), self._view, MATCHES)
        }
        self._frame: RigFrame | None = None
        self._T_world_rig: NDArray[np.float64] | None = None

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._frame = frame

    def on_result(self, result: OdometryResult) -> None:
        self._T_world_rig = result.T_world_rig
        frame = self._frame
        if frame is None:
            return
        for eye, topic in self._rectified.items():
            if eye in frame.views and self._wanted(topic):
                self._send(topic, eye, frame.stamp_ns, frame.views[eye].image)
        first = self._roles[0]
        if first in frame.views and self._wanted(self._view):
            shown = with_display(frame, self._gain).views[first].display
            if shown is not None:
                self._send(self._view, first, frame.stamp_ns, shown)

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        frame, T_world_rig = self._frame, self._T_world_rig
        if frame is None or T_world_rig is None or not self._wanted(MATCHES):
            return
        picture = draw_points(with_display(frame, self._gain), self._roles, T_world_rig, cloud)
        if picture is not None:
            self._out[MATCHES].publish(
                conversions.picture_to_msg(picture, stamp_ns, f"{self._roles[0]}_optical")
            )

    def _wanted(self, topic: str) -> bool:
        return bool(self._out[topic].get_subscription_count() > 0)

    def _send(self, topic: str, eye: str, stamp_ns: int, image: NDArray[np.generic]) -> None:
        self._out[topic].publish(conversions.image_to_msg(image, stamp_ns, f"{eye}_optical"))
