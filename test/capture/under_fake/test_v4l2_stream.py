"""One stream: negotiation, decoding, faults, and giving everything back."""

from __future__ import annotations

import errno
import gc
from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.capture.pixel_format import PIXEL_FORMATS
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.capture.v4l2 import GrabFault, StampKind, V4l2Stream
from thermal_stereo_vo.core.errors import CaptureError

START_OF_FRAME = 0x10000


def take(stream):
    """The next buffer."""
    for _ in range(1000):
        if stream.wait(0.1) and (grab := stream.take()) is not None:
            return grab
    pytest.fail("no buffer came")


def _take_many(stream):
    for _ in range(10):
        take(stream)


def open_descriptors():
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


def painted(pixel_format, width, height, sequence):
    """What the fake paints, seen through a pixel format."""
    y, x = np.mgrid[:height, :width]
    value = x * 7 + y * 13 + sequence * 101
    if pixel_format.name == "GREY":
        return (value % 2**8).astype(np.uint8)
    value %= 2**16
    low, high = value & 0xFF, value >> 8
    return {
        "YUYV": lambda: low.astype(np.uint8),
        "UYVY": lambda: high.astype(np.uint8),
        "Y16-BE": lambda: (low << 8 | high).astype(np.uint16),
    }.get(pixel_format.name, lambda: value.astype(np.uint16))()


@pytest.mark.parametrize("size", [(640, 512), (640, 480), (64, 48)], ids=str)
@pytest.mark.parametrize("padding", [0, 32])
@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_every_format_arrives_bit_for_bit(left, name, padding, size):
    left.control.pixel_format = PIXEL_FORMATS[name].code
    left.control.width, left.control.height = size
    left.control.padding = padding
    with V4l2Stream(left.path, left.config(pixel_format=name)) as stream:
        assert stream.format.pixel_format.name == name
        for _ in range(2):
            grab = take(stream)
            expected = painted(PIXEL_FORMATS[name], *size, grab.sequence)
            assert grab.image.dtype == expected.dtype
            np.testing.assert_array_equal(grab.image, expected)


def test_an_image_outlives_the_buffer_it_came_in(left):
    with V4l2Stream(left.path, left.config()) as stream:
        first = take(stream)
        before = first.image.copy()
        for _ in range(8):
            take(stream)
        np.testing.assert_array_equal(first.image, before)


def test_auto_takes_what_the_grabber_has(left):
    left.control.pixel_format = PIXEL_FORMATS["GREY"].code
    with V4l2Stream(left.path, left.config()) as stream:
        assert stream.format.pixel_format.name == "GREY"
        assert "GREY 64x48 at 200 Hz from fake grabber" in str(stream.format)


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ({"pixel_format": "GREY"}, r"offers no GREY; it offers: Y16 \(64x48\); .* MJPG"),
        ({"width": 640}, r"gives Y16 64x48 when asked for Y16 640x48; it offers: Y16 \(64x48\)"),
        ({"input": "S-Video"}, r"no input 'S-Video'; it has: 0 \(Composite0\), 1 \(Composite1\)"),
        ({"input": "7"}, r"no input '7'"),
        ({"standard": "PAL"}, "does not take the television standard PAL"),
    ],
)
def test_what_the_grabber_cannot_do_is_refused_with_what_it_can(left, asked, answer):
    with pytest.raises(CaptureError, match=answer):
        V4l2Stream(left.path, left.config(**asked))
    assert left.control.opened == left.control.closed == 1


@pytest.mark.parametrize(
    ("fault", "answer"),
    [
        ({"unplugged": 1}, "has been unplugged"),
        ({"busy": 1}, "in use by another program"),
        ({"streamon_errno": errno.ENOSPC}, "no bandwidth on its USB bus"),
        ({"max_buffers": 1}, "memory for 1 buffers of 4 asked"),
        ({"field": 7}, "gives single fields"),
        ({"pixel_format": 0x31324142}, "offers none of Y16, .*; it offers: nothing; .*BA21"),
    ],
)
def test_a_device_that_cannot_stream_is_refused_and_given_back(left, fault, answer):
    before = open_descriptors()
    config = left.config()
    for name, value in fault.items():
        setattr(left.control, name, value)
    with pytest.raises(CaptureError, match=answer):
        V4l2Stream(left.path, config)
    assert open_descriptors() == before


