"""The controls of the fake devices ``left`` and ``right`` of this process."""

from __future__ import annotations

import ctypes
import mmap
import os
from ctypes import c_int64, c_uint32
from pathlib import Path

import pytest

from thermal_stereo_vo.capture.pixel_format import fourcc
from thermal_stereo_vo.capture.stream_config import StreamConfig

MONOTONIC_END_OF_FRAME = 0x2000


class Control(ctypes.Structure):
    """``struct control`` of fake_v4l2.c."""

    _fields_ = (
        *(
            (name, c_uint32)
            for name in (
                *("pixel_format", "width", "height", "millihertz", "padding", "buffer_flags"),
                *("standard", "field", "inputs", "max_buffers"),
                *("unplugged", "stalled", "no_signal", "busy"),
                *("damaged", "dropped", "short_bytes", "eio", "streamon_errno", "next_sequence"),
            )
        ),
        ("stamp_shift_ns", c_int64),
        *((name, c_uint32) for name in ("produced", "opened", "closed", "queued", "last_errno")),
    )


class FakeDevice:
    """One fake device: ``path`` to open, ``control`` to play with."""

    def __init__(self, path: str, control_file: str) -> None:
        self.path = path
        with Path(control_file).open("r+b") as file:
            self.control = Control.from_buffer(mmap.mmap(file.fileno(), 4096))

    def reset(self) -> None:
        ctypes.memset(ctypes.byref(self.control), 0, ctypes.sizeof(Control))
        control = self.control
        control.pixel_format = fourcc("Y16")
        control.width, control.height = 64, 48
        control.millihertz = 200_000
        control.buffer_flags = MONOTONIC_END_OF_FRAME
        control.field = 1
        control.inputs = 2
        control.max_buffers = 16

    def config(self, **changes: object) -> StreamConfig:
        settings = {
            "device": self.path,
            "width": self.control.width,
            "height": self.control.height,
            "settling_frames": 0,
            # A busy machine may stop everything for a while: that is no stall of the camera.
            "timeout_s": 60.0,
            "start_timeout_s": 60.0,
        }
        return StreamConfig(**(settings | changes))


def _devices() -> dict[str, FakeDevice]:
    entries = (entry.split("=") for entry in os.environ["FAKE_V4L2"].split(";"))
    return {Path(path).name: FakeDevice(path, control) for path, control in entries}


@pytest.fixture(scope="session")
def _all_devices():
    return _devices()


@pytest.fixture
def left(_all_devices) -> FakeDevice:
    _all_devices["left"].reset()
    return _all_devices["left"]


@pytest.fixture
def right(_all_devices) -> FakeDevice:
    _all_devices["right"].reset()
    return _all_devices["right"]
