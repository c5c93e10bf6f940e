"""One stream from the kernel's own virtual grabber."""

from __future__ import annotations

import time

import numpy as np
import pytest

from thermal_stereo_vo.capture.device_path import resolve_device, video_nodes
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.capture.v4l2 import StampKind, V4l2Stream
from thermal_stereo_vo.core.errors import CaptureError


def config(**settings):
    return StreamConfig(**({"device": "-", "width": 640, "height": 480} | settings))


def grab(device, count=3, **settings):
    with V4l2Stream(device.path, config(**settings)) as stream:
        return stream.format, [next_of(stream) for _ in range(count)]


def next_of(stream):
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        if stream.wait(0.5) and (taken := stream.take()) is not None:
            return taken
    return pytest.fail("no buffer came")


def test_the_formats_tell_the_same_picture(left):
    # Below the lines of text, which count frames, the colour bars stand still.
    pictures = {}
    for name in ("Y16", "Y16-BE", "Y12", "Y10", "GREY", "YUYV", "UYVY"):
        layout, grabs = grab(left, pixel_format=name)
        assert layout.pixel_format.name == name
        pictures[name] = grabs[-1].image[300:].astype(np.int64)
    base = pictures["Y16"]
    assert len(np.unique(base)) >= 6
    np.testing.assert_array_equal(pictures["Y16-BE"], base)
    np.testing.assert_array_equal(pictures["Y12"], base >> 4)
    np.testing.assert_array_equal(pictures["Y10"], base >> 6)
    np.testing.assert_array_equal(pictures["GREY"], base >> 8)
    np.testing.assert_array_equal(pictures["UYVY"], pictures["YUYV"])
    # Colour formats use the television range of luma: another scale, the same bars.
    assert np.corrcoef(pictures["YUYV"].ravel(), base.ravel())[0, 1] > 0.99


@pytest.mark.parametrize("height", [480, 512])
def test_sizes_rate_and_stamps(left, height):
    layout, grabs = grab(left, count=15, height=height, pixel_format="Y16")
    assert str(layout) == f"Y16 640x{height} at 30 Hz from vivid"
    assert layout.field == "progressive"
    assert {taken.image.shape for taken in grabs} == {(height, 640)}
    assert [taken.sequence for taken in grabs] == list(range(15))
    assert {taken.stamp_kind for taken in grabs} == {StampKind.END_OF_FRAME}
    steps_ns = np.diff([taken.driver_ns for taken in grabs])
    assert np.mean(steps_ns) == pytest.approx(1e9 / 30, rel=0.02)


def test_a_driver_that_stamps_the_start(left):
    left.set("stamp_source", 1)
    _, grabs = grab(left)
    assert {taken.stamp_kind for taken in grabs} == {StampKind.START_OF_FRAME}


def test_an_analog_input(television):
    layout, grabs = grab(television, standard="NTSC", pixel_format="GREY")
    assert (layout.standard, layout.field) == ("NTSC", "interlaced")
    assert layout.rate_hz == pytest.approx(29.97, abs=0.01)
    assert grabs[-1].image.shape == (480, 640)
    with pytest.raises(CaptureError, match="no input 'S-Video 9'; it has: 0"):
        V4l2Stream(television.path, config(input="S-Video 9"))


@pytest.mark.parametrize("request_that_fails", ["fail_reqbufs", "fail_streamon", "fail_qbuf"])
def test_a_driver_that_refuses_gives_the_device_back(left, request_that_fails):
    left.set(request_that_fails, 1)
    with pytest.raises(CaptureError, match=left.path):
        V4l2Stream(left.path, config())
    _, grabs = grab(left)
    assert grabs[-1].fault is None


def test_a_busy_device(left, another_program):
    release = another_program(left)
    with pytest.raises(CaptureError, match="in use by another program"):
        V4l2Stream(left.path, config())
    release()
    grab(left)


def test_names(left, right):
    assert {node.bus for node in video_nodes()} >= {"platform:vivid-000", "platform:vivid-001"}
    assert resolve_device("bus:platform:vivid-001") == right.path
    with pytest.raises(CaptureError, match=r"/dev/video10 is refused.*bus:platform:vivid-000"):
        resolve_device(left.path)
    with pytest.raises(CaptureError, match=r"no video device 'serial:7'"):
        resolve_device("serial:7")
