"""Estimates the motion of a camera rig from rectified images.

The projection matrices in ``camera_info`` are the calibration (names as in ``stereo_image_proc``);
where a visible camera is from a thermal one, ``rig_calibration`` says (``visible|thermal/...`` are
then the topics).
First comes the calibration, then the kernels are compiled, then images are asked for.  While the
odometry is lost ``odom`` is silent and ``status`` says why.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial

from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from thermal_stereo_vo.core.camera_info import (
    CameraInfoFields,
    calibration_from_pair,
    undistorted_rig,
)
from thermal_stereo_vo.core.frames import RadiometricFrame
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.calibration_urls import read_rig
from thermal_stereo_vo.nodes.dense_publisher import DensePublisher
from thermal_stereo_vo.nodes.pipeline_thread import PipelineThread
from thermal_stereo_vo.nodes.publisher import ResultPublisher
from thermal_stereo_vo.nodes.stereo_input import EYES, CalibrationInput, ImageInput
from thermal_stereo_vo.nodes.stereo_odometry_config import StereoOdometryNodeConfig
from thermal_stereo_vo.outputs.ros_fields import OK, WARN, DiagnosticFields, status_fields
from thermal_stereo_vo.pipeline import Pipeline
from thermal_stereo_vo.stereo.pairing import Pair


class StereoOdometryNode(runtime.BaseNode[StereoOdometryNodeConfig]):
    """``left|right/image_rect`` to ``odom``, ``points`` and ``status``."""

    NAME = "stereo_odometry"
    CONFIG = StereoOdometryNodeConfig
    TOPICS = """
        in   left/image_rect, right/image_rect    sensor_msgs/Image (mono8, mono16)
        in   left/camera_info, right/camera_info  sensor_msgs/CameraInfo; P is used
        in   left/mask, right/mask                sensor_msgs/Image mono8, 255 = usable; optional
        in   status                               what thermal_correction says; with gated
        out  odom                                 nav_msgs/Odometry, silent while lost
                                                  or while the scale is unknown
        out  points                               sensor_msgs/PointCloud2 in odom_frame
        out  disparity                            stereo_msgs/DisparityImage, while somebody listens
        out  points2                              sensor_msgs/PointCloud2 in odom_frame: the dense
                                                  cloud, while somebody listens, silent while lost
        out  status                               diagnostic_msgs/DiagnosticArray, one per pair
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray, once a second
        out  /tf                                  tf2_msgs/TFMessage, with publish_tf
        srv  ~/reset                              std_srvs/Trigger: forget all images, keep the pose
        """
    LIVE = ("pairing.tolerance_ms", "pairing.max_waiting", "publish_tf")

    def __init__(self) -> None:
        super().__init__()
        config = self.config
        self._publisher = ResultPublisher(
            self,
            config.mount.T_base_rig,
            odom_frame=config.odom_frame,
            base_frame=config.base_frame,
            any_unit=config.odom_before_scale,
        )
        self._dense = DensePublisher(self, config, self.fail)
        self._thread = PipelineThread(self, self._publisher, newest_only=not config.process_all)
        self._images = ImageInput(
            self,
            "image_rect",
            config.pairing,
            config.process_all,
            self._on_pair,
            self._thread.start_again,
            gated=config.gated,
            roles=config.roles,
        )
        for eye in config.roles:
            self.create_subscription(
                Image, f"{eye}/mask", partial(self._on_mask, eye), runtime.LATCHED
            )
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.on_settings(config)
        calibration = CalibrationInput(self, self._on_calibration, config.roles)
        self.watch_inputs(calibration.topics)
        self._opening = self.create_timer(0.1, self._open, clock=runtime.steady_clock())

    def _on_calibration(self, left: CameraInfoFields, right: CameraInfoFields) -> None:
        if self.config.roles == EYES:
            calibration = calibration_from_pair(
                left, right, rectified=True, origin="in camera_info"
            )
            calibration.check_stereo()
        else:
            rig = read_rig(self.config.rig_calibration, self.config.roles)
            infos = dict(zip(self.config.roles, (left, right), strict=True))
            calibration = undistorted_rig(rig, infos)
        self.problem = ""
        self._thread.prepare(self.config.pipeline, calibration, (self._dense,))

    def _open(self) -> None:
        """Ask for images as soon as nothing else is missing."""
        if not self._thread.is_ready:
            return
        self.watch_inputs(self._images.topics)
        if all(self.senders(topic) > 0 for topic in self._images.topics) and all(
            eye in self._images.masks or self.senders(f"{eye}/mask") == 0
            for eye in self.config.roles
        ):
            self._images.open()
            self._opening.cancel()

    def _on_mask(self, eye: str, message: Image) -> None:
        mask = conversions.mask_from_msg(message)
        self._images.masks[eye] = None if mask.all() else mask

    def _on_pair(self, pair: Pair[RadiometricFrame]) -> None:
        self._thread.feed(partial(self._process, pair), frame=True)

    def _process(self, pair: Pair[RadiometricFrame], pipeline: Pipeline) -> None:
        pipeline.process(pair)
        self.problem = ""

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._thread.start_again("asked for by service")
        response.success = True
        response.message = "the odometry starts again with the next pair, from its last pose"
        return response

    def on_clock_jump_back(self, jump_s: float) -> None:
        self._images.restart()
        self._thread.start_again(f"the clock went back by {-jump_s:.3f} s")

    def on_settings(self, config: StereoOdometryNodeConfig) -> None:
        if config.publish_tf and not self._publisher.has_tf:
            self.get_logger().error("publish_tf needs the package tf2_msgs, which is not installed")
        self._publisher.publish_tf = config.publish_tf
        self._images.restart(config.pairing)

    def close(self) -> None:
        self._thread.close()
        self._dense.stop()

    def health(self) -> DiagnosticFields:
        last = self._publisher.last
        counters = (
            *self._images.counters(),
            *self._thread.counters(),
            *self._dense.counters(),
        )
        if last is not None:
            of_last = status_fields(last, name=self.NAME)
            values = (*of_last.values, *counters)
            return DiagnosticFields(
                last.stamp_ns, of_last.level, self.NAME, of_last.message, values
            )
        if not self._thread.is_ready:
            return DiagnosticFields(
                0, WARN, self.NAME, "waiting for the calibration and the kernels", counters
            )
        return DiagnosticFields(0, OK, self.NAME, "ready for images", counters)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(StereoOdometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
