"""Find a grabber by what does not change: udev path, USB serial number, bus name.

The numbers of /dev/videoN follow the order of discovery: bound to them, left and right may change
places at the next start.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from thermal_stereo_vo.capture import v4l2_abi as abi
from thermal_stereo_vo.core.errors import CaptureError

SYSFS = Path("/sys/class/video4linux")
_NUMBERED = re.compile(r"/dev/video\d+")


@dataclass(frozen=True)
class VideoNode:
    """A video node of this machine and the names that tell it from others."""

    path: str
    card: str = ""
    bus: str = ""
    serial: str = ""
    links: tuple[str, ...] = ()

    def __str__(self) -> str:
        names = [*self.links]
        if self.serial:
            names.append(f"serial:{self.serial}")
        if self.bus:
            names.append(f"bus:{self.bus}")
        return f"{' or '.join(names) or self.path} ({self.card or 'unnamed'})"


def resolve_device(device: str, sysfs: Path = SYSFS) -> str:
    """The path to open for the setting ``device``; call it again for every opening.

    Raises CaptureError for a numbered node and for a name nobody has, with the names there are.
    """
    if not device:
        raise CaptureError(f"no device is set: {_offer(sysfs)}")
    if _NUMBERED.fullmatch(device):
        raise CaptureError(
            f"{device} is refused, since its number may belong to the other eye after the next "
            f"start: name the grabber by udev path, serial number or bus; {_offer(sysfs)}"
        )
    kind, colon, name = device.partition(":")
    if colon and kind == "serial":
        serial, _, channel = name.partition("/")
        found = [node for node in video_nodes(sysfs) if node.serial == serial]
        index = int(channel) if channel.isdecimal() else 0
        if index < len(found):
            return found[index].path
    elif colon and kind == "bus":
        for node in video_nodes(sysfs):
            if node.bus == name:
                return node.path
    elif Path(device).exists():
        return device
    raise CaptureError(f"there is no video device '{device}': {_offer(sysfs)}")


def video_nodes(sysfs: Path = SYSFS) -> list[VideoNode]:
    """All capture nodes of this machine, by number."""
    entries = sorted(sysfs.glob("video*"), key=lambda entry: int(entry.name[5:]))
    links: dict[str, list[str]] = {}
    for link in (*Path("/dev/v4l/by-path").glob("*"), *Path("/dev/v4l/by-id").glob("*")):
        links.setdefault(os.path.realpath(link), []).append(str(link))
    return [
        VideoNode(
            path=path,
            card=card,
            bus=bus,
            serial=_usb_serial(entry),
            links=tuple(sorted(links.get(path, ()))),
        )
        for entry in entries
        for path, card, bus in _capture_capability(f"/dev/{entry.name}")
    ]


def _capture_capability(path: str) -> Iterator[tuple[str, str, str]]:
    capability = abi.Capability()
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return
    try:
        with suppress(OSError):
            abi.ioctl(fd, abi.QUERYCAP, capability)
    finally:
        os.close(fd)
    has_own = capability.capabilities & abi.CAP_DEVICE_CAPS
    caps = capability.device_caps if has_own else capability.capabilities
    if caps & abi.CAP_VIDEO_CAPTURE:
        yield (
            path,
            capability.card.decode("utf-8", "replace"),
            capability.bus_info.decode("utf-8", "replace"),
        )


def _usb_serial(entry: Path) -> str:
    """The serial number of the USB device above a video4linux entry, or nothing."""
    folder = (entry / "device").resolve()
    for candidate in (folder, *folder.parents):
        serial = candidate / "serial"
        if (candidate / "idVendor").exists():
            return serial.read_text().strip() if serial.exists() else ""
    return ""


def _offer(sysfs: Path) -> str:
    nodes = video_nodes(sysfs)
    if not nodes:
        return "this machine has no video device at all"
    return "there are: " + ", ".join(str(node) for node in nodes)
