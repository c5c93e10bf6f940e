"""What a rig of live cameras offers, be it grabbers or a recording that plays their part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from thermal_stereo_vo.capture.control_link import ControlStatus
from thermal_stereo_vo.capture.recovery import LinkStatus
from thermal_stereo_vo.core.errors import CaptureError
from thermal_stereo_vo.core.frames import RawFrame


@dataclass(frozen=True)
class CameraStatus:
    """One camera: its video, and its control port where it has one."""

    link: LinkStatus
    control: ControlStatus | None = None


class CameraSource(Protocol):
    """Live cameras.  Each has its own thread, stamps in ROS time that increase, and recovery."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Roles, in the order of pairing."""

    def start(self, on_frame: Callable[[RawFrame], None]) -> None:
        """Begin; ``on_frame`` is called from the cameras' threads."""

    def stop(self) -> None:
        """Close everything; no frame comes after this has returned."""

    def streaming(self, camera: str) -> bool:
        """Whether frames of this camera are to be expected."""

    def reconnect(self) -> None:
        """Close and open everything now."""

    def status(self) -> dict[str, CameraStatus]:
        """Role -> how it is."""

    def ffc_inhibited(self) -> bool:
        """Whether an inhibition holds now."""

    def do_ffc(self) -> None:
        """Correct the flat field of all cameras soon.  Raises CaptureError without control."""

    def open_shutter(self) -> None:
        """Open shutters that a shock has closed.  Raises CaptureError without control."""

    def inhibit_ffc(self, inhibit: bool) -> None:
        """No corrections for a while, or again.  Raises CaptureError without control."""


def no_control() -> CaptureError:
    """Nobody can be told to correct."""
    return CaptureError(
        "no camera has a control port: set control.left_port and control.right_port"
    )
