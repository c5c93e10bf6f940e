from __future__ import annotations

import pytest

from thermal_stereo_vo.radiometry.repeats import LONGEST_NATIVE_RUN, NativeRepeats


def feed(repeats: NativeRepeats, run: int) -> list[bool]:
    """One new image and its repeats; which of them are by design."""
    repeats.renewed()
    return [repeats.repeated() for _ in range(run)]


def test_a_stream_that_never_repeats_allows_none():
    repeats = NativeRepeats()
    for _ in range(10):
        feed(repeats, 0)
    assert repeats.limit == 0
    assert repeats.repeated() is False


@pytest.mark.parametrize("runs", [[1], [2, 3], [6, 7], [0, 1], [0, 0, 0, 0, 1]])
def test_the_ratio_of_a_link_is_learnt(runs):
    """9 Hz on 30 and 60 Hz, 20 and 25 Hz on 30 Hz."""
    repeats = NativeRepeats()
    for index in range(40):
        verdicts = feed(repeats, runs[index % len(runs)])
        assert all(verdicts) or index < 16
    verdicts = feed(repeats, 30)
    assert sum(verdicts) == min(max(runs) + 1, LONGEST_NATIVE_RUN)


def test_single_hiccups_teach_nothing():
    repeats = NativeRepeats()
    for index in range(20):
        feed(repeats, 1 if index % 10 == 0 else 0)
    assert repeats.limit == 0


def test_a_freeze_teaches_nothing():
    repeats = NativeRepeats()
    for _ in range(10):
        feed(repeats, 0)
    for _ in range(10):
        for _ in range(15):
            repeats.repeated()
        repeats.restart()
    assert repeats.limit == 0
