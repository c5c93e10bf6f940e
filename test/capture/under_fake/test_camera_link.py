"""One camera that is kept streaming through every fault of the fake."""

from __future__ import annotations

import errno
import time
from itertools import pairwise

import numpy as np
import pytest

from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.recovery import CameraLink, LinkState, RecoveryConfig
from thermal_stereo_vo.capture.v4l2 import StampKind
from thermal_stereo_vo.core.frames import Telemetry

RECOVERY = RecoveryConfig(first_wait_s=0.02, longest_wait_s=0.1)


@pytest.fixture
def connect(left):
    """Start a link to the left device with these settings; stopped after the test."""
    links = []

    def start(**changes):
        frames = []
        link = CameraLink(
            "left",
            left.config(**changes),
            frames.append,
            clock=EpochClock(),
            recovery=RECOVERY,
            telemetry=lambda monotonic_ns: Telemetry(fpa_temperature_kelvin=300.0),
        )
        links.append(link)
        link.start()
        return link, frames

    yield start
    for link in links:
        link.stop()
    assert left.control.opened == left.control.closed


def flowing(frames, eventually, link, more=3):
    """Wait for a few frames from now on."""
    wanted = len(frames) + more
    eventually(lambda: len(frames) >= wanted, link.status)


def age_ns(frames):
    """What the newest stamp lags behind the present."""
    return time.time_ns() - frames[-1].stamp_ns


def check(frames):
    """What must hold for the frames of a camera whatever happened to it."""
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(frames))
    assert all(b.sequence > a.sequence for a, b in pairwise(frames))
    assert all(isinstance(frame.stamp_ns, int) for frame in frames)


def test_frames_have_ros_stamps_sequence_and_telemetry(connect, eventually):
    link, frames = connect()
    eventually(lambda: len(frames) > 30, link.status)
    check(frames)
    eventually(lambda: abs(age_ns(frames)) < 0.1e9, link.status)
    assert frames[0].telemetry.fpa_temperature_kelvin == 300.0
    assert frames[0].camera == "left"
    assert not frames[0].image.flags.writeable
    status = link.status()
    assert status.state is LinkState.STREAMING
    assert status.reason == ""
    assert status.stamp_kind is StampKind.END_OF_FRAME
    assert str(status.format) == "Y16 64x48 at 200 Hz from fake grabber"
    eventually(lambda: 50 < link.status().rate_hz < 250, link.status)


def test_the_stamp_is_that_of_the_driver_plus_the_offset(connect, left, eventually):
    left.control.stamp_shift_ns = -200_000_000
    link, frames = connect(stamp_offset_ms=-300.0)
    flowing(frames, eventually, link)
    # Older only while the machine keeps a frame waiting.
    eventually(lambda: 500e6 <= age_ns(frames) < 600e6, link.status)


def test_settling_frames_are_dropped_after_each_start(connect, eventually):
    link, frames = connect(settling_frames=7)
    flowing(frames, eventually, link)
    assert link.status().counters.settling == 7
    link.reconnect()
    eventually(lambda: link.status().counters.connections == 2, link.status)
    flowing(frames, eventually, link)
    assert link.status().counters.settling == 14
    check(frames)


