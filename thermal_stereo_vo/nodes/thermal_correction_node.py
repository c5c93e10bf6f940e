"""Judges and corrects the raw images of both cameras: linear counts the odometry may use.

Images that do not show the scene (shutter, freeze, damage) are held back; status tells of every
image, held back or not, with its own stamp.  Images are asked for while somebody listens to both
outputs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import ThermalStereoError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES
from thermal_stereo_vo.nodes.telemetry_input import TelemetryInput
from thermal_stereo_vo.outputs.gate_fields import gate_fields
from thermal_stereo_vo.outputs.ros_fields import (
    ERROR,
    OK,
    WARN,
    DiagnosticFields,
)
from thermal_stereo_vo.radiometry.flat_field_recorder import FlatFieldRecorder
from thermal_stereo_vo.radiometry.front_end import FrontEndConfig, ThermalFrontEnd
from thermal_stereo_vo.radiometry.gate import GateEvent, GateState


@dataclass(frozen=True)
class ThermalCorrectionNodeConfig:
    """Settings of the node."""

    front_end: FrontEndConfig = group(FrontEndConfig, "From raw to linear counts.")
    process_all: bool = setting(
        False,
        "Ask for every image, reliably and in order (recordings), in place of the newest (flight).",
    )
    capture_node: str = setting(
        "stereo_capture", "Node that owns the cameras and their corrections."
    )
    inhibit_limit_s: float = setting(
        60.0,
        "An inhibition of corrections ends after this unless it is asked for again.",
        unit="s",
        minimum=1.0,
        maximum=3600.0,
    )
    flat_field_folder: str = setting(
        "flat_fields", "Folder that recorded views of uniform sources go to."
    )
    flat_field_frames: int = setting(
        32, "Images that make one view of a uniform source.", minimum=1, maximum=10_000
    )


class ThermalCorrectionNode(runtime.BaseNode[ThermalCorrectionNodeConfig]):
    """``left|right/image_raw`` to ``left|right/image_corrected``."""

    NAME = "thermal_correction"
    CONFIG = ThermalCorrectionNodeConfig
    TOPICS = """
        in   left/image_raw, right/image_raw   sensor_msgs/Image (mono8, mono16)
        in   status                            diagnostic_msgs/DiagnosticArray: FPA temperatures
        out  left/image_corrected, right/...   sensor_msgs/Image, linear counts of the same type
        out  status                            diagnostic_msgs/DiagnosticArray of each image: gate,
                                               epoch, gap, flat field
        out  /diagnostics                      diagnostic_msgs/DiagnosticArray, once a second
        srv  ~/do_ffc                          std_srvs/Trigger: correct the flat field soon
        srv  ~/inhibit_ffc                     std_srvs/SetBool: no corrections for a while
        srv  ~/record_flat_field               std_srvs/Trigger: record a view of a uniform source
        """

    def __init__(self) -> None:
        super().__init__()
        self._front_ends = {
            eye: ThermalFrontEnd(self.config.front_end, eye, self._on_event) for eye in EYES
        }
        self._front_ends[EYES[0]].warm_up()
        self._guard = runtime.StampGuard()
        self._recorders: dict[str, FlatFieldRecorder] = {}
        self._received = dict.fromkeys(EYES, 0)
        self._held_back = dict.fromkeys(EYES, 0)
        self._arrival_s = dict.fromkeys(EYES, 0.0)
        self._stamp_ns = 0
        self._inhibited_until_s: float | None = None
        self._subscriptions_to_images: list[Any] = []
        self._topics = [f"{eye}/image_raw" for eye in EYES]
        self._status = self.create_publisher(DiagnosticArray, "status", runtime.IMAGES_ALL)
        self._out = {
            eye: self.create_publisher(
                Image,
                f"{eye}/image_corrected",
                runtime.IMAGES_ALL if self.config.process_all else runtime.IMAGES_OUT,
                qos_overriding_options=runtime.overridable(),
            )
            for eye in EYES
        }
        self._telemetry = TelemetryInput(self)
        capture = self.config.capture_node
        self._do_ffc = self.create_client(Trigger, f"{capture}/do_ffc")
        self._inhibit_ffc = self.create_client(SetBool, f"{capture}/inhibit_ffc")
        self.create_service(Trigger, "~/do_ffc", self._on_do_ffc)
        self.create_service(SetBool, "~/inhibit_ffc", self._on_inhibit_ffc)
        self.create_service(Trigger, "~/record_flat_field", self._on_record)
        self.create_timer(0.1, self._follow_listeners, clock=runtime.steady_clock())
        self.create_timer(1.0, self._watch_over, clock=runtime.steady_clock())

    def _follow_listeners(self) -> None:
        listeners = all(self._out[eye].get_subscription_count() > 0 for eye in EYES)
        wanted = listeners or bool(self._recorders)
        if wanted and not self._subscriptions_to_images:
            qos = runtime.IMAGES_ALL if self.config.process_all else runtime.IMAGES_NEWEST
            self._subscriptions_to_images = [
                self.create_subscription(
                    Image,
                    topic,
                    partial(self._on_image, eye, topic),
                    qos,
                    qos_overriding_options=runtime.overridable(),
                )
                for eye, topic in zip(EYES, self._topics, strict=True)
            ]
            self.watch_inputs(self._topics)
        elif not wanted and self._subscriptions_to_images:
            for subscription in self._subscriptions_to_images:
                self.destroy_subscription(subscription)
            self._subscriptions_to_images = []
            self._start_again()
            self.watch_inputs([])

    def _on_image(self, eye: str, topic: str, message: Image) -> None:
        self.saw(topic)
        stamp_ns = conversions.stamp_from_msg(message.header.stamp)
        order = self._guard.check(eye, stamp_ns)
        if order is runtime.StampOrder.REPEATED:
            return
        if order is runtime.StampOrder.BACK:
            self._start_again()
            self.get_logger().warning(
                f"the stamps of {self.resolve_topic_name(topic)} went back, the gates start again: "
                "a recording started anew, or two senders publish on the topic"
            )
        self._arrival_s[eye] = time.monotonic()
        try:
            image = conversions.image_from_msg(message)
            telemetry = self._telemetry.at(eye, stamp_ns)
            raw = RawFrame(image, stamp_ns, eye, self._received[eye], telemetry)
            self._received[eye] += 1
            self._process(eye, raw, message.header.frame_id)
            self._record(eye, raw)
            self.problem = ""
        except ThermalStereoError as error:
            self.refuse(error)

    def _process(self, eye: str, raw: RawFrame, frame_id: str) -> None:
        front_end = self._front_ends[eye]
        frame = front_end.process(raw)
        if frame is None:
            return
        self._stamp_ns = frame.stamp_ns
        if frame.image is None:
            self._held_back[eye] += 1
        else:
            self._out[eye].publish(conversions.image_to_msg(frame.image, frame.stamp_ns, frame_id))
        fields = gate_fields(frame, front_end.decision, front_end.flat_field_status)
        self._status.publish(conversions.diagnostics_to_msg(fields))

    def _record(self, eye: str, raw: RawFrame) -> None:
        """Images that cannot be used, as before the first temperature, do not end a recording."""
        recorder = self._recorders.get(eye)
        path = None if recorder is None else recorder.add(raw)
        if path is not None:
            del self._recorders[eye]
            self.get_logger().info(f"recorded a view of a uniform source: {path}")

    def _on_event(self, event: GateEvent) -> None:
        # Two lines, as rclpy ties a line of code to one severity.
        if event.ongoing:
            self.get_logger().error(str(event))
        else:
            self.get_logger().info(str(event))

    def _watch_over(self) -> None:
        """Once a second: streams that have died, and inhibitions that were forgotten."""
        now_s = time.monotonic()
        for eye, front_end in self._front_ends.items():
            if self._subscriptions_to_images and self._arrival_s[eye] > 0.0:
                front_end.check(now_s - self._arrival_s[eye])
        if self._inhibited_until_s is None:
            return
        if now_s < self._inhibited_until_s:
            self._inhibit(True)  # the owner of the cameras has a limit of its own
            return
        self._inhibited_until_s = None
        self._inhibit(False)
        self.get_logger().warning(
            f"corrections are allowed again after {self.config.inhibit_limit_s:g} s: call "
            "inhibit_ffc again to go on without"
        )

    def _inhibit(self, inhibit: bool) -> None:
        self._inhibit_ffc.call_async(SetBool.Request(data=inhibit))

    def _on_do_ffc(self, request: Any, response: Any) -> Any:
        if not self._has_owner(self._do_ffc, response):
            return response
        self._do_ffc.call_async(Trigger.Request())
        response.success, response.message = True, f"passed on to {self._do_ffc.srv_name}"
        return response

    def _on_inhibit_ffc(self, request: Any, response: Any) -> Any:
        if not self._has_owner(self._inhibit_ffc, response):
            return response
        self._inhibit(bool(request.data))
        limit_s = self.config.inhibit_limit_s
        self._inhibited_until_s = time.monotonic() + limit_s if request.data else None
        response.success = True
        response.message = (
            f"no corrections for {limit_s:g} s" if request.data else "corrections are allowed"
        )
        return response

    def _has_owner(self, client: Any, response: Any) -> bool:
        if client.service_is_ready():
            return True
        response.success = False
        response.message = (
            f"nobody offers {client.srv_name}: start the capture node, or name it in capture_node"
        )
        return False

    def _on_record(self, request: Any, response: Any) -> Any:
        config = self.config
        serials = self._front_ends[EYES[0]].serials
        self._recorders = {
            eye: FlatFieldRecorder(
                config.flat_field_folder, eye, serials.get(eye, ""), config.flat_field_frames
            )
            for eye in EYES
        }
        response.success = True
        response.message = (
            f"recording {config.flat_field_frames} images of each camera into "
            f"{config.flat_field_folder}"
        )
        return response

    def _start_again(self) -> None:
        for front_end in self._front_ends.values():
            front_end.reset()
        self._guard.forget()
        self._arrival_s = dict.fromkeys(EYES, 0.0)

    def on_clock_jump_back(self, jump_s: float) -> None:
        self._start_again()

    def health(self) -> DiagnosticFields:
        level, messages = OK, []
        for eye, front_end in self._front_ends.items():
            status = front_end.flat_field_status
            if front_end.gate.state is GateState.FAULT:
                level = ERROR
                messages.append(f"{eye} is blind: stuck shutter or dead stream")
            elif status is not None and not status.ok and self._received[eye]:
                level = max(level, WARN)
                messages.append(f"{eye}: {status.text}")
        if not self._subscriptions_to_images:
            messages.append("idle: nobody listens to both outputs")
        for eye, recorder in self._recorders.items():
            messages.append(f"recording a flat field of {eye}, {recorder.missing} images to go")
        values = [("ffc_inhibited", str(self._inhibited_until_s is not None).lower())]
        for eye, front_end in self._front_ends.items():
            values += [
                (f"{eye}_received", str(self._received[eye])),
                (f"{eye}_held_back", str(self._held_back[eye])),
                (f"{eye}_gate", front_end.gate.state.value),
                (f"{eye}_corrections", str(front_end.gate.epoch)),
            ]
        return DiagnosticFields(
            self._stamp_ns, level, self.NAME, "; ".join(messages) or "correcting", tuple(values)
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(ThermalCorrectionNode, args)


if __name__ == "__main__":
    sys.exit(main())
