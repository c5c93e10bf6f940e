"""What an accelerometer adds: preintegration, gravity, bias, and a second without any image."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.results import TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import exp_so3, inverse, log_so3, make_transform
from thermal_stereo_vo.odometry.gyro import AccelerometerConfig, GyroConfig, GyroIntegrator
from thermal_stereo_vo.odometry.inertial_filter import InertialFilter
from thermal_stereo_vo.odometry.odometry_state import OdometryState
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig

STEP_NS, IMU_NS = 50_000_000, 5_000_000
LEVER_M = np.array([0.05, -0.2, -0.3])
R_RIG_IMU = exp_so3([0.3, -0.4, 1.2])
GRAVITY = np.array([0.6, 9.75, 0.8])
"""The first picture was not level: the world of the odometry is not either."""
BIAS = np.array([0.05, -0.04, 0.03])
BLIND_FROM, BLIND = 100, 20


def pose(t):
    """Rig to world: it sways, and turns by up to 1 rad/s about axes that wander."""
    R = exp_so3([0.0, 0.8 * np.sin(1.1 * t), 0.0]) @ exp_so3([0.1 * np.sin(2.0 * t), 0.0, 0.1 * t])
    way = [0.5 * np.sin(1.3 * t), 0.2 * np.cos(1.7 * t), 0.8 * t + 0.3 * np.sin(2.1 * t)]
    return make_transform(R, np.array(way))


def imu_position(t):
    T = pose(t)
    return T[:3, :3] @ LEVER_M + T[:3, 3]


def samples(end_s, bias=BIAS):
    """(stamp, rate, force) in axes of the IMU, by differences of the path."""
    d = 1e-4
    for stamp_ns in range(0, round(end_s * 1e9) + 1, IMU_NS):
        t = stamp_ns * 1e-9
        R = pose(t)[:3, :3]
        rate = log_so3(pose(t - d)[:3, :3].T @ pose(t + d)[:3, :3]) / (2 * d)
        acceleration = (imu_position(t + d) - 2 * imu_position(t) + imu_position(t - d)) / d**2
        force = R.T @ (acceleration - GRAVITY) + bias
        yield stamp_ns, R_RIG_IMU.T @ rate, R_RIG_IMU.T @ force


def make_gyro(end_s=7.0, lever_m=LEVER_M, change=lambda force: force) -> GyroIntegrator:
    gyro = GyroIntegrator(GyroConfig(), R_RIG_IMU, AccelerometerConfig(), lever_m)
    for stamp_ns, rate, force in samples(end_s):
        gyro.push(stamp_ns, rate, change(force))
    return gyro


@pytest.fixture(scope="module")
def gyro():
    return make_gyro()


def fly(gyro, noise_m=0.001, blind=BLIND):
    """Results of a state that sees poses at 20 Hz, and then nothing."""
    rng = np.random.default_rng(5)
    state = OdometryState(StatusConfig(), pose(0.0), gyro)
    state.advance(0)
    state.started(TrackStats())
    covariance = np.diag([noise_m**2] * 3 + [1e-8] * 3)
    results, before = [], pose(0.0)
    for i in range(1, BLIND_FROM + blind):
        state.advance(i * STEP_NS)
        if i >= BLIND_FROM:
            results.append(state.unmeasured(TrackStats(), "blind"))
            continue
        seen = pose(i * 0.05)
        seen[:3, 3] += noise_m * rng.standard_normal(3)
        step = inverse(seen) @ before
        results.append(
            state.measured(
                PoseEstimate(seen, 1e-12 * np.eye(6)),
                step,
                covariance,
                0.05,
                TrackStats(inliers=99),
            )
        )
        before = seen
    return results


def end_error_m(results) -> float:
    truth = pose(len(results) * 0.05)
    return float(np.linalg.norm(results[-1].T_world_rig[:3, 3] - truth[:3, 3]))


# --- preintegration ------------------------------------------------------------------------------


def test_increments_are_those_of_the_path(gyro):
    """Position and velocity of the IMU over half a second, by the equations of motion."""
    t0, t1, d = 2.0, 2.5, 1e-4
    felt = gyro.increments_between(round(t0 * 1e9), round(t1 * 1e9))
    R, seconds = pose(t0)[:3, :3], t1 - t0
    v0, v1 = ((imu_position(t + d) - imu_position(t - d)) / (2 * d) for t in (t0, t1))
    velocity = v0 + R @ (felt.velocity_m_s - felt.turned_s @ BIAS) + GRAVITY * seconds
    np.testing.assert_allclose(velocity, v1, atol=2e-4)
    position = imu_position(t0) + v0 * seconds + 0.5 * GRAVITY * seconds**2
    position += R @ (felt.position_m - felt.turned_s2 @ BIAS)
    np.testing.assert_allclose(position, imu_position(t1), atol=1e-4)
    rotation = gyro.rotation_between(round(t0 * 1e9), round(t1 * 1e9))
    np.testing.assert_allclose(felt.rotation, rotation, atol=1e-12)
    assert np.linalg.norm(log_so3(rotation)) > 0.2
    assert np.linalg.norm(R @ (felt.turned_s2 @ BIAS)) > 5e-3  # it counts


def test_without_a_force_there_is_nothing_to_integrate():
    gyro = GyroIntegrator(GyroConfig(), np.eye(3), AccelerometerConfig())
    for stamp_ns in range(0, 100_000_001, IMU_NS):
        gyro.push(stamp_ns, np.zeros(3), None if stamp_ns == 50_000_000 else GRAVITY)
    assert gyro.increments_between(0, 40_000_000) is not None
    assert gyro.increments_between(0, 60_000_000) is None
    assert gyro.rotation_between(0, 60_000_000) is not None


# --- a second without images ---------------------------------------------------------------------


def test_a_second_is_bridged_where_constant_velocity_is_lost(gyro):
    guided = fly(gyro)
    assert {r.status for r in guided[BLIND_FROM - 1 :]} == {TrackingStatus.GAP}
    alone = fly(GyroIntegrator(GyroConfig(), R_RIG_IMU))
    assert end_error_m(alone) > 0.3
    assert end_error_m(guided) < 0.03
    # It knows how good that is, and its twist is that of the path.
    sigma_m = float(np.sqrt(np.trace(guided[-1].covariance[:3, :3])))
    assert end_error_m(guided) < 3.0 * sigma_m < 0.3
    truth = inverse(pose(5.90)) @ pose(5.95)
    np.testing.assert_allclose(guided[-1].twist[:3], truth[:3, 3] / 0.05, atol=0.05)
    assert np.sqrt(guided[-1].twist_covariance[0, 0]) < 0.2
    assert np.sqrt(alone[-1].twist_covariance[0, 0]) > 2.0


def test_the_place_of_the_imu_counts():
    """Taken for one at the camera's place, its swing is taken for motion of the rig."""
    wrong = end_error_m(fly(make_gyro(lever_m=np.zeros(3))))
    assert wrong > 0.06


