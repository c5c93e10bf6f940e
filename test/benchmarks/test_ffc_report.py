"""The figures that tell what a correction in flight costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.ffc import (
    FLIGHTS,
    SCHEDULES,
    FfcCell,
    error_ratio,
    ffc_report,
    jump_sigmas,
    largest_jump_sigmas,
    measure_all,
    scatter_m,
    unforeseen,
)
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.pipeline import Config

TRACKING, GAP, LOST = TrackingStatus.TRACKING, TrackingStatus.GAP, TrackingStatus.LOST
STEP_NS = 50_000_000
CLAIMED = np.diag([0.01**2] * 3 + [0.002**2] * 3)
TWIST = np.array([0.0, 0.0, 4.0, 0.0, 1.0, 0.0])
T_START = exp_se3([3.0, -1.0, 2.0, 0.4, -0.9, 0.2])


def result(i: int, T, status=GAP) -> OdometryResult:
    return OdometryResult(i * STEP_NS, status, T, CLAIMED, twist=TWIST)


def test_who_goes_on_with_its_twist_does_not_jump():
    after = T_START @ exp_se3(TWIST * 0.05)
    position, attitude = jump_sigmas(result(0, T_START), result(1, after))
    assert position < 0.6  # the way is curved by 2.5 mm
    assert attitude < 1e-6


@pytest.mark.parametrize("axis", range(3))
def test_a_jump_counts_in_what_was_claimed(axis):
    sigma_m, sigma_rad = np.sqrt(np.diag(CLAIMED + unforeseen(0.05)))[[0, 3]]
    on_course = T_START @ exp_se3(TWIST * 0.05)
    way = np.linalg.norm(on_course[:3, 3] - T_START[:3, 3])
    assert way == pytest.approx(0.2, rel=0.01)
    straight = result(0, T_START)
    shifted = on_course.copy()
    shifted[:3, 3] = T_START[:3, 3] + T_START[:3, :3] @ TWIST[:3] * 0.05
    shifted[axis, 3] += 4.0 * sigma_m
    assert jump_sigmas(straight, result(1, shifted))[0] == pytest.approx(4.0)
    turned = exp_se3([0, 0, 0, *(5.0 * sigma_rad * np.eye(3)[axis])]) @ on_course
    assert jump_sigmas(straight, result(1, turned))[1] == pytest.approx(5.0, rel=0.01)


def test_the_largest_jump_is_sought_where_there_are_poses():
    still = replace(result(0, T_START), twist=np.zeros(6))
    far = T_START.copy()
    far[0, 3] += 1.0
    jumped = replace(still, stamp_ns=STEP_NS, T_world_rig=far, status=TRACKING)
    expected = 1.0 / np.sqrt(0.01**2 + unforeseen(0.05)[0, 0])
    assert largest_jump_sigmas([still, jumped]) == pytest.approx(expected)
    lost = OdometryResult(STEP_NS, LOST, None, None)
    assert largest_jump_sigmas([still, lost, replace(jumped, stamp_ns=2 * STEP_NS)]) == 0.0


def test_scatter_is_the_noise_and_not_the_drift(rng):
    drift = np.linspace(0.0, 0.2, 4000)[:, None] * [1.0, 0.0, 0.5]
    errors_m = drift + rng.normal(0.0, 0.003, (4000, 3))
    assert scatter_m(errors_m) == pytest.approx(0.003 * np.sqrt(3), rel=0.05)


def cell(schedule: str, final_m: float, seed: int = 0, scatter: float = 0.001) -> FfcCell:
    return FfcCell("hover", schedule, seed, final_m, None, scatter, 50.0, 0.5, 3, 0)


def test_ratio_is_of_the_squares_and_never_below_the_noise():
    none = [cell("none", 0.003), cell("none", 0.004, 1)]
    some = [cell("together, 1 s", 0.006), cell("together, 1 s", 0.008, 1)]
    assert error_ratio(some, none) == pytest.approx(2.0)
    assert error_ratio(none, none) == 1.0
    noisy = [replace(c, scatter_m=0.005) for c in none]
    assert error_ratio(some, noisy) == pytest.approx(np.sqrt(50.0) / 5.0)
    assert error_ratio([cell("together, 1 s", 0.0001)], noisy) == 1.0


def test_a_row_for_each_schedule():
    cells = [
        cell("none", 0.003),
        replace(cell("none", 0.004, 1), silence_ms=51.0),
        cell("staggered, 1 s", 0.005),
    ]
    lines = ffc_report(cells, with_imu=False).splitlines()
    assert lines[2].split() == ["hover", "none", "2", "3.5", "4.0", "1.0", "1.00", "51", "0.50",
                                "3.0", "0"]  # fmt: skip
    assert lines[3].split()[1:5] == ["staggered,", "1", "s", "1"]
    assert lines[3].split()[8] == "1.41"


def test_hover_is_flown_under_every_schedule(tmp_path):
    """Few and small pictures: that the corrections take place, not their price."""
    told = []
    cells = list(measure_all([3], Config(), 4.0, 0.25, tmp_path, ["hover"], lambda: told.append(1)))
    assert [c.schedule for c in cells] == list(SCHEDULES)
    assert len(told) == len(SCHEDULES)
    gaps = {c.schedule: c.gap_frames for c in cells}
    assert gaps["none"] == gaps["staggered, 0.5 s"] == 0
    assert 1 <= gaps["together, 0.5 s"] < gaps["together, 1 s"] <= 5
    assert all(c.silence_ms == pytest.approx(250.0) for c in cells)
    assert [path.name for path in tmp_path.iterdir()] == ["hover_4hz_0.25"]


def test_corrections_lie_within_the_flights():
    for leg in FLIGHTS.values():
        assert leg.first_s + leg.stagger_s + 1.0 < 13.0
        assert leg.stagger_s > 1.0  # never both at once when staggered
