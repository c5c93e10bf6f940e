"""Images of a pipeline for people and for other stages, made only while somebody looks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from thermal_stereo_vo.core.cameras import LEFT
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.snapshot import draw_matches

RECTIFIED = {eye: f"{eye}/image_rect" for eye in EYES}
VIEW, MATCHES = "view/left", "view/matches"


class ViewPublisher(Observer):
    """``left|right/image_rect``, ``view/left`` (8 bits) and ``view/matches`` (colour).

    Published after the result of the frame, so that nobody waits for a picture.
    """

    wants_points = True

    def __init__(self, node: Node) -> None:
        self._out = {
            topic: node.create_publisher(
                Image, topic, runtime.IMAGES_OUT, qos_overriding_options=runtime.overridable()
            )
            for topic in (*RECTIFIED.values(), VIEW, MATCHES)
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
        for eye, topic in RECTIFIED.items():
            if eye in frame.views and self._wanted(topic):
                self._send(topic, eye, frame.stamp_ns, frame.views[eye].image)
        left = frame.views.get(LEFT)
        if left is not None and left.display is not None and self._wanted(VIEW):
            self._send(VIEW, LEFT, frame.stamp_ns, left.display)

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        frame, T_world_rig = self._frame, self._T_world_rig
        if frame is None or T_world_rig is None or not self._wanted(MATCHES):
            return
        if all(eye in frame.views and frame.views[eye].display is not None for eye in EYES):
            picture = draw_matches(frame, T_world_rig, cloud)
            self._out[MATCHES].publish(
                conversions.picture_to_msg(picture, stamp_ns, f"{LEFT}_optical")
            )

    def _wanted(self, topic: str) -> bool:
        return bool(self._out[topic].get_subscription_count() > 0)

    def _send(self, topic: str, eye: str, stamp_ns: int, image: NDArray[np.generic]) -> None:
        self._out[topic].publish(conversions.image_to_msg(image, stamp_ns, f"{eye}_optical"))
