"""Pairs the two cameras and maps both images onto one plane.

The calibration comes with ``camera_info``: K, D, R and P of a stereo pair.  Both images of a pair
leave under the stamp of the left one; an image without partner leaves alone.  Images are asked for
once the calibration is there and while somebody listens to both outputs, so that a chain of nodes
starts from its end and loses no frame.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from thermal_stereo_vo.core.camera_info import CameraInfoFields, calibration_from_pair
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.frames import CameraView, RadiometricFrame
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES, CalibrationInput, ImageInput
from thermal_stereo_vo.outputs.ros_fields import OK, WARN, DiagnosticFields
from thermal_stereo_vo.stereo.pairing import Pair, PairingConfig
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier, assemble


@dataclass(frozen=True)
class RectificationNodeConfig:
    """Settings of the node."""

    pairing: PairingConfig = group(PairingConfig, "Which images belong together.")
    process_all: bool = setting(
        False,
        "Ask for every image, reliably and in order (recordings), in place of the newest (flight).",
    )
    gated: bool = setting(
        False,
        "The images come from thermal_correction: wait for what its status says of each, so that "
        "gaps and corrections are known, and an eye that is blind is known to be.",
    )


class RectificationNode(runtime.BaseNode[RectificationNodeConfig]):
    """``left|right/image_raw`` to ``left|right/image_rect``."""

    NAME = "rectification"
    CONFIG = RectificationNodeConfig
    TOPICS = """
        in   left/image_raw, right/image_raw      sensor_msgs/Image (mono8, mono16)
        in   left/camera_info, right/camera_info  sensor_msgs/CameraInfo of the stereo pair
        in   status                               what thermal_correction says; with gated
        out  left/image_rect, right/image_rect    sensor_msgs/Image, same type, common stamp
        out  left/mask, right/mask                sensor_msgs/Image mono8, 255 = usable, latched
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray
        """
    LIVE = ("pairing.tolerance_ms", "pairing.max_waiting")

    def __init__(self) -> None:
        super().__init__()
        self._rectifier: Rectifier | None = None
        self._masks: dict[str, NDArray[np.bool_] | None] = {}
        self._stamp_ns = 0
        # The masks come first, so that whoever sees the images' publisher sees the masks' too.
        self._mask_out = {
            eye: self.create_publisher(Image, f"{eye}/mask", runtime.LATCHED) for eye in EYES
        }
        self._out = {
            eye: self.create_publisher(
                Image,
                f"{eye}/image_rect",
                runtime.IMAGES_ALL if self.config.process_all else runtime.IMAGES_OUT,
                qos_overriding_options=runtime.overridable(),
            )
            for eye in EYES
        }
        self._images = ImageInput(
            self,
            "image_raw",
            self.config.pairing,
            self.config.process_all,
            self._on_pair,
            self.get_logger().warning,
            gated=self.config.gated,
        )
        calibration = CalibrationInput(self, self._on_calibration)
        self.watch_inputs(calibration.topics)
        self.create_timer(0.1, self._follow_listeners, clock=runtime.steady_clock())

    def _follow_listeners(self) -> None:
        listeners = all(self._out[eye].get_subscription_count() > 0 for eye in EYES)
        if listeners and self._rectifier is not None and not self._images.is_open:
            self._images.open()
            self.watch_inputs(self._images.topics)
        elif not listeners and self._images.is_open:
            self._images.close()
            self.watch_inputs([])

    def _on_calibration(self, left: CameraInfoFields, right: CameraInfoFields) -> None:
        calibration = calibration_from_pair(left, right, origin="in camera_info")
        rectifier = Rectifier(calibration, RectificationConfig())
        for eye in EYES:
            blank = np.zeros((left.height, left.width), np.uint8)
            view = rectifier.process(RadiometricFrame(blank, 0, eye), eye)
            assert view is not None
            self._publish_mask(eye, view, 0)
        self._rectifier = rectifier
        self.problem = ""

    def _on_pair(self, pair: Pair[RadiometricFrame]) -> None:
        assert self._rectifier is not None
        frame = assemble(self._rectifier, pair.first, pair.second, pair.stamp_ns)
        for eye, view in frame.views.items():
            self._publish_mask(eye, view, frame.stamp_ns)
            self._out[eye].publish(
                conversions.image_to_msg(view.image, frame.stamp_ns, f"{eye}_optical")
            )
        self._stamp_ns = frame.stamp_ns
        self.problem = ""

    def _publish_mask(self, eye: str, view: CameraView, stamp_ns: int) -> None:
        if eye in self._masks and self._masks[eye] is view.mask:
            return
        self._masks[eye] = view.mask
        mask = np.ones(view.image.shape, np.bool_) if view.mask is None else view.mask
        self._mask_out[eye].publish(conversions.mask_to_msg(mask, stamp_ns, f"{eye}_optical"))

    def on_settings(self, config: RectificationNodeConfig) -> None:
        self._images.restart(config.pairing)

    def on_clock_jump_back(self, jump_s: float) -> None:
        self._images.restart()

    def health(self) -> DiagnosticFields:
        level, message = OK, "rectifying"
        if self._rectifier is None:
            level, message = WARN, "waiting for the calibration in camera_info"
        elif not self._images.is_open:
            message = "idle: nobody listens to both left/image_rect and right/image_rect"
        return DiagnosticFields(self._stamp_ns, level, self.NAME, message, self._images.counters())


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(RectificationNode, args)


if __name__ == "__main__":
    sys.exit(main())
