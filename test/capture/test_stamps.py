"""Stamps and sequence numbers of one camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.stamps import SequenceCounter, StampSource
from thermal_stereo_vo.capture.v4l2 import Grab, StampKind

MS = 1_000_000
OFFSET = 1_790_000_000_000_000_000


def grab(driver_ns, arrival_ns, kind=StampKind.END_OF_FRAME, sequence=0):
    return Grab(np.zeros((2, 2), np.uint16), sequence, driver_ns, kind, arrival_ns)


def source(offset_ns=0):
    return StampSource(EpochClock(lambda: OFFSET), offset_ns)


def test_the_driver_s_stamp_plus_the_latency_of_its_grabber():
    stamps = source(offset_ns=-33 * MS)
    assert stamps.stamp_ns(grab(500 * MS, 507 * MS)) == OFFSET + 467 * MS
    assert stamps.kind is StampKind.END_OF_FRAME
    assert stamps.by_arrival == 0


def test_a_stamp_ahead_of_its_arrival_is_kept():
    # Some drivers stamp the end of the frame before it has come.
    assert source().stamp_ns(grab(528 * MS, 500 * MS)) == OFFSET + 528 * MS


def test_a_driver_without_monotonic_clock_is_stamped_on_arrival():
    stamps = source()
    unknown = grab(123, 500 * MS, kind=StampKind.UNKNOWN_CLOCK)
    assert stamps.stamp_ns(unknown) == OFFSET + 500 * MS
    assert stamps.by_arrival == 1


def test_wrapped_stamps_are_replaced_by_arrival_and_the_stream_goes_on():
    stamps = source()
    wraps = [2**63 - 16 * 10**9, -(2**63) + 5, (2**31 - 1) * 10**9]
    taken = [stamps.stamp_ns(grab(wrap, (n + 1) * 33 * MS)) for n, wrap in enumerate(wraps)]
    assert taken == [OFFSET + 33 * MS, OFFSET + 66 * MS, OFFSET + 99 * MS]
    assert stamps.by_arrival == 3


def test_a_stamp_that_does_not_advance_is_refused_and_counted():
    stamps = source()
    assert stamps.stamp_ns(grab(40 * MS, 41 * MS)) is not None
    assert stamps.stamp_ns(grab(40 * MS, 42 * MS)) is None
    assert stamps.stamp_ns(grab(39 * MS, 43 * MS)) is None
    assert stamps.stamp_ns(grab(41 * MS, 44 * MS)) == OFFSET + 41 * MS
    assert stamps.backwards == 2


def test_sequence_gaps_are_counted_over_the_wrap():
    counter = SequenceCounter()
    numbers = [counter.update(s % 2**32) for s in (2**32 - 2, 2**32 - 1, 2**32, 2**32 + 3)]
    assert numbers == [0, 1, 2, 5]
    assert counter.lost == 2


def test_frames_lost_over_the_wrap_are_counted():
    counter = SequenceCounter()
    assert [counter.update(s) for s in (2**32 - 2, 1)] == [0, 3]
    assert counter.lost == 2


def test_a_restart_continues_the_count():
    counter = SequenceCounter()
    counter.update(70)
    counter.update(71)
    counter.restart()
    assert counter.update(0) == 2
    assert counter.update(4) == 6
    assert counter.lost == 3


@given(st.lists(st.integers(0, 2**32 - 1)))
def test_our_count_always_grows(sequences):
    counter = SequenceCounter()
    numbers = [counter.update(sequence) for sequence in sequences]
    assert all(b > a for a, b in pairwise(numbers))
    assert counter.lost == (numbers[-1] + 1 - len(numbers) if numbers else 0)
