"""The gyro: integration, coverage, bias, and what it does for a rig that cannot see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.calibration_yaml import dump_rig, parse_rig
from thermal_stereo_vo.core.cameras import RigCalibration, default_T_base_rig
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.results import TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, inverse, log_so3, make_transform
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.odometry.gyro import BIAS_MEMORY_S, GyroConfig, GyroIntegrator
from thermal_stereo_vo.odometry.odometry_state import OdometryState
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig
from thermal_stereo_vo.outputs.bag_writer import BagWriter
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.replay import replay
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier

IMU_NS = 5_000_000
PERIOD_NS = 100_000_000
INITIALISING, TRACKING, DEGRADED, GAP, LOST = TrackingStatus

rates = st.tuples(*3 * [st.floats(-3.0, 3.0)])
moments_ns = st.integers(0, 500_000_000)


def gyro_at(rate_of, end_ns: int = 500_000_000, *, config=None, R_rig_imu=None) -> GyroIntegrator:
    """A gyro that was given ``rate_of(time_s)`` at 200 Hz from 0 to the end."""
    axes = np.eye(3) if R_rig_imu is None else R_rig_imu
    gyro = GyroIntegrator(config or GyroConfig(), axes)
    for stamp_ns in range(0, end_ns + 1, IMU_NS):
        gyro.push(stamp_ns, rate_of(stamp_ns * 1e-9))
    return gyro


@given(rates, moments_ns, moments_ns)
def test_a_constant_rate_is_one_rotation(rate, a_ns, b_ns):
    """However the ends lie between the samples."""
    t0_ns, t1_ns = sorted((a_ns, b_ns))
    rotation = gyro_at(lambda _: rate).rotation_between(t0_ns, t1_ns)
    expected = exp_so3(np.array(rate) * (t1_ns - t0_ns) * 1e-9)
    np.testing.assert_allclose(rotation, expected, atol=1e-9)


def test_a_tumbling_rig_is_followed():
    """Rates about changing axes: the order of the factors matters."""

    def rate(t):
        return np.array([1.5 * np.sin(7 * t), 2.0 * np.cos(5 * t), 1.0 - 3.0 * t])

    truth, dt = np.eye(3), 1e-4
    for i in range(4000):
        truth = truth @ exp_so3(rate((i + 0.5) * dt) * dt)
    gyro = gyro_at(rate)
    rotation = gyro.rotation_between(0, 400_000_000)
    error = np.linalg.norm(log_so3(truth.T @ rotation))
    wrong_order = np.linalg.norm(log_so3(truth @ rotation))
    assert 1e-9 < error < 5e-4
    assert wrong_order > 0.1
    halves = [
        gyro.rotation_between(a, b) for a, b in ((0, 150_000_000), (150_000_000, 400_000_000))
    ]
    np.testing.assert_allclose(halves[0] @ halves[1], rotation, atol=1e-12)


def test_rates_are_turned_into_axes_of_the_rig():
    """A yaw to the left about base z is a turn about the optical axis that points up, -y."""
    R_rig_imu = default_T_base_rig()[:3, :3].T
    rotation = gyro_at(lambda _: [0.0, 0.0, 1.0], R_rig_imu=R_rig_imu).rotation_between(
        0, 300_000_000
    )
    np.testing.assert_allclose(log_so3(rotation), [0.0, -0.3, 0.0], atol=1e-9)


def test_nothing_is_made_up_where_samples_are_missing():
    gyro = GyroIntegrator(GyroConfig(max_gap_ms=20.0), np.eye(3))
    assert gyro.rotation_between(0, 1) is None
    stamps = [*range(100_000_000, 200_000_001, IMU_NS), *range(221_000_000, 300_000_001, IMU_NS)]
    for stamp_ns in stamps:
        gyro.push(stamp_ns, [0.0, 0.0, 1.0])
    ms = 1_000_000

    def covered(t0_ms, t1_ms):
        return gyro.rotation_between(t0_ms * ms, t1_ms * ms) is not None

    assert covered(100, 200)
    assert not covered(99, 150)  # begins too late
    assert not covered(150, 205)  # into the silence of 21 ms
    assert not covered(205, 250)
    assert covered(221, 296)
    assert covered(230, 315)  # the newest sample, at 296, holds for 20 ms
    assert not covered(230, 317)


def test_strange_samples_do_no_harm():
    gyro = gyro_at(lambda _: [0.0, 0.5, 0.0])
    gyro.push(500_000_000, [9.0, 9.0, 9.0])  # repeated
    gyro.push(502_000_000, [np.nan, 0.0, 0.0])
    rotation = gyro.rotation_between(400_000_000, 505_000_000)
    np.testing.assert_allclose(log_so3(rotation), [0.0, 0.0525, 0.0], atol=1e-9)
    gyro.push(100_000_000, [1.0, 0.0, 0.0])  # the clock went back
    assert gyro.rotation_between(400_000_000, 500_000_000) is None
    gyro.push(105_000_000, [1.0, 0.0, 0.0])
    rotation = gyro.rotation_between(100_000_000, 105_000_000)
    np.testing.assert_allclose(log_so3(rotation), [0.005, 0.0, 0.0], atol=1e-12)
    gyro.reset()
    assert gyro.rotation_between(100_000_000, 105_000_000) is None


def test_memory_is_bounded():
    gyro = GyroIntegrator(GyroConfig(), np.eye(3))
    for i in range(20_000):
        gyro.push(i * 2_000_000, [0.0, 0.0, 0.0])
    assert 5_000 < len(gyro._samples) < 7_000


def test_the_bias_is_learned_while_the_rig_hardly_turns():
    rng = np.random.default_rng(3)
    bias, true_rate = np.array([0.03, -0.02, 0.01]), np.array([0.0, 0.05, 0.0])
    gyro = gyro_at(lambda _: true_rate + bias, 30_000_000_000)
    for i in range(180, 290):  # what is kept of the record
        seen = exp_so3(true_rate * 0.1 + 2e-4 * rng.standard_normal(3))
        gyro.learn_bias(i * PERIOD_NS, (i + 1) * PERIOD_NS, seen)
    np.testing.assert_allclose(gyro.bias, bias, atol=1e-3)
    rotation = gyro.rotation_between(29_000_000_000, 30_000_000_000)
    np.testing.assert_allclose(log_so3(rotation), true_rate, atol=2e-3)
    assert gyro.error_rad_s < 0.02


def test_a_turn_or_a_contradiction_teaches_no_bias():
    """A gyro that scales wrongly, or whose axes are wrong, must not spoil the bias."""
    turning = gyro_at(lambda _: [0.0, 1.1, 0.0])
    turning.learn_bias(0, PERIOD_NS, exp_so3([0.0, 0.1, 0.0]))
    np.testing.assert_array_equal(turning.bias, 0.0)
    assert turning.error_rad_s == pytest.approx(0.1, abs=1e-6)
    mistaken = gyro_at(lambda _: [0.0, 2.0, 0.0])
    mistaken.learn_bias(0, PERIOD_NS, np.eye(3))
    np.testing.assert_array_equal(mistaken.bias, 0.0)
    assert mistaken.error_rad_s == pytest.approx(2.0, abs=1e-6)


def test_an_old_bias_is_forgotten():
    gyro = GyroIntegrator(GyroConfig(), np.eye(3))

    def stand_still(bias, first, last):
        for i in range(first, last):
            for stamp_ns in range(i * PERIOD_NS, (i + 1) * PERIOD_NS, IMU_NS):
                gyro.push(stamp_ns, bias)
            if i > first + 1:
                gyro.learn_bias((i - 1) * PERIOD_NS, i * PERIOD_NS, np.eye(3))

    stand_still([0.02, 0.0, 0.0], 0, 1000)
    assert gyro.bias[0] == pytest.approx(0.02, abs=1e-4)
    stand_still([0.0, 0.0, 0.0], 1000, 1000 + round(BIAS_MEMORY_S * 10))
    assert 0.25 * 0.02 < gyro.bias[0] < 0.5 * 0.02  # 1/e


@given(st.lists(st.floats(0.01, 0.3), min_size=1, max_size=6))
def test_many_short_steps_cost_as_much_as_one_long(steps_s):
    gyro = GyroIntegrator(GyroConfig(noise=0.01, bias_error=0.02), np.eye(3))
    total, unseen_s = 0.0, 0.0
    for step_s in steps_s:
        total += gyro.coasting_variance(unseen_s, step_s)
        unseen_s += step_s
    expected = 0.01**2 * unseen_s + (0.02 * unseen_s) ** 2
    assert total == pytest.approx(expected, rel=1e-9)


# --- the state of the odometry -------------------------------------------------------------------


def blind_turn(gyro: GyroIntegrator | None, gap: int) -> list:
    """Two measured steps ahead with a slow yaw, then a gap; the results of the gap."""
    state = OdometryState(StatusConfig(coast_max_s=0.5), np.eye(4), gyro)
    step = exp_se3([0.0, 0.0, 0.1, 0.0, 0.01, 0.0])
    covariance = 1e-8 * np.eye(6)
    state.advance(0)
    state.started(TrackStats())
    for i in (1, 2):
        state.advance(i * PERIOD_NS)
        pose = PoseEstimate.start(state.pose.T_world_rig @ step)
        state.measured(pose, inverse(step), covariance, 0.1, TrackStats(inliers=100))
    results = []
    for i in range(3, 3 + gap):
        state.advance(i * PERIOD_NS)
        before = state.predicted()
        results.append(state.unmeasured(TrackStats(), "blind"))
        if results[-1].status is GAP:
            np.testing.assert_allclose(before, state.pose.T_world_rig, atol=1e-9)
    results.append(state.pose)
    return results


def test_a_blind_rig_turns_as_the_gyro_feels():
    def yaw(t):
        return [0.0, 0.1 if t < 0.2025 else 1.0, 0.0]

    guided = blind_turn(gyro_at(yaw, 2_000_000_000), 4)
    alone = blind_turn(None, 4)
    turn = log_so3(guided[3].T_world_rig[:3, :3])
    np.testing.assert_allclose(turn, [0.0, 0.02 + 0.4, 0.0], atol=3e-3)
    np.testing.assert_allclose(log_so3(alone[3].T_world_rig[:3, :3])[1], 0.06, atol=1e-6)
    assert guided[3].twist[4] == pytest.approx(1.0, abs=1e-6)
    # Forward speed goes on; of the rotation much less is unknown, of the position as much.
    np.testing.assert_allclose(guided[3].twist[:3], [0.0, 0.0, 1.0], atol=1e-4)
    assert guided[3].covariance[4, 4] < 0.01 * alone[3].covariance[4, 4]
    assert guided[3].covariance[4, 4] > alone[0].covariance[4, 4] * 1e-6
    assert guided[3].covariance[0, 0] == pytest.approx(alone[3].covariance[0, 0], rel=0.05)
    assert guided[3].twist_covariance[4, 4] < 0.01 * alone[3].twist_covariance[4, 4]
    assert guided[3].twist_covariance[0, 0] == alone[3].twist_covariance[0, 0]


def test_a_lost_rig_stays_in_its_place_but_knows_its_heading():
    results = blind_turn(gyro_at(lambda _: [0.0, 0.5, 0.0], 3_000_000_000), 10)
    assert [r.status for r in results[:10]] == 5 * [GAP] + 5 * [LOST]
    pose, last_known = results[-1].T_world_rig, results[4].T_world_rig
    np.testing.assert_array_equal(pose[:3, 3], last_known[:3, 3])
    turned = log_so3(last_known[:3, :3].T @ pose[:3, :3])
    np.testing.assert_allclose(turned, [0.0, 0.25, 0.0], atol=1e-6)


def test_without_samples_nothing_changes():
    silent = blind_turn(GyroIntegrator(GyroConfig(), np.eye(3)), 8)
    alone = blind_turn(None, 8)
    for a, b in zip(silent[:-1], alone[:-1], strict=True):
        assert a.status is b.status
        if a.T_world_rig is not None:
            np.testing.assert_array_equal(a.T_world_rig, b.T_world_rig)
            np.testing.assert_array_equal(a.covariance, b.covariance)
            np.testing.assert_array_equal(a.twist_covariance, b.twist_covariance)


# --- the axes of the IMU -------------------------------------------------------------------------


def test_axes_of_the_imu_follow_calibration_and_rectification(tmp_path: Path, room):
    rig = room.calibration()
    np.testing.assert_array_equal(rig.R_rig_imu, default_T_base_rig()[:3, :3].T)
    np.testing.assert_array_equal(rig.imu_position_m, np.zeros(3))
    downwards = make_transform(exp_so3([0.3, 0.1, -0.2]), [0.1, 0.0, 0.0])
    np.testing.assert_array_equal(replace(rig, T_base_rig=downwards).R_rig_imu, downwards[:3, :3].T)
    T_rig_imu = make_transform(exp_so3([0.5, -0.2, 0.1]), [0.01, 0.02, 0.03])
    given_imu = replace(rig, T_base_rig=downwards, T_rig_imu=T_rig_imu)
    read = parse_rig(dump_rig(given_imu), tmp_path / "rig.yaml")
    np.testing.assert_array_equal(read.R_rig_imu, T_rig_imu[:3, :3])
    np.testing.assert_array_equal(read.imu_position_m, T_rig_imu[:3, 3])
    # The rig sits 0.1 m before the origin of its base, where the IMU is thought to be.
    np.testing.assert_allclose(
        downwards @ [*replace(rig, T_base_rig=downwards).imu_position_m, 1.0],
        [0, 0, 0, 1],
        atol=1e-12,
    )

    # Eyes that squint are rectified: the rig of the results is turned against the calibration's.
    squint = make_transform(exp_so3([0.0, 0.06, 0.0]), [0.25, 0.0, 0.02])
    right = replace(rig["right"], T_rig_camera=squint)
    raw = replace(given_imu, cameras={"left": rig["left"], "right": right}, rectified=False)
    rectifier = Rectifier(raw, RectificationConfig())
    R_rig_rectified = rectifier.T_rig_rectified[:3, :3]
    assert np.linalg.norm(log_so3(R_rig_rectified)) > 0.02
    np.testing.assert_allclose(
        R_rig_rectified @ rectifier.rectified_calibration.R_rig_imu, raw.R_rig_imu, atol=1e-12
    )
    raw = replace(raw, T_rig_imu=None)
    rectifier = Rectifier(raw, RectificationConfig())
    np.testing.assert_allclose(
        R_rig_rectified @ rectifier.rectified_calibration.R_rig_imu, raw.R_rig_imu, atol=1e-12
    )


# --- images and inertial samples through the pipeline --------------------------------------------

SEEN_BEFORE, BLIND, SEEN_AFTER = 6, 4, 4
AHEAD = np.array([0.0, 0.0, 0.05, 0.0, 0.01, 0.0])
TURN = np.array([0.0, 0.0, 0.05, 0.0, 0.07, 0.0])
BIAS = np.array([0.02, -0.03, 0.01])


@dataclass
class Flight:
    """A recording whose images freeze while the rig turns faster than before."""

    images: list[RawFrame]
    rig: RigCalibration
    poses: np.ndarray
    samples: list[ImuSample]

    name = "turn in the dark"
    cameras = ("left", "right")

    def calibration(self):
        return self.rig

    def frames(self):
        return iter(self.images)

    def ground_truth(self):
        return None

    def instants(self):
        return len(self.poses)

    def imu(self):
        return iter(self.samples)


@pytest.fixture(scope="module")
def flight(room) -> Flight:
    rng = np.random.default_rng(8)
    total = SEEN_BEFORE + BLIND + SEEN_AFTER
    steps = [TURN if SEEN_BEFORE <= i < SEEN_BEFORE + BLIND + 1 else AHEAD for i in range(1, total)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ exp_se3(step))
    stamps = [1_000_000_000 + i * PERIOD_NS for i in range(total)]
    images = list(room.raw_frames(stamps, poses, rng))
    for i in range(2 * SEEN_BEFORE, 2 * (SEEN_BEFORE + BLIND)):
        images[i] = replace(images[i], image=images[2 * SEEN_BEFORE - 2 + i % 2].image)
    R_imu_rig = default_T_base_rig()[:3, :3]
    samples = []
    for stamp_ns in range(stamps[0] - 20_000_000, stamps[-1] + 20_000_000, IMU_NS):
        i = int(np.clip((stamp_ns - stamps[0]) // PERIOD_NS, 0, total - 2))
        rate = R_imu_rig @ (steps[i][3:] / 0.1) + BIAS + 1e-3 * rng.standard_normal(3)
        samples.append(ImuSample(stamp_ns, rate))
    return Flight(images, room.calibration(), np.array(poses), samples)


def run(flight, *settings):
    config = with_overrides(Config(), ["odometry.gyro.enabled=true", *settings])
    return replay(flight, flight.calibration(), config).results


def heading_error_rad(results, flight) -> np.ndarray:
    """Of every frame of the gap."""
    return np.array(
        [
            np.linalg.norm(log_so3(results[i].T_world_rig[:3, :3].T @ flight.poses[i][:3, :3]))
            for i in range(SEEN_BEFORE, SEEN_BEFORE + BLIND)
        ]
    )


@pytest.mark.parametrize("window", [0, 7], ids=["frame to frame", "window"])
def test_the_heading_survives_a_gap(flight, window):
    guided = run(flight, f"odometry.window={window}")
    alone = run(flight, f"odometry.window={window}", "odometry.gyro.enabled=false")
    for results in (guided, alone):
        statuses = [r.status for r in results]
        assert statuses[SEEN_BEFORE : SEEN_BEFORE + BLIND] == BLIND * [GAP]
        assert statuses[1:SEEN_BEFORE] == (SEEN_BEFORE - 1) * [TRACKING]
    # 0.06 rad a frame more than before.
    assert heading_error_rad(alone, flight)[-1] > 0.2
    assert heading_error_rad(guided, flight)[-1] < 0.02
    last = guided[SEEN_BEFORE + BLIND - 1]
    sigma = np.sqrt(np.trace(last.covariance[3:, 3:]))
    assert heading_error_rad(guided, flight)[-1] < 3.0 * sigma < 0.1
    # Images win wherever there are any.
    assert guided[-1].status is TRACKING
    np.testing.assert_allclose(guided[-1].T_world_rig, flight.poses[-1], atol=0.04)


def test_replay_with_a_gyro_is_deterministic(flight):
    first, second = run(flight), run(flight)
    for a, b in zip(first, second, strict=True):
        assert a.status is b.status
        np.testing.assert_array_equal(a.T_world_rig, b.T_world_rig)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_recording_without_imu_needs_none(flight):
    without = replace(flight, samples=[])
    guided, alone = run(without), run(without, "odometry.gyro.enabled=false")
    for a, b in zip(guided, alone, strict=True):
        np.testing.assert_array_equal(a.T_world_rig, b.T_world_rig)


def test_a_bag_brings_its_imu(flight, tmp_path: Path):
    path = tmp_path / "bag"
    with BagWriter(path) as bag:
        for sample in flight.samples:
            force = np.array([0.0, 1.0, 2.0])  # of no gravity, so that nothing goes by it
            bag.write_imu("/mavros/imu/data", sample.stamp_ns, sample.rate_rad_s, force, "b")
            bag.write_imu("/mavros/imu/data_raw", sample.stamp_ns, np.ones(3), np.zeros(3), "b")
        for frame in flight.images:
            bag.write_image(f"/{frame.camera}/image_raw", frame.stamp_ns, frame.image, "x")
    dataset, _ = open_dataset(path)
    samples = list(dataset.imu())
    assert [s.stamp_ns for s in samples] == [s.stamp_ns for s in flight.samples]
    np.testing.assert_array_equal(
        [s.rate_rad_s for s in samples], [s.rate_rad_s for s in flight.samples]
    )
    np.testing.assert_array_equal([s.force_m_s2 for s in samples], len(samples) * [[0.0, 1.0, 2.0]])
    config = with_overrides(Config(), ["odometry.gyro.enabled=true"])
    from_bag = replay(dataset, flight.calibration(), config).results
    for a, b in zip(from_bag, run(flight), strict=True):
        np.testing.assert_array_equal(a.T_world_rig, b.T_world_rig)


def test_the_gyro_is_asked_for_the_time_the_images_show():
    """A turn that begins 20 ms before the stamp is half seen by an image that lags 10 ms."""
    gyro = gyro_at(lambda t: [0.0, 0.0 if t < 0.18 else 1.0, 0.0], 400_000_000)
    state = OdometryState(StatusConfig(bolometer_lag_ms=10.0), np.eye(4), gyro)
    state.advance(PERIOD_NS, by_bolometer=True)
    state.started(TrackStats())
    state.advance(2 * PERIOD_NS, by_bolometer=True)
    turn = log_so3(state.predicted()[:3, :3])
    np.testing.assert_allclose(turn, [0.0, 0.01, 0.0], atol=3e-3)