def test_input_and_standard_of_an_analog_grabber(left):
    left.control.standard = 0x1000  # the camera sends NTSC-M
    with V4l2Stream(left.path, left.config(standard="NTSC", input="Composite1")) as stream:
        assert (stream.format.standard, stream.format.input) == ("NTSC", "Composite1")
    with pytest.raises(CaptureError, match="sends NTSC, the settings say PAL"):
        V4l2Stream(left.path, left.config(standard="PAL"))


def test_another_rate_than_asked_is_told(left):
    with V4l2Stream(left.path, left.config(rate_hz=30.0)) as stream:
        assert stream.format.warnings == ("asked for 30 Hz, the driver gives 200 Hz",)


def test_what_is_no_video_device_is_refused(tmp_path):
    plain = tmp_path / "plain"
    plain.touch()
    with pytest.raises(CaptureError, match="is not a video device"):
        V4l2Stream(str(plain), StreamConfig())
    with pytest.raises(CaptureError, match="is not there: check cable"):
        V4l2Stream(str(tmp_path / "absent"), StreamConfig())


def test_damaged_and_short_buffers_carry_no_image(left):
    left.control.damaged = 1
    left.control.short_bytes = 64 * 48 * 2 - 1
    with V4l2Stream(left.path, left.config()) as stream:
        grabs = [take(stream) for _ in range(6)]
    faults = [grab.fault for grab in grabs if grab.image is None]
    # The fake puts both on one buffer: the driver's own flag goes first.
    assert faults == [GrabFault.DAMAGED]
    with V4l2Stream(left.path, left.config()) as stream:
        left.control.short_bytes = 64 * 48 * 2 - 1
        grabs = [take(stream) for _ in range(6)]
    assert [grab.fault for grab in grabs if grab.image is None] == [GrabFault.SHORT]
    assert sum(grab.image is not None for grab in grabs) == 5


def test_a_last_line_without_its_padding_is_whole(left):
    left.control.padding = 32
    with V4l2Stream(left.path, left.config()) as stream:
        left.control.short_bytes = 48 * (64 * 2 + 32) - 32
        assert all(take(stream).fault is None for _ in range(6))


def test_stamps_and_their_kind(left):
    with V4l2Stream(left.path, left.config()) as stream:
        grabs = [take(stream) for _ in range(10)]
        assert {grab.stamp_kind for grab in grabs} == {StampKind.END_OF_FRAME}
        for grab in grabs:
            assert 0 <= grab.arrival_ns - grab.driver_ns < 60e9
        steps_ns = np.diff([grab.driver_ns for grab in grabs])
        counts = np.diff([grab.sequence for grab in grabs])
        np.testing.assert_allclose(steps_ns / counts, 5e6, atol=2e3)
        left.control.buffer_flags |= START_OF_FRAME
        kinds = [take(stream).stamp_kind for _ in range(8)]
        assert kinds[-1] is StampKind.START_OF_FRAME
        left.control.buffer_flags = 0x4000
        kinds = [take(stream).stamp_kind for _ in range(8)]
        assert kinds[-1] is StampKind.UNKNOWN_CLOCK


def test_a_slow_reader_loses_frames_but_not_their_count(left, eventually):
    with V4l2Stream(left.path, left.config(buffers=4)) as stream:
        take(stream)
        produced = left.control.produced
        eventually(lambda: left.control.produced > produced + 40)
        sequences = [take(stream).sequence for _ in range(8)]
    assert max(np.diff(sequences)) > 20


@pytest.mark.parametrize(
    ("fault", "answer"),
    [({"eio": 1}, "fatal error of its stream"), ({"unplugged": 1}, "has been unplugged")],
)
def test_a_device_that_dies_says_so_and_closes(left, fault, answer):
    before = open_descriptors()
    with V4l2Stream(left.path, left.config()) as stream:
        take(stream)
        for name, value in fault.items():
            setattr(left.control, name, value)
        with pytest.raises(CaptureError, match=answer):
            _take_many(stream)
    assert open_descriptors() == before


def test_opened_and_closed_many_times_nothing_is_left(left):
    with V4l2Stream(left.path, left.config()) as stream:
        take(stream)
    before = open_descriptors(), _mappings()
    for _ in range(40):
        stream = V4l2Stream(left.path, left.config())
        stream.wait(0.02)
        stream.take()
        stream.close()
        stream.close()
    assert open_descriptors() == before[0]
    assert _mappings() <= before[1]
    assert left.control.opened == left.control.closed


def _mappings():
    return sum(
        "fake_v4l2" in line and ".so" not in line
        for line in Path("/proc/self/maps").read_text().splitlines()
    )
