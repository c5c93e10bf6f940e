"""Both cameras: pairs under one stamp, one eye lost and found, and nothing that grows."""

from __future__ import annotations

import gc
import threading
from itertools import groupby, islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.capture.control_link import ControlConfig
from thermal_stereo_vo.capture.ffc_policy import FfcConfig
from thermal_stereo_vo.capture.grabber_rig import GrabberConfig, GrabberRig
from thermal_stereo_vo.capture.recovery import LinkState, RecoveryConfig
from thermal_stereo_vo.capture.sync import SyncConfig
from thermal_stereo_vo.core.errors import CaptureError
from thermal_stereo_vo.core.frames import FfcState
from thermal_stereo_vo.stereo.pairing import PairingConfig
from thermal_stereo_vo.stereo_capture import StereoCapture

MS = 1_000_000


class Reader:
    """Collects the pairs of a capture in a thread."""

    def __init__(self, capture):
        self.pairs = []
        self._capture = capture
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        for pair in self._capture.pairs():
            self.pairs.append(pair)

    def complete(self):
        return [pair for pair in self.pairs if pair.complete]

    def join(self):
        self._thread.join(240.0)
        assert not self._thread.is_alive()


@pytest.fixture
def stereo(left, right):
    """Start both cameras; everything is closed after the test."""
    running = []

    def start(
        tolerance_ms=2.6,
        ports=(),
        sync=None,
        waiting_pairs=10_000,
        read=True,
        max_waiting=4,
        **changes,
    ):
        config = GrabberConfig(
            left=left.config(**changes),
            right=right.config(**changes),
            recovery=RecoveryConfig(first_wait_s=0.02, longest_wait_s=0.05),
            control=ControlConfig(
                *(ports or ("", "")), timeout_s=10.0, poll_period_s=0.02, reopen_s=0.05
            ),
            ffc=FfcConfig(period_s=0.0, settle_s=0.02, duration_s=0.1, limit_s=60.0),
        )
        capture = StereoCapture(
            GrabberRig(config),
            PairingConfig(tolerance_ms, max_waiting),
            sync,
            waiting_pairs=waiting_pairs,
        )
        capture.__enter__()
        reader = Reader(capture) if read else None
        running.append((capture, reader))
        return capture, reader

    yield start
    for capture, reader in running:
        capture.close()
        if reader is not None:
            reader.join()
    for device in (left, right):
        assert device.control.opened == device.control.closed


def check(pairs):
    """What must hold for every pair, whatever happened."""
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(pairs))
    for pair in pairs:
        assert pair.frames
        assert all(frame.stamp_ns == pair.stamp_ns for frame in pair.frames.values())
        assert all(frame.camera == eye for eye, frame in pair.frames.items())


def test_both_images_of_a_pair_carry_one_stamp(stereo, eventually):
    capture, reader = stereo()
    eventually(lambda: len(reader.complete()) > 50, capture.status)
    check(reader.pairs)
    assert all(abs(pair.skew_ns) <= 2.6 * MS for pair in reader.pairs)
    assert any(pair.skew_ns != 0 for pair in reader.pairs)
    status = capture.status()
    assert status.counters.pairs >= 50
    assert status.cameras["left"].link.state is LinkState.STREAMING


def test_the_skew_is_measured_and_judged(stereo, left, right, eventually):
    left.control.stamp_shift_ns = -20 * MS
    right.control.stamp_shift_ns = -20 * MS
    capture, reader = stereo(sync=SyncConfig(mode="hardware", max_skew_ms=3.0))
    eventually(lambda: len(reader.complete()) > 40, capture.status)
    phase_ms = capture.status().sync.skew_ms
    # Whatever the phase of the two fakes is: bring them into step, then apart.
    right.control.stamp_shift_ns = round((-20 - phase_ms) * MS)
    eventually(lambda: abs(capture.status().sync.skew_ms) < 0.3, capture.status)
    assert capture.status().sync.warning == ""
    assert capture.status().sync.spread_ms < 10.0


def test_frames_that_find_no_partner_are_dropped_and_counted(stereo, left, right, eventually):
    capture, reader = stereo(tolerance_ms=0.0)
    eventually(lambda: capture.status().counters.unpaired > 5, capture.status)
    # One eye may have streamed before the other, alone.
    alone = capture.status().counters.alone
    eventually(lambda: capture.status().counters.unpaired > 40, capture.status)
    counters = capture.status().counters
    assert (counters.pairs, counters.alone) == (0, alone)
    eventually(lambda: len(reader.pairs) == alone, capture.status)
    check(reader.pairs)


def test_a_lost_eye_does_not_stop_the_other_and_makes_no_half_pair(stereo, right, eventually):
    capture, reader = stereo(max_waiting=100)

    def held_back():
        status = capture.status()
        captured = sum(camera.link.counters.frames for camera in status.cameras.values())
        counters = status.counters
        return captured - 2 * counters.pairs - counters.alone - counters.unpaired

    eventually(lambda: len(reader.complete()) > 10, capture.status)
    alone = capture.status().counters.alone
    right.control.unplugged = 1
    eventually(lambda: capture.status().counters.alone > alone + 20, capture.status)
    eventually(lambda: held_back() <= 3, capture.status)
    eventually(lambda: len(reader.pairs) - len(reader.complete()) > alone + 20, capture.status)
    while_lost = reader.pairs[-10:]
    assert all(set(pair.frames) == {"left"} for pair in while_lost)
    assert all(pair.skew_ns == 0 for pair in while_lost)
    complete = len(reader.complete())
    right.control.unplugged = 0
    eventually(lambda: len(reader.complete()) > complete + 10, capture.status)
    check(reader.pairs)
    assert capture.status().cameras["left"].link.counters.failures == 0
    assert capture.status().cameras["right"].link.counters.connections >= 2


