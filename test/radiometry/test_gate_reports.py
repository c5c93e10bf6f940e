"""Images and the reports of their gate find each other, whichever comes first."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame
from thermal_stereo_vo.radiometry.gate_reports import GatedFrames, GateReport

GAP = Gap(40, GapReason.FFC, True)
BLIND = {3, 4, 5}


def image(stamp_ns: int) -> RadiometricFrame:
    return RadiometricFrame(np.full((2, 2), stamp_ns, np.uint16), stamp_ns, "left")


def report(i: int, skew_ns: int = 0) -> GateReport:
    blind = GapReason.FROZEN if i in BLIND else None
    return GateReport(10 * i + skew_ns, int(i > 5), GAP if i == 6 else None, blind)


def told(frames) -> list[tuple[int, bool, int, Gap | None]]:
    return [(f.stamp_ns, f.image is None, f.epoch, f.gap) for f in frames]


EXPECTED = [(10 * i, i in BLIND, int(i > 5), GAP if i == 6 else None) for i in range(10)]


@given(st.lists(st.booleans(), min_size=40, max_size=40))
def test_any_interleaving_gives_the_frames_as_they_left_the_gate(reports_first):
    gated = GatedFrames("left", most_waiting=50)
    images = [image(10 * i) for i in range(10) if i not in BLIND]
    reports = [report(i) for i in range(10)]
    got = []
    for first in reports_first:
        if reports and (first or not images):
            got += gated.told(reports.pop(0))
        elif images:
            got += gated.seen(images.pop(0))
    assert told(got) == EXPECTED
    assert [f.sequence for f in got] == list(range(10))
    assert [f.blind for f in got] == [GapReason.FROZEN if i in BLIND else None for i in range(10)]


@pytest.mark.parametrize("skew_ns", [-4, 4])
def test_stamps_may_differ_within_the_tolerance(skew_ns):
    gated = GatedFrames("right", tolerance_ns=4)
    got = []
    for i in range(10):
        got += gated.told(report(i, skew_ns))
        if i not in BLIND:
            got += gated.seen(image(10 * i))
    assert [f.gap for f in got] == [GAP if i == 6 else None for i in range(10)]
    assert [f.stamp_ns for f in got] == [10 * i + skew_ns * (i in BLIND) for i in range(10)]


def test_an_image_whose_report_is_lost_goes_on():
    gated = GatedFrames("left")
    got = list(itertools.chain(*(gated.seen(image(10 * i)) for i in range(3))))
    assert got == []
    got += gated.told(report(2))
    assert told(got) == [(0, False, 0, None), (10, False, 0, None), (20, False, 0, None)]
    for i in range(3, 9):  # no reports at all any more
        got += gated.seen(image(10 * i))
    assert [f.stamp_ns for f in got] == [0, 10, 20, 30, 40]


def test_the_gap_of_a_lost_image_travels_with_the_next():
    gated = GatedFrames("left")
    got = [*gated.told(report(5)), *gated.told(report(6)), *gated.told(report(7))]
    got += gated.seen(image(70))
    assert told(got) == [(50, True, 0, None), (70, False, 1, GAP)]


def test_reports_without_images_do_not_pile_up():
    gated = GatedFrames("left", most_waiting=4)
    got = [frame for i in range(6, 30) for frame in gated.told(report(i))]
    assert got == []
    assert told(gated.seen(image(290))) == [(290, False, 1, GAP)]
    assert told(gated.told(report(30))) == []
    assert told(gated.seen(image(300))) == [(300, False, 1, None)]
