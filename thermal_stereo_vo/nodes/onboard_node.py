"""The whole way from the images of two cameras to their motion in one process, for flight.

Images come from topics, from two frame grabbers or from a recording that plays them.  They take the
way of the replay: gate, flat field, rectification, odometry.  The newest pair wins; pairs that come
too fast are dropped and counted.  While the cameras correct themselves odom goes on with
predictions; while the odometry is lost, or its scale unknown, it is silent and status says why.
Images are published while somebody looks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from thermal_stereo_vo.core.camera_info import CameraInfoFields, calibration_from_pair
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import RadiometricFrame, RawFrame
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.calibration_urls import read_calibrations, read_rig
from thermal_stereo_vo.nodes.dense_publisher import DensePublisher
from thermal_stereo_vo.nodes.live_cameras import LiveCameras
from thermal_stereo_vo.nodes.onboard_config import TOPICS, OnboardNodeConfig
from thermal_stereo_vo.nodes.onboard_health import (
    GateLog,
    LatencyMeter,
    gate_health,
    gyro_fields,
    stage_fields,
)
from thermal_stereo_vo.nodes.pipeline_thread import PipelineThread
from thermal_stereo_vo.nodes.publisher import ResultPublisher
from thermal_stereo_vo.nodes.stereo_input import EYES, CalibrationInput, ImageInput
from thermal_stereo_vo.nodes.telemetry_input import TelemetryInput
from thermal_stereo_vo.nodes.view_publisher import ViewPublisher
from thermal_stereo_vo.nodes.vitals import ProcessLoad, Window
from thermal_stereo_vo.outputs.ros_fields import OK, WARN, DiagnosticFields, status_fields
from thermal_stereo_vo.pipeline import Pipeline
from thermal_stereo_vo.stereo.pairing import Pair
from thermal_stereo_vo.stereo_capture import CapturedPair

INERTIAL = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)


class OnboardNode(runtime.BaseNode[OnboardNodeConfig]):
    """Cameras, or ``left|right/image_raw``, to ``odom``, ``points`` and ``status``.

    With ``odometry.method: multispectral`` the cameras are ``visible`` and ``thermal``.
    """

    NAME = "onboard"
    CONFIG = OnboardNodeConfig
    TOPICS = """
        in   left/image_raw, right/image_raw      sensor_msgs/Image (mono8, mono16); source: topics
        in   left/camera_info, right/camera_info  sensor_msgs/CameraInfo of the stereo pair, unless
                                                  calibration files are given; source: topics
        in   status                               what the capture node says of the cameras
        in   imu                                  sensor_msgs/Imu, with odometry.gyro.enabled
        out  odom                                 nav_msgs/Odometry, silent while lost
        out  points                               sensor_msgs/PointCloud2 in odom_frame
        out  disparity                            stereo_msgs/DisparityImage, while somebody listens
        out  points2                              sensor_msgs/PointCloud2 in odom_frame: the dense
                                                  cloud, while somebody listens, silent while lost
        out  status                               diagnostic_msgs/DiagnosticArray, one per pair
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray, once a second:
                                                  latency, load, drops, gates, skew
        out  /tf                                  tf2_msgs/TFMessage, with publish_tf
        out  left/image_rect, right/image_rect    sensor_msgs/Image, while somebody listens
        out  view/left, view/matches              sensor_msgs/Image mono8 and bgr8, likewise
        out  left/image_raw, right/image_raw,     what the capture node publishes; not with
             left/camera_info, right/camera_info  source: topics
        srv  ~/reset                              std_srvs/Trigger: forget all images, keep the pose
        srv  ~/do_ffc, ~/inhibit_ffc,             those of the capture node; not with source: topics
             ~/open_shutter, ~/reconnect
        """
    LIVE = ("publish_tf",)

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
        clock = self.get_clock()
        self._latency = LatencyMeter(lambda: int(clock.now().nanoseconds), config.latency_window)
        self._gates = GateLog(self.get_logger())
        self._roles = config.roles
        self._views = ViewPublisher(self, self._roles)
        self._skew_ms = Window(config.latency_window)
        self._load = ProcessLoad()
        self._stages_ms: dict[str, float] = {}
        self._answered = 0
        self._imu_samples = 0
        self._arrival_s: dict[str, float | None] = dict.fromkeys(self._roles)
        self._dense = DensePublisher(self, config, self.fail)
        self._thread = PipelineThread(self, self._publisher, newest_only=not config.process_all)
        self._images: ImageInput | None = None
        self._cameras: LiveCameras | None = None
        self.create_service(Trigger, "~/reset", self._on_reset)
        if config.odometry.gyro.enabled:
            self.create_subscription(
                Imu, "imu", self._on_imu, INERTIAL, qos_overriding_options=runtime.overridable()
            )
        self.on_settings(config)
        if config.source == TOPICS:
            self._listen()
        else:
            self._capture()
        self.create_timer(1.0, self._watch_over, clock=runtime.steady_clock())

    # --- where images come from -------------------------------------------------------------------

    def _listen(self) -> None:
        config = self.config
        self._telemetry = TelemetryInput(self)
        self._images = ImageInput(
            self,
            "image_raw",
            config.pairing,
            config.process_all,
            self._on_received,
            self._thread.start_again,
            roles=self._roles,
        )
        self._opening = self.create_timer(0.1, self._open, clock=runtime.steady_clock())
        if self._roles != EYES:
            self._prepare(read_rig(config.rig_calibration, self._roles))
            self.watch_inputs(self._images.topics)
            return
        infos = read_calibrations(config)
        if len(infos) == 1:
            raise ConfigError("give both left_calibration and right_calibration, or neither")
        if infos:
            self._on_calibration(infos[LEFT], infos[RIGHT])
            self.watch_inputs(self._images.topics)
        else:
            self.watch_inputs(CalibrationInput(self, self._on_calibration).topics)

    def _open(self) -> None:
        """Ask for images as soon as they can be processed."""
        assert self._images is not None
        if not self._thread.is_ready:
            return
        self.watch_inputs(self._images.topics)
        if all(self.senders(topic) > 0 for topic in self._images.topics):
            self._images.open()
            self._opening.cancel()

    def _capture(self) -> None:
        if self._roles != EYES:
            raise ConfigError(
                f"the cameras {' and '.join(self._roles)} of the method "
                f"'{self.config.odometry.method}' come from topics: set source to {TOPICS}, or "
                "another odometry.method for a stereo pair"
            )
        self._cameras = LiveCameras(self, self.config, self._on_captured)
        infos = self._cameras.infos
        if len(infos) < len(EYES):
            raise ConfigError(
                "the cameras are not calibrated: set left_calibration and right_calibration to the "
                "camera_info files of the stereo pair"
            )
        self._on_calibration(infos[LEFT], infos[RIGHT])
        self._cameras.start()

    def _on_calibration(self, left: CameraInfoFields, right: CameraInfoFields) -> None:
        calibration = calibration_from_pair(left, right, origin="in camera_info")
        calibration.check_stereo()
        self._prepare(calibration)

    def _prepare(self, calibration: RigCalibration) -> None:
        self.problem = ""
        self._thread.prepare(
            self.config.pipeline,
            replace(calibration, T_base_rig=self.config.mount.T_base_rig),
            (self._latency, self._gates, self._views, self._dense),
        )

    # --- from images to results -------------------------------------------------------------------

    def _on_received(self, pair: Pair[RadiometricFrame]) -> None:
        self._submit(Pair(self._raw(pair.first), self._raw(pair.second)), pair.skew_ns)

    def _raw(self, received: RadiometricFrame | None) -> RawFrame | None:
        if received is None or received.image is None:
            return None
        eye, stamp_ns = received.camera, received.stamp_ns
        telemetry = self._telemetry.at(eye, stamp_ns)
        return RawFrame(received.image, stamp_ns, eye, received.sequence, telemetry)

    def _on_captured(self, pair: CapturedPair) -> None:
        if self._thread.is_ready:
            raw = Pair(pair.frames.get(LEFT), pair.frames.get(RIGHT))
            self._submit(raw, pair.skew_ns)

    def _submit(self, pair: Pair[RawFrame], skew_ns: int) -> None:
        now_s = time.monotonic()
        for raw in (pair.first, pair.second):
            if raw is not None:
                self._arrival_s[raw.camera] = now_s
        if pair.first is not None and pair.second is not None:
            self._skew_ms.add(skew_ns * 1e-6)
        self._thread.feed(partial(self._process, pair), frame=True)

    def _process(self, pair: Pair[RawFrame], pipeline: Pipeline) -> None:
        if pipeline.push_pair(pair) is not None:
            self._answered += 1
        self._stages_ms = pipeline.take_stage_ms()
        self.problem = ""

    def _on_imu(self, message: Imu) -> None:
        sample = conversions.imu_from_msg(message)
        if sample is not None and self._thread.is_ready:
            self._imu_samples += 1
            self._thread.feed(partial(_push_imu, sample))

    # --- starting again, settings, the end --------------------------------------------------------

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._thread.start_again("asked for by service")
        response.success = True
        response.message = "the odometry starts again with the next pair, from its last pose"
        return response

    def on_clock_jump_back(self, jump_s: float) -> None:
        if self._images is not None:
            self._images.restart()
        self._thread.start_again(f"the clock went back by {-jump_s:.3f} s")

    def on_settings(self, config: OnboardNodeConfig) -> None:
        if config.publish_tf and not self._publisher.has_tf:
            self.get_logger().error("publish_tf needs the package tf2_msgs, which is not installed")
        self._publisher.publish_tf = config.publish_tf

    def close(self) -> None:
        if self._cameras is not None:
            self._cameras.close()
        self._thread.close()
        self._dense.stop()

    # --- health -----------------------------------------------------------------------------------

    def _watch_over(self) -> None:
        """Once a second: streams that have died."""
        now_s = time.monotonic()
        for eye, arrival_s in self._arrival_s.items():
            if arrival_s is not None:
                self._thread.feed(partial(_check_silence, eye, now_s - arrival_s))

    def health(self) -> DiagnosticFields:
        values = [
            *self._thread.counters(),
            ("pairs_answered", str(self._answered)),
            *self._latency.fields(),
            *self._load.fields(),
            *self._skew_ms.fields("skew_ms", 50, 95, 100),
            *self._gates.fields(),
            *self._dense.counters(),
            *stage_fields(self._stages_ms),
        ]
        stamp_ns, level, messages = 0, OK, []
        last, pipeline = self._publisher.last, self._thread.pipeline
        if last is not None:
            of_last = status_fields(last, name=self.NAME)
            stamp_ns, level = of_last.stamp_ns, of_last.level
            messages.append(of_last.message)
            values = [*of_last.values, *values]
        elif pipeline is None:
            level = WARN
            messages.append("waiting for the calibration and the kernels")
        else:
            messages.append("ready for images")
        if pipeline is not None:
            for fields in gate_health(pipeline):
                level = max(level, fields.level)
                messages += [fields.message] if fields.level > OK else []
                values += fields.values
            values += gyro_fields(pipeline, self._imu_samples)
        if self._images is not None:
            values += self._images.counters()
        if self._cameras is not None:
            fields = self._cameras.health()
            level = max(level, fields.level)
            messages.append(f"cameras: {fields.message}")
            values += [(f"camera_{key}", value) for key, value in fields.values]
        return DiagnosticFields(stamp_ns, level, self.NAME, "; ".join(messages), tuple(values))


def _push_imu(sample: ImuSample, pipeline: Pipeline) -> None:
    pipeline.push_imu(sample)


def _check_silence(eye: str, silence_s: float, pipeline: Pipeline) -> None:
    pipeline.front_ends[eye].check(silence_s)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(OnboardNode, args)


if __name__ == "__main__":
    sys.exit(main())