def test_reconnect_opens_both_anew(stereo, eventually):
    capture, reader = stereo()
    eventually(lambda: len(reader.complete()) > 5, capture.status)
    capture.reconnect()
    eventually(
        lambda: all(c.link.counters.connections == 2 for c in capture.status().cameras.values()),
        capture.status,
    )
    complete = len(reader.complete())
    eventually(lambda: len(reader.complete()) > complete + 10, capture.status)
    check(reader.pairs)


def test_a_slow_reader_gets_the_newest_pairs(stereo, eventually):
    capture, reader = stereo(waiting_pairs=2)
    slow = Slow()
    reader.pairs = slow
    eventually(slow.holding.is_set, capture.status)
    overrun = capture.status().counters.overrun
    eventually(lambda: capture.status().counters.overrun >= overrun + 10, capture.status)
    slow.go.set()
    eventually(lambda: len(slow) > 5, capture.status)
    check(list(slow))
    assert slow[1].stamp_ns - slow[0].stamp_ns > 20 * MS


class Slow(list):
    """Holds its first element back."""

    def __init__(self):
        super().__init__()
        self.holding, self.go = threading.Event(), threading.Event()

    def append(self, item):
        self.holding.set()
        assert self.go.wait(240.0)
        super().append(item)


def test_telemetry_and_corrections_of_each_camera(stereo, two_pty_cameras, eventually):
    capture, reader = stereo(ports=tuple(camera.port for camera in two_pty_cameras.values()))

    def states(eye):
        said = [pair.frames[eye].telemetry for pair in list(reader.pairs) if eye in pair.frames]
        return {telemetry.ffc_state for telemetry in said if telemetry is not None}

    eventually(lambda: states("left") and states("right"), capture.status)
    for camera in two_pty_cameras.values():
        camera.ffc_s = 0.5
    two_pty_cameras["right"].sensors[0] = 311
    capture.inhibit_ffc(True)
    assert capture.status().ffc_inhibited
    capture.inhibit_ffc(False)
    assert not capture.status().ffc_inhibited
    capture.do_ffc()
    eventually(lambda: FfcState.COMPLETE in states("left") & states("right"), capture.status)
    assert FfcState.IN_PROGRESS in states("left") & states("right")
    eventually(
        lambda: any(
            said is not None and said.fpa_temperature_kelvin == pytest.approx(304.25)
            for said in (pair.frames["right"].telemetry for pair in reader.complete()[-50:])
        ),
        capture.status,
    )
    for pair in reader.pairs:
        blind = [
            frame.telemetry is not None and frame.telemetry.ffc_state is FfcState.IN_PROGRESS
            for frame in pair.frames.values()
        ]
        assert sum(blind) < 2


def test_without_control_ports_corrections_are_refused(stereo):
    capture, _ = stereo()
    for order in (capture.do_ffc, capture.open_shutter, lambda: capture.inhibit_ffc(True)):
        with pytest.raises(CaptureError, match="no camera has a control port"):
            order()


def test_frames_come_left_before_right(stereo):
    capture, _ = stereo(read=False)
    by_stamp = groupby(capture.frames(), key=lambda frame: frame.stamp_ns)
    together = ([frame.camera for frame in group] for _, group in by_stamp)
    pairs = list(islice((cameras for cameras in together if len(cameras) > 1), 15))
    assert pairs == [["left", "right"]] * 15


def test_five_minutes_worth_of_frames_leave_nothing_behind(stereo, left, right, eventually):
    """9000 pairs, with a lost eye and damaged frames among them: no memory, no descriptors."""
    for device in (left, right):
        device.control.millihertz = 3_000_000
    capture, reader = stereo(waiting_pairs=4)
    reader.pairs = Counted()
    eventually(lambda: capture.status().counters.pairs > 500, capture.status)
    before = _resources()
    for target in range(1500, 9001, 1500):
        right.control.damaged = 20
        if target == 4500:
            right.control.unplugged = 1
            eventually(lambda: not capture.status().cameras["right"].link.rate_hz)
            right.control.unplugged = 0
        eventually(lambda t=target: capture.status().counters.pairs >= t, capture.status)
    after = _resources()
    assert after["descriptors"] <= before["descriptors"]
    assert after["threads"] <= before["threads"]
    assert after["resident_kb"] - before["resident_kb"] < 8192


class Counted(list):
    """Keeps nothing."""

    def append(self, item):
        pass


def _resources():
    gc.collect()
    status = Path("/proc/self/status").read_text()
    numbers = {
        line.split(":")[0]: int(line.split()[1])
        for line in status.splitlines()
        if line.startswith(("VmRSS", "Threads"))
    }
    return {
        "descriptors": len(list(Path("/proc/self/fd").iterdir())),
        "threads": numbers["Threads"],
        "resident_kb": numbers["VmRSS"],
    }


def test_images_are_those_of_their_camera(stereo, left, right, eventually):
    capture, reader = stereo()
    eventually(lambda: len(reader.complete()) > 3, capture.status)
    for pair in reader.complete():
        for frame in pair.frames.values():
            y, x = np.mgrid[:48, :64]
            # The fake's pattern, up to the offset that its frame count gives.
            rest = (frame.image.astype(np.int64) - x * 7 - y * 13) % 65536
            assert len(np.unique(rest)) == 1
            assert rest[0, 0] % 101 == 0
