"""Two thermal cameras on frame grabbers, with their control ports."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from thermal_stereo_vo.capture.camera_control import (
    CameraSettings,
    agc_filter_word,
    open_serial,
    parse_agc_roi,
)
from thermal_stereo_vo.capture.cci import SerialPort
from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.control_link import ControlConfig, ControlLink
from thermal_stereo_vo.capture.ffc_policy import FfcConfig, FfcPolicy
from thermal_stereo_vo.capture.recovery import CameraLink, RecoveryConfig
from thermal_stereo_vo.capture.source import CameraStatus, no_control
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import RawFrame, Telemetry


@dataclass(frozen=True)
class GrabberConfig:
    """Everything about the two cameras."""

    left: StreamConfig = group(StreamConfig, "Video of the left camera.")
    right: StreamConfig = group(StreamConfig, "Video of the right camera.")
    recovery: RecoveryConfig = group(RecoveryConfig, "What happens after a failure.")
    control: ControlConfig = group(ControlConfig, "Serial control ports.")
    camera: CameraSettings = group(CameraSettings, "How both cameras shall be set.")
    ffc: FfcConfig = group(FfcConfig, "Flat-field corrections.")


class GrabberRig:
    """A ``CameraSource`` of two V4L2 devices.

    Raises ConfigError for settings that contradict each other.
    """

    cameras = (LEFT, RIGHT)

    def __init__(
        self,
        config: GrabberConfig,
        *,
        clock: EpochClock | None = None,
        open_port: Callable[[str, int], SerialPort] = open_serial,
    ) -> None:
        _check(config)
        self._config = config
        self._clock = clock if clock is not None else EpochClock()
        ports = {LEFT: config.control.left_port, RIGHT: config.control.right_port}
        ports = {camera: port for camera, port in ports.items() if port}
        self._policy = FfcPolicy(config.ffc, tuple(ports), time.monotonic_ns()) if ports else None
        self._controls = {
            camera: ControlLink(
                camera,
                port,
                config.control,
                config.camera,
                config.ffc,
                self._policy,
                open_port=open_port,
            )
            for camera, port in ports.items()
            if self._policy is not None
        }
        self._links: dict[str, CameraLink] = {}
        self._threads: list[CameraLink | ControlLink] = []

    @property
    def clock(self) -> EpochClock:
        """The clock that both cameras share."""
        return self._clock

    def start(self, on_frame: Callable[[RawFrame], None]) -> None:
        streams = {LEFT: self._config.left, RIGHT: self._config.right}
        for camera, stream in streams.items():
            self._links[camera] = CameraLink(
                camera,
                stream,
                on_frame,
                clock=self._clock,
                recovery=self._config.recovery,
                telemetry=self._telemetry_of(camera),
            )
        self._threads = [*self._controls.values(), *self._links.values()]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        for thread in self._threads:
            thread.request_stop()
        for thread in self._threads:
            thread.stop()

    def streaming(self, camera: str) -> bool:
        return camera in self._links and self._links[camera].streaming

    def reconnect(self) -> None:
        for thread in self._threads:
            thread.reconnect()

    def status(self) -> dict[str, CameraStatus]:
        return {
            camera: CameraStatus(
                link.status(),
                self._controls[camera].status() if camera in self._controls else None,
            )
            for camera, link in self._links.items()
        }

    def do_ffc(self) -> None:
        self._require_policy().request()

    def open_shutter(self) -> None:
        self._require_policy()
        for control in self._controls.values():
            control.open_shutter()

    def inhibit_ffc(self, inhibit: bool) -> None:
        policy = self._require_policy()
        if inhibit:
            policy.inhibit(time.monotonic_ns())
        else:
            policy.release()

    def ffc_inhibited(self) -> bool:
        """Whether an inhibition holds now."""
        return self._policy is not None and self._policy.inhibited(time.monotonic_ns())

    def _telemetry_of(self, camera: str) -> Callable[[int], Telemetry | None]:
        control = self._controls.get(camera)
        return control.telemetry if control is not None else lambda monotonic_ns: None

    def _require_policy(self) -> FfcPolicy:
        if self._policy is None:
            raise no_control()
        return self._policy


def _check(config: GrabberConfig) -> None:
    errors = []
    left, right = config.left, config.right
    for camera, stream in ((LEFT, left), (RIGHT, right)):
        if not stream.device:
            errors.append(f"{camera}.device is not set")
    if left.device and left.device == right.device:
        errors.append(f"left.device and right.device are both '{left.device}'")
    ports = config.control.left_port, config.control.right_port
    if ports[0] and ports[0] == ports[1]:
        errors.append(f"control.left_port and control.right_port are both '{ports[0]}'")
    for check in (agc_filter_word, parse_agc_roi):
        try:
            check(config.camera)
        except ConfigError as error:
            errors.append(f"camera.{error}")
    if errors:
        raise ConfigError("; ".join(errors))