def test_gravity_and_bias_are_told_apart_by_turning(gyro):
    inertial = InertialFilter(AccelerometerConfig(), LEVER_M)
    rng = np.random.default_rng(2)
    for i in range(120):
        if i:
            felt = gyro.increments_between((i - 1) * STEP_NS, i * STEP_NS)
            inertial.propagate(felt, pose((i - 1) * 0.05)[:3, :3])
        seen = pose(i * 0.05)
        seen[:3, 3] += 0.001 * rng.standard_normal(3)
        inertial.measured(seen, 1e-6 * np.eye(3))
    assert inertial.is_trusted
    np.testing.assert_allclose(inertial.gravity_m_s2, GRAVITY, atol=0.05)
    assert np.linalg.norm(inertial.bias_m_s2 - BIAS) < 0.7 * np.linalg.norm(BIAS)


@pytest.mark.parametrize(
    "change",
    [np.zeros_like, lambda f: f / 9.81, lambda f: f[[1, 2, 0]], lambda f: -f],
    ids=["zeros", "unit g", "axes", "sign"],
)
def test_an_accelerometer_that_makes_no_sense_is_not_followed(change):
    """What it leads to is no worse than what the gyro alone leads to."""
    gyro_only = GyroIntegrator(GyroConfig(), R_RIG_IMU)
    for stamp_ns, rate, _ in samples(7.0):
        gyro_only.push(stamp_ns, rate)
    strange = fly(make_gyro(change=change))
    plain = fly(gyro_only)
    np.testing.assert_array_equal(strange[-1].T_world_rig, plain[-1].T_world_rig)
    np.testing.assert_array_equal(strange[-1].covariance, plain[-1].covariance)


def test_silence_of_the_imu_in_a_gap_is_survived():
    gyro = make_gyro(end_s=5.5)
    results = fly(gyro)
    assert {r.status for r in results[BLIND_FROM - 1 :]} == {TrackingStatus.GAP}
    sigmas = [np.sqrt(r.covariance[0, 0]) for r in results[BLIND_FROM - 1 :]]
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[8] < 0.1
    assert sigmas[-1] > 0.5  # as unsure as without


def test_a_rig_found_again_starts_anew(gyro):
    """After LOST the velocity is unknown, gravity is not."""
    inertial = InertialFilter(AccelerometerConfig(), LEVER_M)
    for i in range(60):
        if i:
            felt = gyro.increments_between((i - 1) * STEP_NS, i * STEP_NS)
            inertial.propagate(felt, pose((i - 1) * 0.05)[:3, :3])
        inertial.measured(pose(i * 0.05), 1e-6 * np.eye(3))
    assert inertial.is_trusted
    gravity = inertial.gravity_m_s2
    inertial.lose_track()
    assert not inertial.is_trusted
    inertial.measured(pose(4.0), 1e-6 * np.eye(3))
    assert not inertial.is_trusted
    np.testing.assert_array_equal(inertial.gravity_m_s2, gravity)
