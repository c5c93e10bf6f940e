"""Monotonic to ROS time."""

from __future__ import annotations

import time
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.capture.clock import MAX_SLEW, STEP_NS, EpochClock, sample_offset_ns

SECOND = 1_000_000_000
OFFSET = 1_790_000_000 * SECOND


class SystemClock:
    """The offset of a system clock that a test sets."""

    def __init__(self, offset_ns):
        self.offset_ns = offset_ns

    def __call__(self):
        return self.offset_ns


def test_the_offset_is_that_of_the_two_clocks():
    truth_ns = time.time_ns() - time.monotonic_ns()
    assert abs(sample_offset_ns() - truth_ns) < 50_000_000
    clock = EpochClock()
    assert abs(clock.to_epoch_ns(time.monotonic_ns()) - time.time_ns()) < 50_000_000


def test_stamps_are_exact_integers():
    clock = EpochClock(SystemClock(OFFSET + 1))
    assert clock.to_epoch_ns(123_456_789_012_345_679) == OFFSET + 123_456_789_012_345_680


@pytest.mark.parametrize("drift", [+100e-6, -100e-6])
def test_a_drifting_clock_is_followed(drift):
    system = SystemClock(OFFSET)
    clock = EpochClock(system)
    errors = []
    for frame in range(3000):
        now_ns = frame * SECOND // 30
        system.offset_ns = OFFSET + round(drift * now_ns)
        errors.append(clock.to_epoch_ns(now_ns) - (now_ns + system.offset_ns))
    # One look a second: the offset lags by at most two seconds of drift, and does lag.
    assert 50_000 < max(map(abs, errors)) < 250_000
    assert clock.steps == 0


def test_a_correction_does_not_run_on_while_no_frame_comes():
    system = SystemClock(OFFSET)
    clock = EpochClock(system)
    clock.to_epoch_ns(0)
    system.offset_ns -= 10_000_000
    clock.to_epoch_ns(2 * SECOND)
    later_ns = 1000 * SECOND
    assert -10_000_000 <= clock.to_epoch_ns(later_ns) - later_ns - OFFSET < 0


def test_a_clock_set_forward_is_followed_at_once():
    system = SystemClock(OFFSET)
    clock = EpochClock(system)
    assert clock.to_epoch_ns(0) == OFFSET
    system.offset_ns += 3600 * SECOND
    assert clock.to_epoch_ns(2 * SECOND) == OFFSET + 3602 * SECOND
    assert clock.steps == 1


def test_a_clock_set_back_is_only_crept_after():
    system = SystemClock(OFFSET)
    clock = EpochClock(system)
    clock.to_epoch_ns(0)
    system.offset_ns -= 10 * SECOND
    stamps = [clock.to_epoch_ns(n * SECOND // 10) for n in range(1, 601)]
    steps = [b - a for a, b in pairwise(stamps)]
    assert min(steps) >= SECOND // 10 * (1 - MAX_SLEW) - 1
    assert clock.steps == 0
    assert 9.9 * SECOND < clock.behind_ns < 10 * SECOND
    crept_ns = OFFSET + 60 * SECOND - stamps[-1]
    assert crept_ns == pytest.approx(MAX_SLEW * 59 * SECOND, rel=0.05)


@given(
    st.lists(
        st.tuples(st.integers(1, 3 * SECOND), st.integers(-3 * STEP_NS, 3 * STEP_NS)), min_size=2
    )
)
@settings(deadline=None)
def test_stamps_never_go_backwards_whatever_the_system_clock_does(frames):
    system = SystemClock(OFFSET)
    clock = EpochClock(system)
    now_ns, last = 0, clock.to_epoch_ns(0)
    for step_ns, jump_ns in frames:
        now_ns += step_ns
        system.offset_ns += jump_ns
        stamp = clock.to_epoch_ns(now_ns)
        assert stamp - last >= step_ns * (1 - MAX_SLEW) - 1
        last = stamp
