"""The virtual devices of the guest (vivid) and their controls."""

from __future__ import annotations

import ctypes
import fcntl
import os
from functools import cache
from pathlib import Path

import pytest

from thermal_stereo_vo.capture import v4l2_abi as abi

NEXT_CONTROL = 0x80000000
CONTROLS = {
    "sequence_wrap": "Wrap Sequence Number",
    "stamp_wrap": "Wrap Timestamp",
    "stamp_source": "Timestamp Source",
    "signal": "DV Timings Signal Mode",
    "percentage_dropped": "Percentage of Dropped Buffers",
    "disconnect": "Disconnect",
    "damaged": "Inject V4L2_BUF_FLAG_ERROR",
    "fail_reqbufs": "Inject VIDIOC_REQBUFS Error",
    "fail_qbuf": "Inject VIDIOC_QBUF Error",
    "fail_streamon": "Inject VIDIOC_STREAMON Error",
    "fatal": "Inject Fatal Streaming Error",
}
LIVE_AT_30_HZ = 5  # 1280x720p30 in the table of timings
BIND = Path("/sys/bus/platform/drivers/vivid")


class Control(ctypes.Structure):
    _fields_ = (("id", ctypes.c_uint32), ("value", ctypes.c_int32))


class QueryControl(ctypes.Structure):
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("rest", ctypes.c_uint32 * 7),
    )


class Timings(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("bytes", ctypes.c_uint8 * 132),)


class EnumTimings(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("index", ctypes.c_uint32), ("pad", ctypes.c_uint32 * 3), ("timings", Timings))


def request(number: int, kind: type) -> int:
    return 3 << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


class Vivid:
    """One virtual grabber."""

    def __init__(self, number: int) -> None:
        self.path = f"/dev/video{10 + number}"
        self.device = f"bus:platform:vivid-{number:03d}"

    def set(self, name: str, value: int) -> None:
        number = _control_numbers(self.path)[CONTROLS[name]]
        self._ioctl(request(28, Control), Control(number, value))

    def send_30_hz(self) -> None:
        """Let the HDMI source send 30 frames a second; a scaler makes any size of them."""
        entry = EnumTimings(index=LIVE_AT_30_HZ)
        self._ioctl(request(98, EnumTimings), entry)
        self._ioctl(request(87, Timings), entry.timings)

    def open(self) -> int:
        return os.open(self.path, os.O_RDWR | os.O_NONBLOCK)

    def _ioctl(self, number: int, argument: ctypes.Structure) -> None:
        fd = self.open()
        try:
            fcntl.ioctl(fd, number, argument)
        finally:
            os.close(fd)


@pytest.fixture
def left():
    return _fresh(Vivid(0))


@pytest.fixture
def right():
    return _fresh(Vivid(1))


@pytest.fixture
def television():
    return Vivid(2)


@cache
def _control_numbers(path: str) -> dict[str, int]:
    """Name -> number of every control of a device."""
    numbers = {}
    query = QueryControl(id=NEXT_CONTROL)
    fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        while True:
            fcntl.ioctl(fd, request(36, QueryControl), query)
            numbers[query.name.decode()] = query.id
            query.id |= NEXT_CONTROL
    except OSError:
        return numbers
    finally:
        os.close(fd)


def _fresh(device: Vivid) -> Vivid:
    for name in ("sequence_wrap", "stamp_wrap", "stamp_source", "signal", "percentage_dropped"):
        device.set(name, 0)
    device.send_30_hz()
    return device


@pytest.fixture
def replug():
    """Take all virtual grabbers away, and bring them back."""

    def unplug():
        (BIND / "unbind").write_text("vivid.0")

    def plug():
        (BIND / "bind").write_text("vivid.0")

    yield unplug, plug
    if not Path("/dev/video10").exists():
        plug()


def busy(fd: int, width: int, height: int) -> None:
    """Reserve buffers, as another program does."""
    layout = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    layout.pix.width, layout.pix.height = width, height
    layout.pix.pixelformat = 0x20363159
    abi.ioctl(fd, abi.S_FMT, layout)
    buffers = abi.RequestBuffers(count=2, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
    abi.ioctl(fd, abi.REQBUFS, buffers)


@pytest.fixture
def another_program():
    """``another_program(device)``: keep it busy until the function returned is called."""
    held = []

    def hold(device):
        fd = device.open()
        held.append(fd)
        busy(fd, 640, 480)

        def release():
            held.remove(fd)
            os.close(fd)

        return release

    yield hold
    for fd in held:
        os.close(fd)
