"""Plays a recording or a simulated run onto the topics of the cameras, with ``/clock``.

It waits until both images have a subscriber, so that nothing is lost at the start.  At rate 0 it
goes as fast as the odometry allows: a pair is sent when ``status`` has answered the pairs before.
The node ends with the recording.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from thermal_stereo_vo.core.camera_info import CameraInfoFields, infos_from_calibration
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import ConfigError, DatasetError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset, require_calibration
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES, patient
from thermal_stereo_vo.outputs.gate_fields import report_from_fields
from thermal_stereo_vo.outputs.ros_fields import OK, DiagnosticFields
from thermal_stereo_vo.stereo.pairing import PairingConfig, StereoPairer
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

SILENCE_S = 60.0
"""Longest wait for an answer at rate 0; the first pair of a cold start may compile kernels."""
CLOCK_PERIOD_S = 0.01
INFO_PERIOD_S = 0.5


@dataclass(frozen=True)
class ReplayNodeConfig:
    """Settings of the node."""

    source: str = setting(
        "",
        "Recording to play: a rosbag, a KITTI or EuRoC folder, a folder with left/ and right/ or "
        "visible/ and thermal/, or sim:PRESET.",
    )
    calibration: str = setting("", "Calibration in place of the recording's own; empty for none.")
    left_topic: str = setting("", "Image topic of the left eye in a bag; empty to choose.")
    right_topic: str = setting("", "Image topic of the right eye in a bag; empty to choose.")
    visible_topic: str = setting("", "Image topic of a visible camera; empty to choose.")
    thermal_topic: str = setting("", "Image topic of the thermal one beside it; empty to choose.")
    rectification: RectificationConfig = group(
        RectificationConfig, "For a calibration that brings no R and P."
    )
    rate: float = setting(
        1.0,
        "Speed against the recorded one; 0 is as fast as the odometry answers.",
        minimum=0.0,
        maximum=100.0,
    )
    in_flight: int = setting(4, "Pairs on their way at rate 0.", minimum=1, maximum=40)
    pairing: PairingConfig = group(
        PairingConfig,
        "As in the nodes that listen: which images make a pair to wait for at rate 0.",
    )
    subscribers: int = setting(
        1, "Subscribers that each image must have before the start.", minimum=0, maximum=10
    )


class ReplayNode(runtime.BaseNode[ReplayNodeConfig]):
    """A recording as a pair of cameras: ``left`` and ``right``, or ``visible`` and ``thermal``."""

    NAME = "replay"
    CONFIG = ReplayNodeConfig
    TOPICS = """
        out  left/image_raw, right/image_raw      sensor_msgs/Image (mono8, mono16)
        out  left/camera_info, right/camera_info  sensor_msgs/CameraInfo, K, D, R and P
        out  /clock                               rosgraph_msgs/Clock
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray
        in   status                               diagnostic_msgs/DiagnosticArray, at rate 0
        """

    def __init__(self) -> None:
        super().__init__()
        self._dataset, self._infos = self._open()
        self._roles = tuple(self._infos)
        self._sent = 0
        self._stamp_ns = 0
        # Pairs as the listeners will make them, so that no answer is awaited that cannot come.
        self._pairer: StereoPairer[RawFrame] = StereoPairer(patient(self.config.pairing))
        self._unanswered: deque[int] = deque()
        self._answer = threading.Condition()
        self._closing = threading.Event()
        self._clock_out = self.create_publisher(Clock, "/clock", runtime.RELIABLE)
        self._info_out = {
            eye: self.create_publisher(CameraInfo, f"{eye}/camera_info", runtime.RELIABLE)
            for eye in self._roles
        }
        self._image_out = {
            eye: self.create_publisher(
                Image,
                f"{eye}/image_raw",
                runtime.IMAGES_ALL,
                qos_overriding_options=runtime.overridable(),
            )
            for eye in self._roles
        }
        self.create_subscription(DiagnosticArray, "status", self._on_status, runtime.RELIABLE)
        self._player = threading.Thread(target=self._play, name="player", daemon=True)
        self._player.start()

    def _open(self) -> tuple[Dataset, dict[str, CameraInfoFields]]:
        config = self.config
        if not config.source:
            raise ConfigError("no recording to play: give one with -p source:=PATH")
        options = SourceOptions(
            left_topic=config.left_topic or None,
            right_topic=config.right_topic or None,
            visible_topic=config.visible_topic or None,
            thermal_topic=config.thermal_topic or None,
            calibration=Path(config.calibration) if config.calibration else None,
        )
        dataset, reason = open_dataset(config.source, options)
        self.get_logger().info(f"{config.source}: {reason}")
        calibration = require_calibration(dataset)
        if dataset.cameras == EYES:
            calibration, _ = with_rectification(calibration, config.rectification)
        used = {role: calibration[role] for role in dataset.cameras}
        return dataset, infos_from_calibration(replace(calibration, cameras=used))

    def _play(self) -> None:
        try:
            self._wait_for_subscribers()
            start_s = time.monotonic()
            first_ns: int | None = None
            for frame in self._dataset.frames():
                if frame.camera not in self._roles:
                    continue
                first_ns = frame.stamp_ns if first_ns is None else first_ns
                if self.config.rate > 0:
                    self._wait_until_due(start_s, first_ns, frame.stamp_ns)
                else:
                    self._wait_for_answers(self.config.in_flight - 1)
                if self._closing.is_set():
                    return
                self._send(frame)
            if self.config.rate == 0:
                self._wait_for_answers(0)
            for publisher in (*self._image_out.values(), self._clock_out):
                publisher.wait_for_all_acked(Duration(seconds=5))
            self.get_logger().info(
                f"played {self._sent} images in {time.monotonic() - start_s:.1f} s"
            )
            self.context.try_shutdown()
        except Exception as error:
            self.fail(error)

    def _wait_for_subscribers(self) -> None:
        """The calibration goes out meanwhile, as some ask for images only when they have it."""
        while not self._closing.is_set():
            for eye in self._roles:
                self._send_info(eye, self._stamp_ns)
            wanted = self.config.subscribers
            if all(self._image_out[eye].get_subscription_count() >= wanted for eye in self._roles):
                return
            self._closing.wait(INFO_PERIOD_S)

    def _wait_until_due(self, start_s: float, first_ns: int, stamp_ns: int) -> None:
        rate = self.config.rate
        while not self._closing.is_set():
            now_ns = first_ns + round((time.monotonic() - start_s) * rate * 1e9)
            self._tell_time(min(now_ns, stamp_ns))
            if now_ns >= stamp_ns:
                return
            self._closing.wait(min(CLOCK_PERIOD_S, (stamp_ns - now_ns) * 1e-9 / rate))

    def _wait_for_answers(self, allowed: int) -> None:
        def progress() -> bool:
            return len(self._unanswered) < before or self._closing.is_set()

        with self._answer:
            while len(self._unanswered) > allowed and not self._closing.is_set():
                before = len(self._unanswered)
                if not self._answer.wait_for(progress, SILENCE_S):
                    raise DatasetError(
                        f"no answer on {self.resolve_topic_name('status')} for {SILENCE_S:.0f} s "
                        f"after the pair at {self._unanswered[0]} ns: is the odometry running with "
                        "process_all? rate 0 needs it; else choose a rate above 0"
                    )

    def _send(self, frame: RawFrame) -> None:
        eye = frame.camera
        if self.config.rate == 0:
            self._tell_time(frame.stamp_ns)
            pairs = list(self._pairer.push(self._roles.index(eye), frame))
            with self._answer:
                self._unanswered.extend(pair.stamp_ns for pair in pairs)
        self._send_info(eye, frame.stamp_ns)
        self._image_out[eye].publish(
            conversions.image_to_msg(frame.image, frame.stamp_ns, f"{eye}_optical")
        )
        self._stamp_ns = frame.stamp_ns
        self._sent += 1

    def _send_info(self, eye: str, stamp_ns: int) -> None:
        self._info_out[eye].publish(
            conversions.camera_info_to_msg(self._infos[eye], stamp_ns, f"{eye}_optical")
        )

    def _tell_time(self, stamp_ns: int) -> None:
        self._clock_out.publish(conversions.clock_to_msg(stamp_ns))

    def _on_status(self, message: DiagnosticArray) -> None:
        if any(map(report_from_fields, conversions.diagnostics_from_msg(message))):
            return  # that of the correction, which comes long before the odometry's
        answered_ns = conversions.stamp_from_msg(message.header.stamp)
        with self._answer:
            while self._unanswered and self._unanswered[0] <= answered_ns:
                self._unanswered.popleft()
            self._answer.notify()

    def close(self) -> None:
        self._closing.set()
        with self._answer:
            self._answer.notify()
        if self._player is not threading.current_thread():
            self._player.join()

    def health(self) -> DiagnosticFields:
        total = self._dataset.instants()
        return DiagnosticFields(
            self._stamp_ns,
            OK,
            self.NAME,
            "playing" if self._sent else "waiting for subscribers to both images",
            (
                ("images_sent", str(self._sent)),
                ("pairs_recorded", "unknown" if total is None else str(total)),
                ("pairs_unanswered", str(len(self._unanswered))),
            ),
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(ReplayNode, args)


if __name__ == "__main__":
    sys.exit(main())
