"""A live stereo capture inside a node: topics while somebody listens, services, health."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool, Trigger

from thermal_stereo_vo.core.camera_info import CameraInfoFields, infos_from_calibration
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import CaptureError
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.calibration_urls import check_size, read_calibrations
from thermal_stereo_vo.outputs.ros_fields import DiagnosticFields
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification
from thermal_stereo_vo.stereo_capture import (
    EYES,
    CapturedPair,
    StereoCaptureConfig,
    open_stereo_capture,
)
from thermal_stereo_vo.stereo_capture_report import HealthReport, pair_fields


class LiveCameras:
    """Reads pairs on a thread of its own, hands each to ``on_pair`` and publishes it.

    ``infos`` is what ``camera_info`` says, by eye; nothing where nobody knows.
    """

    def __init__(
        self,
        node: runtime.BaseNode[Any],
        config: StereoCaptureConfig,
        on_pair: Callable[[CapturedPair], None] = lambda pair: None,
    ) -> None:
        self._node = node
        self._on_pair = on_pair
        self._inhibit_limit_s = config.grabbers.ffc.inhibit_limit_s
        self._capture, recorded = open_stereo_capture(config)
        self.infos = _infos(config, recorded)
        self._health = HealthReport()
        self._stamp_ns = 0
        self._images = {
            eye: node.create_publisher(
                Image,
                f"{eye}/image_raw",
                runtime.IMAGES_OUT,
                qos_overriding_options=runtime.overridable(),
            )
            for eye in EYES
        }
        self._info_out = {
            eye: node.create_publisher(CameraInfo, f"{eye}/camera_info", runtime.RELIABLE)
            for eye in EYES
        }
        self._status = node.create_publisher(DiagnosticArray, "status", runtime.RELIABLE)
        node.create_service(Trigger, "~/do_ffc", self._on_do_ffc)
        node.create_service(SetBool, "~/inhibit_ffc", self._on_inhibit_ffc)
        node.create_service(Trigger, "~/open_shutter", self._on_open_shutter)
        node.create_service(Trigger, "~/reconnect", self._on_reconnect)
        self._reader = threading.Thread(target=self._read, name="pairs", daemon=True)

    def start(self) -> None:
        """Open the cameras."""
        self._capture.__enter__()
        self._reader.start()

    def close(self) -> None:
        """Close the cameras."""
        self._capture.close()
        if self._reader.ident is not None:
            self._reader.join()

    def health(self) -> DiagnosticFields:
        """Level, message and counters of both cameras; call it once a second."""
        return self._health.fields(self._capture.status(), self._stamp_ns)

    def _read(self) -> None:
        try:
            for pair in self._capture.pairs():
                self._on_pair(pair)
                self._publish(pair)
        except Exception as error:
            if self._node.context.ok():  # else it only says that the node is being stopped
                self._node.fail(error)

    def _publish(self, pair: CapturedPair) -> None:
        # First: whoever handles the image shall know by then that the shutter was closed.
        if self._status.get_subscription_count():
            self._status.publish(
                conversions.diagnostics_to_msg(
                    *pair_fields(pair, self._capture.counters(), self._capture.cameras())
                )
            )
        for eye, frame in pair.frames.items():
            frame_id = f"{eye}_optical"
            if self._images[eye].get_subscription_count():
                self._images[eye].publish(
                    conversions.image_to_msg(frame.image, pair.stamp_ns, frame_id)
                )
            if eye in self.infos:
                height, width = frame.image.shape
                check_size(eye, self.infos[eye], width, height)
                self._info_out[eye].publish(
                    conversions.camera_info_to_msg(self.infos[eye], pair.stamp_ns, frame_id)
                )
        self._stamp_ns = pair.stamp_ns

    def _on_do_ffc(self, request: Any, response: Any) -> Any:
        return self._answer(response, self._capture.do_ffc, "will be corrected as soon as possible")

    def _on_inhibit_ffc(self, request: Any, response: Any) -> Any:
        said = (
            f"no corrections for {self._inhibit_limit_s:g} s"
            if request.data
            else "corrections are allowed"
        )
        return self._answer(response, lambda: self._capture.inhibit_ffc(request.data), said)

    def _on_open_shutter(self, request: Any, response: Any) -> Any:
        return self._answer(response, self._capture.open_shutter, "the shutters will be opened")

    def _on_reconnect(self, request: Any, response: Any) -> Any:
        return self._answer(response, self._capture.reconnect, "the cameras are opened anew")

    def _answer(self, response: Any, order: Callable[[], None], said: str) -> Any:
        try:
            order()
            response.success, response.message = True, said
        except CaptureError as error:
            response.success, response.message = False, str(error)
        return response


def _infos(
    config: StereoCaptureConfig, recorded: RigCalibration | None
) -> dict[str, CameraInfoFields]:
    infos = read_calibrations(config)
    if not infos and recorded is not None:
        calibration, _ = with_rectification(recorded, RectificationConfig())
        return infos_from_calibration(calibration)
    return infos
