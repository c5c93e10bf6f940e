"""A recording that plays live cameras."""

from __future__ import annotations

import threading
import time
from itertools import pairwise

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.capture.fake import FakeCameras, FakeConfig
from thermal_stereo_vo.capture.recovery import LinkState
from thermal_stereo_vo.core.errors import CaptureError, ConfigError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.outputs.ros_fields import WARN
from thermal_stereo_vo.stereo_capture import (
    StereoCapture,
    StereoCaptureConfig,
    open_stereo_capture,
)
from thermal_stereo_vo.stereo_capture_report import HealthReport

MS = 1_000_000
BEGIN_NS = 12_345 * MS


def recording(count=5, period_ms=20, skew_ms=3):
    """Frames of both cameras, the value of each its number."""

    def frames():
        for n in range(count):
            for eye, offset_ms in (("left", 0), ("right", skew_ms)):
                image = np.full((4, 6), n, np.uint16)
                stamp_ns = BEGIN_NS + (n * period_ms + offset_ms) * MS
                yield RawFrame(image, stamp_ns, eye, sequence=100 + n)

    return frames


def play(frames, eventually, wanted, **config):
    cameras = FakeCameras(("left", "right"), frames, FakeConfig(**config))
    played, arrivals = [], []

    def on_frame(frame):
        arrivals.append(time.time_ns())
        played.append(frame)

    cameras.start(on_frame)
    try:
        eventually(lambda: len(played) >= wanted, cameras.status)
    finally:
        cameras.stop()
    return cameras, played, arrivals


def check_pace(played, steps_ms):
    """Steps of the stamps are those of the recording, but where a busy machine made it late."""
    late_ms = np.diff([frame.stamp_ns for frame in played]) / MS - steps_ms
    assert np.all((np.abs(late_ms) < 0.2) | (late_ms > 200.0)), late_ms


def test_frames_come_at_their_pace_with_present_stamps(eventually):
    _, played, arrivals = play(recording(), eventually, 10, repeat=False)
    check_pace(played, [3, 17, 3, 17, 3, 17, 3, 17, 3])
    for frame, arrival_ns in zip(played, arrivals, strict=True):
        assert -1 * MS < arrival_ns - frame.stamp_ns < 60_000 * MS
    assert [frame.image[0, 0] for frame in played] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_speed(eventually):
    _, played, _ = play(recording(), eventually, 10, repeat=False, speed=4.0)
    check_pace(played, np.array([3, 17, 3, 17, 3, 17, 3, 17, 3]) / 4)


def test_it_repeats_with_stamps_and_sequence_that_go_on(eventually):
    cameras, played, _ = play(recording(count=3, period_ms=5), eventually, 20)
    for eye in ("left", "right"):
        mine = [frame for frame in played if frame.camera == eye]
        assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(mine))
        assert [frame.sequence for frame in mine] == list(range(len(mine)))
    assert cameras.status()["left"].link.counters.connections >= 3


def test_the_end_is_told(eventually):
    cameras = FakeCameras(("left", "right"), recording(), FakeConfig(repeat=False, speed=50.0))
    cameras.start(lambda frame: None)
    eventually(lambda: cameras.status()["left"].link.reason == "the recording is over")
    assert not cameras.streaming("left")
    cameras.stop()


def test_a_broken_recording_is_told(eventually):
    def frames():
        yield from recording(1)()
        raise ValueError("torn")

    cameras = FakeCameras(("left", "right"), frames, FakeConfig())
    cameras.start(lambda frame: None)
    eventually(lambda: "broke off: torn" in cameras.status()["left"].link.reason)
    assert cameras.status()["left"].link.state is LinkState.CLOSED
    cameras.stop()


def test_a_source_that_cannot_keep_up_plays_in_slow_motion(eventually):
    def slow():
        for frame in recording(count=4, period_ms=1, skew_ms=0)():
            if frame.camera == "left":
                time.sleep(0.3)
            yield frame

    _, played, arrivals = play(slow, eventually, 8, repeat=False)
    for frame, arrival_ns in zip(played, arrivals, strict=True):
        assert arrival_ns > frame.stamp_ns - MS
    assert (played[-1].stamp_ns - played[0].stamp_ns) / MS > 250


def test_slow_motion_tears_no_pair():
    def slow():
        for frame in recording(count=4)():
            if frame.camera == "right":
                time.sleep(0.3)
            yield frame

    cameras = FakeCameras(("left", "right"), slow)
    with StereoCapture(cameras, waiting_pairs=1000) as capture:
        pairs = [pair for _, pair in zip(range(4), capture.pairs(), strict=False)]
    assert [pair.frames["right"].image[0, 0] for pair in pairs] == [0, 1, 2, 3]
    assert all(pair.complete and abs(pair.skew_ns - 3 * MS) < MS for pair in pairs)
    assert pairs[-1].stamp_ns - pairs[0].stamp_ns > 600 * MS


def test_pairs_of_a_recording():
    cameras = FakeCameras(("left", "right"), recording(), FakeConfig(speed=2.0))
    with StereoCapture(cameras) as capture:
        pairs = [pair for _, pair in zip(range(4), capture.pairs(), strict=False)]
    for pair in pairs:
        assert pair.complete
        assert pair.skew_ns == pytest.approx(1.5 * MS, abs=0.05 * MS)
        assert np.array_equal(pair.frames["left"].image, pair.frames["right"].image)


def test_a_skew_that_costs_pixels_is_warned_of(rng):
    """15 px a frame at 50 Hz: 5 ms between the eyes are 3.75 px."""
    world = cv2.GaussianBlur(rng.normal(size=(240, 1200)).astype(np.float32), (0, 0), 6)
    world = (8000 + 500 * world / world.std()).astype(np.uint16)

    def frames():
        for n in range(50):
            for eye, offset_ms in (("left", 0), ("right", 5)):
                image = world[:, 15 * n :][:, :320]
                yield RawFrame(image, BEGIN_NS + (n * 20 + offset_ms) * MS, eye, sequence=n)

    capture = StereoCapture(FakeCameras(("left", "right"), frames), waiting_pairs=1000)
    with capture:
        for _ in zip(range(40), capture.pairs(), strict=False):
            pass
        told = HealthReport().fields(capture.status(), 0)
    values = dict(told.values)
    assert float(values["skew_ms"]) == pytest.approx(5.0, abs=0.1)
    assert float(values["skew_displacement_px"]) == pytest.approx(3.75, rel=0.15)
    assert told.level == WARN
    assert "px of false disparity" in told.message


def test_close_ends_a_reader_that_waits():
    cameras = FakeCameras(("left", "right"), lambda: iter(()), FakeConfig(repeat=False))
    capture = StereoCapture(cameras)
    capture.__enter__()
    seen = []
    reader = threading.Thread(target=lambda: seen.extend(capture.pairs()), daemon=True)
    reader.start()
    capture.close()
    capture.close()
    reader.join(240.0)
    assert not reader.is_alive()
    assert seen == []


def test_a_recording_without_two_eyes_is_refused():
    with pytest.raises(CaptureError, match="needs the cameras left and right, not thermal"):
        StereoCapture(FakeCameras(("thermal",), recording()))


def test_a_recording_must_be_named():
    with pytest.raises(ConfigError, match="names none"):
        open_stereo_capture(StereoCaptureConfig(source="recording"))


def test_grabbers_must_be_named_and_apart():
    with pytest.raises(ConfigError, match=r"left.device is not set; right.device is not set"):
        open_stereo_capture(StereoCaptureConfig())
