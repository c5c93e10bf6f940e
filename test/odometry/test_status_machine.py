"""What a method may claim, and for how long it may guess."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.errors import OutOfOrderError
from thermal_stereo_vo.core.results import TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.odometry_state import Lag, OdometryState, with_reasons, with_stages
from thermal_stereo_vo.odometry.status_machine import StatusConfig, StatusMachine

S = 1_000_000_000
INITIALISING, TRACKING, DEGRADED, GAP, LOST = (
    TrackingStatus.INITIALISING,
    TrackingStatus.TRACKING,
    TrackingStatus.DEGRADED,
    TrackingStatus.GAP,
    TrackingStatus.LOST,
)


def machine(degraded_inliers=30, coast_max_s=1.0) -> StatusMachine:
    return StatusMachine(StatusConfig(degraded_inliers, coast_max_s))


def test_before_the_first_frame_there_is_nothing_to_lose():
    m = machine()
    assert m.unmeasured(0) is INITIALISING
    assert m.unmeasured(100 * S) is INITIALISING
    assert m.unseen_s(100 * S) == 0.0
    assert m.started(101 * S) is INITIALISING


@pytest.mark.parametrize(("inliers", "status"), [(29, DEGRADED), (30, TRACKING), (500, TRACKING)])
def test_thin_measurements_are_degraded(inliers, status):
    m = machine()
    m.started(0)
    assert m.measured(S, inliers) is status
    assert m.reset_counter == 0


def test_coasting_ends_exactly_when_it_is_worth_nothing():
    m = machine(coast_max_s=1.0)
    m.started(0)
    m.measured(10 * S, 100)
    assert m.unmeasured(10 * S + S // 2) is GAP
    assert m.unmeasured(11 * S) is GAP
    assert m.unmeasured(11 * S + 1) is LOST
    assert m.unseen_s(11 * S + 1) == pytest.approx(1.0)


def test_a_gap_ends_without_a_reset_and_a_loss_with_one():
    m = machine()
    m.started(0)
    m.unmeasured(S // 2)
    assert m.measured(S, 100) is TRACKING
    assert m.reset_counter == 0
    m.unmeasured(3 * S)
    assert m.status is LOST
    assert m.measured(3 * S + 1, 5) is DEGRADED
    assert m.reset_counter == 1


def test_lost_stays_lost_until_measured():
    """Also when a clock that stands still would make the gap look short."""
    m = machine()
    m.started(0)
    m.unmeasured(2 * S)
    assert m.unmeasured(2 * S + 1) is LOST
    assert m.unmeasured(50 * S) is LOST
    assert m.reset_counter == 0


def test_no_coasting_at_all():
    m = machine(coast_max_s=0.0)
    m.started(0)
    assert m.unmeasured(1) is LOST


# ----------------------------------------------------------------------------------- odometry state

T_STEP = exp_se3([0.05, 0.0, 0.4, 0.0, 0.02, 0.0])  # before from after
C_STEP = np.diag([1e-4] * 3 + [1e-6] * 3)
T_START = exp_se3([1.0, 2.0, 3.0, 0.3, -0.2, 0.1])


def state(coast_max_s=1.0) -> OdometryState:
    return OdometryState(StatusConfig(30, coast_max_s), T_START)


def step(s: OdometryState, stamp_ns: int, measured: bool, inliers: int = 100):
    """One frame, measured (one more T_STEP per 0.1 s) or not."""
    elapsed_s = s.advance(stamp_ns)
    if not measured:
        return s.unmeasured(TrackStats(), "dark")
    pose = s.pose.moved(inverse(T_STEP), C_STEP)
    return s.measured(pose, inverse(T_STEP), C_STEP, elapsed_s, TrackStats(inliers=inliers))


def test_state_starts_where_it_is_told_to():
    s = state()
    s.advance(0)
    result = s.started(TrackStats(features=5))
    assert result.status is INITIALISING
    np.testing.assert_array_equal(result.T_world_rig, T_START)
    np.testing.assert_array_equal(result.covariance, np.zeros((6, 6)))
    assert result.reason == "first frame"
    assert result.stats.features == 5


def test_stamps_must_increase_and_a_refusal_changes_nothing():
    s = state()
    s.advance(5)
    for stamp_ns in (5, 4):
        with pytest.raises(
            OutOfOrderError,
            match=rf"frame at {stamp_ns} ns does not come after 5 ns: reset the odometry after a "
            "jump of the clock",
        ):
            s.advance(stamp_ns)
    assert s.advance(5 + S) == pytest.approx(1.0)


def test_twist_is_the_velocity_in_rig_axes():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    result = step(s, S // 10, measured=True)
    np.testing.assert_allclose(result.twist[:3], [0.5, 0.0, 4.0], atol=0.05)
    np.testing.assert_allclose(result.twist[3:], [0.0, 0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(result.twist_covariance, C_STEP / 0.01, rtol=1e-9)


def test_a_gap_goes_on_with_the_twist_and_a_growing_covariance():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    before = step(s, S // 10, measured=True)
    expected, last = before.T_world_rig, before
    for k in range(2, 11):
        result = step(s, k * S // 10, measured=False)
        assert result.status is GAP
        assert result.reason == "dark"
        expected = expected @ T_STEP
        np.testing.assert_allclose(result.T_world_rig, expected, atol=1e-9)
        grown = np.diag(result.covariance - last.covariance)
        assert np.all(grown > 0)
        assert np.all(np.diag(result.twist_covariance - last.twist_covariance) > 0)
        last = result
    # 0.9 s at 3 m/s^2 may be 1.2 m; the turn before adds a little.
    assert 1.2 < np.sqrt(last.covariance[0, 0]) < 3.0


def test_prediction_is_what_an_unmeasured_frame_then_says():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    step(s, S // 10, measured=True)
    s.advance(3 * S // 10)
    predicted = s.predicted()
    np.testing.assert_allclose(s.unmeasured(TrackStats(), "").T_world_rig, predicted, atol=1e-12)


def test_lost_has_no_pose_and_recovery_goes_on_from_where_it_was_lost():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    step(s, S // 10, measured=True)
    last = step(s, S, measured=False)
    lost = step(s, 3 * S, measured=False)
    assert lost.status is LOST
    assert lost.T_world_rig is None
    assert lost.covariance is None
    assert lost.twist is None
    found = step(s, 3 * S + S // 10, measured=True)
    assert found.status is TRACKING
    assert found.reset_counter == lost.reset_counter + 1
    np.testing.assert_allclose(found.T_world_rig, last.T_world_rig @ T_STEP, atol=1e-9)


def test_what_was_unseen_is_in_the_covariance_after_a_loss():
    """Two seconds lost are two seconds of unknown motion, with or without frames in between."""
    sigmas = []
    for gap_frames in ((), (S // 2, S)):
        s = state(coast_max_s=1.0)
        s.advance(0)
        s.started(TrackStats())
        step(s, S // 10, measured=True)
        for stamp_ns in gap_frames:
            step(s, S // 10 + stamp_ns, measured=False)
        assert step(s, S // 10 + 2 * S, measured=False).status is LOST
        found = step(s, S // 5 + 2 * S, measured=True)
        sigmas.append(np.sqrt(found.covariance[0, 0]))
    assert sigmas[0] > 0.5 * 3.0 * 2.0**2 * 0.9
    assert sigmas[1] > 0.5 * 3.0 * 2.0**2 * 0.9


def test_a_restart_counts_as_a_reset_and_forgets_the_rest():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    step(s, S // 10, measured=True)
    step(s, 3 * S, measured=False)
    assert step(s, 3 * S + S // 10, measured=True).reset_counter == 1
    s.restart(T_STEP)
    s.advance(0)
    result = s.started(TrackStats())
    assert result.reset_counter == 2
    assert result.status is INITIALISING
    np.testing.assert_array_equal(result.T_world_rig, T_STEP)
    np.testing.assert_array_equal(result.twist, np.zeros(6))
    assert step(s, S // 10, measured=True).reset_counter == 2


def test_nobody_can_change_the_state_through_a_result():
    s = state()
    s.advance(0)
    s.started(TrackStats())
    first = step(s, S // 10, measured=True)
    kept = first.T_world_rig.copy(), first.covariance.copy(), first.twist.copy()
    for array in (first.T_world_rig, first.covariance, first.twist, first.twist_covariance):
        if array.flags.writeable:
            array[...] = 1e6
    result = step(s, S // 5, measured=False)
    np.testing.assert_allclose(result.T_world_rig, kept[0] @ T_STEP, atol=1e-9)
    np.testing.assert_allclose(result.twist, kept[2])
    assert result.covariance[0, 0] < 1.0


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 12), st.integers(0, 60)), max_size=60))
def test_status_rules_hold_for_every_history(history):
    s = state()
    s.advance(0)
    s.started(TrackStats())
    stamp_ns, last_counter, last_seen_ns, was_lost = 0, 0, 0, False
    for measured, tenths, inliers in history:
        stamp_ns += tenths * S // 10
        result = step(s, stamp_ns, measured, inliers)
        assert result.stamp_ns == stamp_ns
        assert (result.T_world_rig is None) == (result.status is LOST)
        assert (result.covariance is None) == (result.status is LOST)
        if measured:
            assert result.status is (DEGRADED if inliers < 30 else TRACKING)
            assert result.reset_counter == last_counter + was_lost
            last_seen_ns = stamp_ns
        else:
            assert result.reset_counter == last_counter
            too_long = stamp_ns - last_seen_ns > S
            assert result.status is (LOST if was_lost or too_long else GAP)
        was_lost, last_counter = result.status is LOST, result.reset_counter


def test_stage_times_are_put_into_the_result():
    s = state()
    s.advance(0)
    result = with_stages(s.started(TrackStats(features=7)), {"match": 1.5})
    assert result.stats.stage_ms == {"match": 1.5}
    assert result.stats.features == 7


def test_reasons_are_told_one_after_the_other_where_there_are_any():
    s = state()
    s.advance(0)
    started = s.started(TrackStats(), "first")
    assert with_reasons(started, "", "second", "third").reason == "first; second; third"
    assert with_reasons(started, "").reason == "first"
    assert with_reasons(s.started(TrackStats(), ""), "", "second").reason == "second"


NO_LAG = Lag()


def moving_on(
    lag_ms: float, by_bolometer: bool | None, sigma_ms: float = 2.0, exposure: Lag = NO_LAG
):
    """A result one step after the start, with images that lag or not."""
    config = StatusConfig(bolometer_lag_ms=lag_ms, bolometer_lag_sigma_ms=sigma_ms)
    s = OdometryState(config, T_START, exposure=exposure)
    s.advance(0, by_bolometer=by_bolometer)
    s.started(TrackStats())
    s.advance(S // 10, by_bolometer=by_bolometer)
    pose = s.pose.moved(inverse(T_STEP), C_STEP)
    return s, s.measured(pose, inverse(T_STEP), C_STEP, 0.1, TrackStats(inliers=100))


def test_poses_of_a_bolometer_are_moved_on_to_the_stamp():
    """At a twist of one step in 100 ms, a lag of 10 ms is a tenth of a step."""
    s, result = moving_on(10.0, by_bolometer=True)
    np.testing.assert_allclose(s.pose.T_world_rig, T_START @ T_STEP, atol=1e-12)
    expected = T_START @ exp_se3(1.1 * np.array([0.05, 0.0, 0.4, 0.0, 0.02, 0.0]))
    np.testing.assert_allclose(result.T_world_rig, expected, atol=1e-12)


def test_an_unsure_lag_makes_the_pose_unsure_along_the_twist():
    _, sure = moving_on(10.0, by_bolometer=True, sigma_ms=0.0)
    _, unsure = moving_on(10.0, by_bolometer=True, sigma_ms=2.0)
    added = unsure.covariance - sure.covariance
    R = sure.T_world_rig[:3, :3]
    drift = 2e-3 * np.concatenate([R @ sure.twist[:3], R @ sure.twist[3:]])
    np.testing.assert_allclose(added, np.outer(drift, drift), atol=1e-15)
    assert np.sqrt(np.trace(added[:3, :3])) == pytest.approx(2e-3 * 4.03, rel=0.01)


def test_a_camera_that_exposed_before_its_stamp_is_moved_on_as_well():
    _, bolometer = moving_on(10.0, by_bolometer=True)
    _, exposed = moving_on(30.0, by_bolometer=False, exposure=Lag(0.010, 0.002))
    np.testing.assert_allclose(exposed.T_world_rig, bolometer.T_world_rig, atol=1e-12)
    np.testing.assert_allclose(exposed.covariance, bolometer.covariance, atol=1e-15)


def test_a_stamp_that_is_not_trusted_moves_no_pose_but_is_said_to_be():
    _, trusted = moving_on(10.0, by_bolometer=False)
    _, doubted = moving_on(10.0, by_bolometer=False, exposure=Lag(0.0, 0.005))
    np.testing.assert_array_equal(doubted.T_world_rig, trusted.T_world_rig)
    added = doubted.covariance - trusted.covariance
    assert np.sqrt(np.trace(added[:3, :3])) == pytest.approx(5e-3 * 4.03, rel=0.01)
    assert np.sqrt(np.trace(added[3:, 3:])) == pytest.approx(5e-3 * 0.2, rel=0.01)


@pytest.mark.parametrize("by_bolometer", [False, None])
def test_images_of_a_shutter_do_not_lag(by_bolometer):
    s, result = moving_on(10.0, by_bolometer)
    _, without = moving_on(0.0, by_bolometer=True, sigma_ms=5.0)
    np.testing.assert_array_equal(result.T_world_rig, s.pose.T_world_rig)
    np.testing.assert_array_equal(result.covariance, without.covariance)


def test_a_blind_frame_lags_as_the_last_one_with_images():
    s, seen = moving_on(10.0, by_bolometer=True)
    s.advance(2 * S // 10, by_bolometer=None)
    result = s.unmeasured(TrackStats(), "blind")
    np.testing.assert_allclose(result.T_world_rig, seen.T_world_rig @ T_STEP, atol=1e-9)


@pytest.mark.parametrize("is_reset", [False, True])
def test_lengths_in_another_unit_are_a_reset_where_poses_went_out_before(is_reset):
    s = state()
    s.advance(0)
    s.started(TrackStats())
    s.rescale(2.0, s.pose, is_reset=is_reset)
    s.advance(10**8)
    result = s.measured(s.pose, np.eye(4), np.eye(6), 0.1, TrackStats(inliers=100))
    assert result.reset_counter == int(is_reset)
