"""Publishes two live thermal cameras as stereo pairs, and keeps them alive.

Both images of a pair carry one stamp.  While one camera is lost the other goes on alone, and the
lost one is opened again as soon as it is back.  Images are sent while somebody listens.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool, Trigger

from thermal_stereo_vo.core.calibration_yaml import parse_camera_info, read_text
from thermal_stereo_vo.core.camera_info import CameraInfoFields, infos_from_calibration
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError, CaptureError
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.outputs.ros_fields import WARN, DiagnosticFields
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification
from thermal_stereo_vo.stereo_capture import (
    EYES,
    CapturedPair,
    StereoCaptureConfig,
    open_stereo_capture,
)
from thermal_stereo_vo.stereo_capture_report import HealthReport, pair_fields


class StereoCaptureNode(runtime.BaseNode[StereoCaptureConfig]):
    """Live cameras to ``left|right/image_raw``."""

    NAME = "stereo_capture"
    CONFIG = StereoCaptureConfig
    TOPICS = """
        out  left/image_raw, right/image_raw      sensor_msgs/Image mono16 or mono8, common stamp
        out  left/camera_info, right/camera_info  sensor_msgs/CameraInfo, same stamp
        out  status                               diagnostic_msgs/DiagnosticArray of each pair:
                                                  sequence, skew, drops, correction, temperatures
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray, once a second
        srv  ~/do_ffc                             std_srvs/Trigger: correct the flat field soon
        srv  ~/inhibit_ffc                        std_srvs/SetBool: no corrections for a while
        srv  ~/open_shutter                       std_srvs/Trigger: after a shock has closed it
        srv  ~/reconnect                          std_srvs/Trigger: close and open all cameras
        """

    def __init__(self) -> None:
        super().__init__()
        self._capture, recorded = open_stereo_capture(self.config)
        self._infos = self._calibrations(recorded)
        self._report_of_health = HealthReport()
        self._stamp_ns = 0
        self._images = {
            eye: self.create_publisher(
                Image,
                f"{eye}/image_raw",
                runtime.IMAGES_OUT,
                qos_overriding_options=runtime.overridable(),
            )
            for eye in EYES
        }
        self._info_out = {
            eye: self.create_publisher(CameraInfo, f"{eye}/camera_info", runtime.RELIABLE)
            for eye in EYES
        }
        self._status = self.create_publisher(DiagnosticArray, "status", runtime.RELIABLE)
        self.create_service(Trigger, "~/do_ffc", self._on_do_ffc)
        self.create_service(SetBool, "~/inhibit_ffc", self._on_inhibit_ffc)
        self.create_service(Trigger, "~/open_shutter", self._on_open_shutter)
        self.create_service(Trigger, "~/reconnect", self._on_reconnect)
        self._capture.__enter__()
        self._reader = threading.Thread(target=self._read, name="pairs", daemon=True)
        self._reader.start()

    def health(self) -> DiagnosticFields:
        fields = self._report_of_health.fields(self._capture.status(), self._stamp_ns)
        if len(self._infos) < len(EYES):
            hint = "not calibrated: set left_calibration and right_calibration"
            message = f"{fields.message}; {hint}"
            return replace(fields, level=max(fields.level, WARN), message=message)
        return fields

    def close(self) -> None:
        self._capture.close()
        self._reader.join()

    def _calibrations(self, recorded: RigCalibration | None) -> dict[str, CameraInfoFields]:
        """What ``camera_info`` says, by eye; nothing where nobody knows."""
        urls = (self.config.left_calibration, self.config.right_calibration)
        infos = {
            eye: parse_camera_info(read_text(path), path)
            for eye, url in zip(EYES, urls, strict=True)
            if url
            for path in [_path_of(url)]
        }
        if not infos and recorded is not None:
            calibration, _ = with_rectification(recorded, RectificationConfig())
            return infos_from_calibration(calibration)
        if self.config.source == "grabbers":
            streams = (self.config.grabbers.left, self.config.grabbers.right)
            for eye, stream in zip(EYES, streams, strict=True):
                if eye in infos:
                    _check_size(eye, infos[eye], stream.width, stream.height)
        return infos

    def _read(self) -> None:
        try:
            for pair in self._capture.pairs():
                self._publish(pair)
        except Exception as error:
            self.fail(error)

    def _publish(self, pair: CapturedPair) -> None:
        # First: whoever handles the image shall know by then that the shutter was closed.
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
            if eye in self._infos:
                height, width = frame.image.shape
                _check_size(eye, self._infos[eye], width, height)
                self._info_out[eye].publish(
                    conversions.camera_info_to_msg(self._infos[eye], pair.stamp_ns, frame_id)
                )
        self._stamp_ns = pair.stamp_ns

    def _on_do_ffc(self, request: Any, response: Any) -> Any:
        return self._answer(response, self._capture.do_ffc, "will be corrected as soon as possible")

    def _on_inhibit_ffc(self, request: Any, response: Any) -> Any:
        limit_s = self.config.grabbers.ffc.inhibit_limit_s
        said = f"no corrections for {limit_s:g} s" if request.data else "corrections are allowed"
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


def _check_size(eye: str, info: CameraInfoFields, width: int, height: int) -> None:
    if (info.width, info.height) != (width, height):
        raise CalibrationError(
            f"the {eye} calibration is for {info.width}x{info.height} pixels, the stream has "
            f"{width}x{height}: calibrate at the size in use, or ask for that of the calibration"
        )


def _path_of(url: str) -> Path:
    """The file of a ``file://`` or ``package://`` URL, or of a plain path."""
    scheme, separator, rest = url.partition("://")
    if not separator:
        return Path(url)
    if scheme == "file":
        return Path(rest)
    if scheme != "package":
        raise CalibrationError(f"the calibration URL '{url}' must begin with file:// or package://")
    from ament_index_python.packages import get_package_share_directory

    package, _, inside = rest.partition("/")
    try:
        return Path(get_package_share_directory(package)) / inside
    except (LookupError, OSError):  # unknown, or no workspace is sourced at all
        raise CalibrationError(
            f"the package '{package}' of the calibration URL '{url}' is not installed"
        ) from None


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(StereoCaptureNode, args)


if __name__ == "__main__":
    sys.exit(main())
