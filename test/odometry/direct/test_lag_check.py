"""A second camera whose stamps come from another clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.odometry.direct.lag_check import LagCheck
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry

from .test_rig_check import SETTINGS
from .two_band_room import Room, sway

LIMIT_S, SURE_S = 2.5e-3, 3e-5


def checked(lags_s, sigma_s=SURE_S):
    check = LagCheck(LIMIT_S)
    told = []
    for lag_s in lags_s:
        check.add(lag_s, sigma_s)
        told.append(check.drift_s)
    return told


@pytest.mark.parametrize("lag_s", [-0.02, 0.0, 0.03])
def test_a_lag_that_stands_is_no_fault(rng, lag_s):
    assert checked(lag_s + 3e-4 * rng.uniform(-1.0, 1.0, 50)) == [None] * 50


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_lag_that_grows_is_told_with_how_far(sign):
    told = checked(sign * 1e-3 * np.arange(8))
    assert told[:3] == [None] * 3
    np.testing.assert_allclose(told[3:], 1e-3 * np.arange(3, 8))


def test_one_jump_is_told_until_it_is_past():
    told = checked([*np.zeros(6), *np.full(20, 4e-3)])
    assert told[:6] == [None] * 6
    assert all(drift_s == pytest.approx(4e-3) for drift_s in told[6:15])
    assert told[15:] == [None] * 11


def test_what_is_told_stays_told_until_half_the_limit():
    check = LagCheck(LIMIT_S)
    for lag_s in (0.0, 0.0, 0.0, 3e-3, *np.full(9, 1.5e-3)):
        check.add(lag_s, SURE_S)
    assert check.drift_s == pytest.approx(1.5e-3)
    check.add(1.5e-3, SURE_S)
    assert check.drift_s is None


def test_windows_that_cannot_tell_the_lag_do_not_count():
    assert checked(1e-3 * np.arange(20), sigma_s=1e-4) == [None] * 20


@pytest.mark.parametrize("seed", range(3))
def test_stamps_that_roll_are_told_and_give_no_metres(seed):
    """Thermal pictures are older than said by ever more, 8 ms a second, and jitter by 4 ms."""
    room, rng = Room(3 + seed), np.random.default_rng(5 + seed)
    wander = np.random.default_rng(6 + seed)
    odometry = create_odometry(with_overrides(OdometryConfig(), SETTINGS))
    results = []
    for i in range(55):
        late_s = 4e-4 * i + 4e-3 * wander.uniform(-1.0, 1.0)
        now = room.frame(i, sway(0.05 * i), rng)
        then = room.frame(i, sway(0.05 * i - late_s), rng)
        frame = replace(now, views={**now.views, THERMAL: then.views[THERMAL]})
        results.append(odometry.process(frame))
    assert not any(result.scale_converged for result in results)
    assert results[-1].status is TrackingStatus.DEGRADED
    assert "let one clock stamp both" in results[-1].reason


def test_stamps_that_begin_to_roll_when_metres_are_known_are_told():
    """12 ms a second; until then it is told nothing."""
    room, rng = Room(3), np.random.default_rng(5)
    odometry = create_odometry(with_overrides(OdometryConfig(), SETTINGS))
    before, after = [], []
    for i in range(90):
        late_s = 6e-4 * max(0, i - 55)
        now = room.frame(i, sway(0.05 * i), rng)
        then = room.frame(i, sway(0.05 * i - late_s), rng)
        frame = replace(now, views={**now.views, THERMAL: then.views[THERMAL]})
        (before if i < 55 else after).append(odometry.process(frame))
    assert before[-1].scale_converged
    assert not any("clock" in result.reason for result in before)
    assert after[-1].status is TrackingStatus.DEGRADED
    assert "let one clock stamp both" in after[-1].reason
