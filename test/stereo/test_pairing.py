"""Pairs: nothing lost, nothing mixed up, nothing late, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.errors import OutOfOrderError
from thermal_stereo_vo.stereo.pairing import Pair, PairingConfig, StereoPairer

MS = 1_000_000
PERIOD = 33 * MS


@dataclass(frozen=True)
class Item:
    stamp_ns: int
    number: int = 0
    camera: str = "left"


def pairer(tolerance_ms=10.0, max_waiting=4) -> StereoPairer[Item]:
    return StereoPairer(PairingConfig(tolerance_ms=tolerance_ms, max_waiting=max_waiting))


def run(pairer, arrivals):
    """All pairs of ``arrivals`` [(stream, stamp_ns), ...] and the flush after them."""
    pairs = []
    for index, stamp_ns in arrivals:
        pairs += pairer.push(index, Item(stamp_ns))
    return pairs + list(pairer.flush())


def stamps(pair: Pair):
    return tuple(None if item is None else item.stamp_ns for item in (pair.first, pair.second))


@st.composite
def jittered_streams(draw):
    """Two streams whose stamps err by less than half the tolerance, arriving in any interleaving
    in which neither is more than two frames ahead."""
    n = draw(st.integers(1, 25))
    jitter = st.integers(-5 * MS + 1, 5 * MS - 1)
    times = [[k * PERIOD + draw(jitter) for k in range(n)] for _ in range(2)]
    arrivals, sent = [], [0, 0]
    while sum(sent) < 2 * n:
        index = draw(st.integers(0, 1))
        if sent[index] == n or sent[index] - sent[1 - index] >= 2:
            index = 1 - index
        arrivals.append((index, times[index][sent[index]]))
        sent[index] += 1
    return times, arrivals


@given(jittered_streams())
def test_jitter_within_half_the_tolerance_pairs_everything_in_order(streams):
    times, arrivals = streams
    p = pairer()
    assert [stamps(pair) for pair in run(p, arrivals)] == list(zip(*times, strict=True))
    assert p.counters.pairs == len(times[0])
    assert p.counters.first_alone == p.counters.second_alone == 0


@given(jittered_streams(), st.sets(st.tuples(st.integers(0, 1), st.integers(0, 24))))
def test_drops_leave_their_partners_alone_and_all_others_paired(streams, dropped):
    times, arrivals = streams
    number = {(i, t): k for i in (0, 1) for k, t in enumerate(times[i])}
    kept = [a for a in arrivals if (a[0], number[a]) not in dropped]
    p = pairer(max_waiting=100)
    pairs = run(p, kept)
    expected = [
        tuple(None if (i, k) in dropped else times[i][k] for i in (0, 1))
        for k in range(len(times[0]))
    ]
    assert [stamps(pair) for pair in pairs] == [e for e in expected if e != (None, None)]


@given(
    st.lists(st.integers(0, 10**9), unique=True, max_size=40).map(sorted),
    st.lists(st.integers(0, 10**9), unique=True, max_size=40).map(sorted),
    st.randoms(use_true_random=False),
    st.integers(1, 6),
)
def test_whatever_comes_pairs_increase_respect_the_tolerance_and_use_items_once(
    first, second, random, max_waiting
):
    arrivals = [(0, t) for t in first] + [(1, t) for t in second]
    random.shuffle(arrivals)
    remaining = [iter(first), iter(second)]
    arrivals = [(index, next(remaining[index])) for index, _ in arrivals]
    p = pairer(tolerance_ms=10.0, max_waiting=max_waiting)
    pairs = []
    for index, stamp_ns in arrivals:
        pairs += p.push(index, Item(stamp_ns))
        assert all(len(queue) <= max_waiting for queue in p._queues)
    pairs += p.flush()
    times = [pair.stamp_ns for pair in pairs]
    assert times == sorted(set(times))
    for pair in pairs:
        assert abs(pair.skew_ns) <= 10 * MS
    for side, sent in (("first", first), ("second", second)):
        used = [item.stamp_ns for pair in pairs if (item := getattr(pair, side)) is not None]
        assert used == sorted(set(used))
        assert set(used) <= set(sent)
    c = p.counters
    assert c.pairs + c.first_alone == len(first)
    assert c.pairs + c.second_alone == len(second)
    # A pair that would turn back time is counted, but not passed on.
    assert sum(None not in (pair.first, pair.second) for pair in pairs) <= c.pairs


def test_the_common_stamp_is_that_of_the_first_camera_and_the_skew_is_second_minus_first():
    pairs = run(pairer(), [(0, 100 * MS), (1, 103 * MS), (1, 130 * MS), (0, 133 * MS)])
    assert [(p.stamp_ns, p.skew_ns) for p in pairs] == [(100 * MS, 3 * MS), (133 * MS, -3 * MS)]


def test_the_tolerance_itself_still_pairs():
    assert stamps(run(pairer(), [(0, 0), (1, 10 * MS)])[0]) == (0, 10 * MS)
    assert [stamps(p) for p in run(pairer(), [(0, 0), (1, 10 * MS + 1)])] == [
        (0, None),
        (None, 10 * MS + 1),
    ]


def test_the_nearer_of_two_candidates_wins():
    """A doubled frame must not steal the partner of the right one."""
    pairs = run(pairer(), [(0, 0), (0, 8 * MS), (1, 9 * MS)])
    assert [stamps(p) for p in pairs] == [(0, None), (8 * MS, 9 * MS)]
    pairs = run(pairer(), [(1, 0), (1, 8 * MS), (0, 9 * MS)])
    assert [stamps(p) for p in pairs] == [(None, 0), (9 * MS, 8 * MS)]


def test_pairs_come_out_as_soon_as_they_are_decided():
    p = pairer()
    assert list(p.push(0, Item(0))) == []
    assert [stamps(pair) for pair in p.push(1, Item(2 * MS))] == [(0, 2 * MS)]
    assert list(p.flush()) == []


def test_a_frame_is_known_to_be_alone_once_the_other_stream_has_passed_it():
    p = pairer()
    assert list(p.push(0, Item(0))) == []
    assert [stamps(pair) for pair in p.push(1, Item(PERIOD))] == [(0, None)]
    assert [stamps(pair) for pair in p.push(0, Item(PERIOD))] == [(PERIOD, PERIOD)]


def test_a_silent_camera_does_not_stop_the_other():
    p = pairer(max_waiting=3)
    out = [stamps(pair) for k in range(10) for pair in p.push(1, Item(k * PERIOD))]
    assert out == [(None, k * PERIOD) for k in range(7)]
    assert p.counters.second_alone == 7


def test_what_comes_too_late_is_counted_and_not_passed_on():
    """After frames went on alone, their partners must not turn back time."""
    p = pairer(max_waiting=1)
    out = []
    for k in range(4):
        out += p.push(0, Item(k * PERIOD))
    assert [pair.stamp_ns for pair in out] == [0, PERIOD, 2 * PERIOD]
    assert list(p.push(1, Item(1 * PERIOD))) == []
    assert p.counters.second_alone == 1
    assert [stamps(pair) for pair in p.push(1, Item(3 * PERIOD))] == [(3 * PERIOD, 3 * PERIOD)]


@pytest.mark.parametrize("again", [100, 99])
def test_a_stamp_that_does_not_increase_is_refused_and_changes_nothing(again):
    p = pairer()
    list(p.push(0, Item(100, camera="left")))
    with pytest.raises(
        OutOfOrderError,
        match=rf"camera 'left': stamp {again} ns does not come after 100 ns; replay recordings in "
        "order, or reset after a jump of the clock",
    ):
        p.push(0, Item(again, camera="left"))
    assert [stamps(pair) for pair in p.push(1, Item(100))] == [(100, 100)]


def test_streams_without_a_name_are_called_first_and_second():
    @dataclass(frozen=True)
    class Anonymous:
        stamp_ns: int

    p = StereoPairer(PairingConfig())
    list(p.push(1, Anonymous(5)))
    with pytest.raises(OutOfOrderError, match="camera 'second'"):
        p.push(1, Anonymous(5))


def test_zero_tolerance_pairs_equal_stamps_only():
    pairs = run(pairer(tolerance_ms=0.0), [(0, 0), (1, 0), (0, 5), (1, 6)])
    assert [stamps(p) for p in pairs] == [(0, 0), (5, None), (None, 6)]