def test_damaged_and_short_frames_are_dropped_and_counted(connect, left, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    left.control.damaged = 3
    eventually(lambda: link.status().counters.damaged == 3, link.status)
    left.control.short_bytes = 100
    eventually(lambda: link.status().counters.short == 1, link.status)
    flowing(frames, eventually, link)
    link.stop()
    counters = link.status().counters
    assert counters.dropped >= 4
    assert counters.failures == 0
    check(frames)
    gaps = sum(b.sequence - a.sequence - 1 for a, b in pairwise(frames))
    assert gaps == counters.damaged + counters.short + counters.lost


def test_dropped_frames_show_as_gaps_of_the_sequence(connect, left, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    before = link.status().counters.lost
    left.control.dropped = 5
    flowing(frames, eventually, link, more=10)
    assert link.status().counters.lost >= before + 5


def test_a_wrap_of_the_sequence_is_no_gap(connect, left, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    left.control.next_sequence = 2**32 - 5
    eventually(lambda: left.control.next_sequence == 0)
    flowing(frames, eventually, link, more=20)
    check(frames)
    # The jump of the fake's counter itself looks like a restart, not like four billion frames.
    assert link.status().counters.lost < 100_000


def test_a_wrap_of_the_stamps_is_survived_with_stamps_of_arrival(connect, left, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    for shift_ns in (2**62, -(2**62), 3600 * 10**9):
        left.control.stamp_shift_ns = shift_ns
        before = link.status().counters.by_arrival
        eventually(lambda b=before: link.status().counters.by_arrival > b + 3, link.status)
    left.control.stamp_shift_ns = 0
    flowing(frames, eventually, link)
    eventually(lambda: abs(age_ns(frames)) < 0.1e9, link.status)
    check(frames)


def test_a_driver_without_monotonic_stamps_is_told(connect, left, eventually):
    left.control.buffer_flags = 0
    link, frames = connect()
    flowing(frames, eventually, link)
    assert link.status().stamp_kind is StampKind.UNKNOWN_CLOCK
    assert link.status().counters.by_arrival > 0


@pytest.mark.parametrize(
    ("fault", "reason", "stalls"),
    [
        ({"stalled": 1}, "sent nothing for 0.15 s: check cable and camera", 1),
        ({"eio": 10**9}, "fatal error of its stream", 0),
        ({"damaged": 10**9}, "damaged frames only for 0.15 s", 1),
    ],
    ids=str,
)
def test_a_stream_that_dies_is_opened_anew(connect, left, eventually, fault, reason, stalls):
    link, frames = connect(timeout_s=0.15)
    flowing(frames, eventually, link)
    for name, value in fault.items():
        setattr(left.control, name, value)
    eventually(lambda: reason in link.status().reason, link.status)
    eventually(lambda: reason in link.status().last_failure, link.status)
    for name in fault:
        setattr(left.control, name, 0)
    eventually(lambda: link.status().state is LinkState.STREAMING, link.status)
    flowing(frames, eventually, link)
    counters = link.status().counters
    assert counters.connections >= 2
    assert counters.failures >= 1
    assert counters.stalls >= stalls
    check(frames)


def test_unplug_and_replug(connect, left, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    left.control.unplugged = 1
    eventually(lambda: link.status().state is LinkState.WAITING, link.status)
    eventually(lambda: "has been unplugged" in link.status().reason, link.status)
    seen = len(frames)
    failures = link.status().counters.failures
    eventually(lambda: link.status().counters.failures > failures + 2, link.status)
    assert len(frames) == seen
    assert link.status().rate_hz == 0.0
    left.control.next_sequence = 10**9
    left.control.unplugged = 0
    flowing(frames, eventually, link)
    assert link.status().reason == ""
    assert link.status().counters.lost < 100_000
    check(frames)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"unplugged": 1}, "has been unplugged"),
        ({"busy": 1}, "in use by another program"),
        ({"stalled": 1}, "sent nothing for 0.3 s"),
        ({"width": 32}, "gives Y16 32x48 when asked for Y16 64x48"),
    ],
    ids=str,
)
def test_a_camera_that_is_not_ready_at_the_start_is_waited_for(
    connect, left, eventually, fault, reason
):
    config = left.config()
    for name, value in fault.items():
        setattr(left.control, name, value)
    link, frames = connect(width=config.width, start_timeout_s=0.3)
    eventually(lambda: reason in link.status().reason, link.status)
    left.control.width = config.width
    for name in set(fault) - {"width"}:
        setattr(left.control, name, 0)
    flowing(frames, eventually, link)


def test_a_refused_start_is_tried_again(connect, left, eventually):
    left.control.streamon_errno = errno.EPROTO
    link, frames = connect()
    flowing(frames, eventually, link)
    assert link.status().counters.failures == 1


def test_no_signal_is_told_and_its_noise_kept_from_the_odometry(connect, left, eventually):
    left.control.no_signal = 1
    link, frames = connect()
    eventually(lambda: link.status().state is LinkState.NO_SIGNAL, link.status)
    eventually(lambda: link.status().counters.no_signal > 5, link.status)
    assert "reports no signal: check the video cable" in link.status().reason
    assert frames == []
    left.control.no_signal = 0
    flowing(frames, eventually, link)
    assert link.status().state is LinkState.STREAMING
    assert link.status().reason == ""


def test_a_silent_input_without_signal_is_not_opened_again_and_again(connect, left, eventually):
    left.control.no_signal = left.control.stalled = 1
    link, frames = connect(timeout_s=0.05, start_timeout_s=0.05)
    eventually(lambda: link.status().state is LinkState.NO_SIGNAL, link.status)
    time.sleep(0.6)
    status = link.status()
    assert (status.counters.connections, status.counters.stalls) == (1, 0)
    assert "no signal" in status.reason
    left.control.no_signal = left.control.stalled = 0
    flowing(frames, eventually, link)


def test_a_name_that_nobody_has_yet_is_waited_for(connect, left, eventually, tmp_path):
    name = tmp_path / "by-path"
    link, frames = connect(device=str(name))
    eventually(lambda: "no video device" in link.status().reason, link.status)
    assert frames == []


def test_a_fault_of_the_listener_does_not_end_the_stream(left, eventually):
    frames = []

    def on_frame(frame):
        frames.append(frame)
        if len(frames) == 3:
            raise ZeroDivisionError

    link = CameraLink("left", left.config(), on_frame, clock=EpochClock(), recovery=RECOVERY)
    link.start()
    try:
        flowing(frames, eventually, link, more=10)
    finally:
        link.stop()
    assert link.status().counters.failures == 1


def test_stop_is_final_and_start_begins_again(connect, eventually):
    link, frames = connect()
    flowing(frames, eventually, link)
    link.stop()
    seen = len(frames)
    time.sleep(0.05)
    assert len(frames) == seen
    assert link.status().state is LinkState.CLOSED
    link.start()
    flowing(frames, eventually, link)
    check(frames)
    np.testing.assert_equal(frames[-1].image.shape, (48, 64))
