"""Frame conversions against derivations that share no formula with the code."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.frames import FfcState, Telemetry
from thermal_stereo_vo.core.results import (
    OdometryResult,
    PointCloud,
    TrackingStatus,
    TrackStats,
)
from thermal_stereo_vo.core.transforms import (
    exp_se3,
    exp_so3,
    log_so3,
    make_transform,
    rotation_from_quat_xyzw,
)
from thermal_stereo_vo.outputs.ros_fields import (
    ERROR,
    OK,
    UNKNOWN_VARIANCE,
    WARN,
    DiagnosticFields,
    base_twist,
    odom_covariance,
    odom_pose,
    odometry_fields,
    point_cloud_fields,
    stamp_fields,
    status_fields,
    telemetry_fields,
    telemetry_from_values,
    world_pose,
)


def mounted_rig() -> np.ndarray:
    """A camera 0.2 m ahead, 0.05 m left, 0.1 m below base_link, tilted down by 20 degrees."""
    tilt = exp_so3([0.0, np.deg2rad(20.0), 0.0])
    return make_transform(tilt @ default_T_base_rig()[:3, :3], [0.2, 0.05, -0.1])


def random_covariance(rng: np.random.Generator, scale: float) -> np.ndarray:
    A = rng.normal(size=(6, 6)) * scale
    return A @ A.T


def result(**changes) -> OdometryResult:
    fields = {
        "stamp_ns": 1_700_000_000_123_456_789,
        "status": TrackingStatus.TRACKING,
        "T_world_rig": np.eye(4),
        "covariance": np.eye(6),
    }
    return OdometryResult(**(fields | changes))


def test_default_rig_flying_forward_moves_along_base_x():
    # 3 m along the optical axis, 1 m to the right, 0.5 m down.
    T = make_transform(np.eye(3), [1.0, 0.5, 3.0])
    assert np.allclose(odom_pose(T, default_T_base_rig())[:3, 3], [3.0, -1.0, -0.5])


def test_turning_right_is_a_negative_yaw():
    T = make_transform(exp_so3([0.0, 0.3, 0.0]), np.zeros(3))  # about the camera's down axis
    assert np.allclose(log_so3(odom_pose(T, default_T_base_rig())[:3, :3]), [0.0, 0.0, -0.3])


def test_start_pose_is_the_origin_of_odom():
    assert np.allclose(odom_pose(np.eye(4), mounted_rig()), np.eye(4))


def test_a_turn_about_the_rig_swings_base_link():
    """Base is 0.5 m behind the camera: when the camera yaws left in place, base goes right."""
    T_base_rig = make_transform(default_T_base_rig()[:3, :3], [0.5, 0.0, 0.0])
    quarter_left = make_transform(exp_so3([0.0, -np.pi / 2, 0.0]), np.zeros(3))
    assert np.allclose(odom_pose(quarter_left, T_base_rig)[:3, 3], [0.5, -0.5, 0.0])


def test_landmark_seen_through_base_stays_where_the_cloud_puts_it(rng):
    """A point in rig axes reaches odom through the pose or through the cloud: the same place."""
    T_base_rig, T_world_rig = mounted_rig(), exp_se3(rng.normal(size=6))
    point_rig = np.append(rng.normal(size=3), 1.0)
    through_pose = odom_pose(T_world_rig, T_base_rig) @ T_base_rig @ point_rig
    cloud = PointCloud(
        (T_world_rig @ point_rig)[None, :3].astype(np.float32), np.ones(1, np.float32)
    )
    fields = point_cloud_fields(0, cloud, T_base_rig)
    assert np.allclose(fields.data.view("<f4")[:3], through_pose[:3], atol=1e-5)


def test_world_pose_undoes_odom_pose(rng):
    T, T_base_rig = exp_se3(rng.normal(size=6)), mounted_rig()
    assert np.allclose(world_pose(odom_pose(T, T_base_rig), T_base_rig), T, atol=1e-12)


def test_covariance_matches_monte_carlo(rng):
    T_base_rig = mounted_rig()
    T_base_rig[:3, 3] *= 10.0  # a long lever arm, so that its term counts
    T_world_rig = exp_se3(np.array([4.0, -1.0, 9.0, 0.4, -0.9, 0.2]))
    covariance = random_covariance(rng, 0.002)
    mean = odom_pose(T_world_rig, T_base_rig)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=20_000)
    samples = np.empty((len(errors), 6))
    for sample, error in zip(samples, errors, strict=True):
        T = make_transform(exp_so3(error[3:]) @ T_world_rig[:3, :3], T_world_rig[:3, 3] + error[:3])
        T_odom_base = odom_pose(T, T_base_rig)
        sample[:3] = T_odom_base[:3, 3] - mean[:3, 3]
        sample[3:] = log_so3(T_odom_base[:3, :3] @ mean[:3, :3].T)
    expected = samples.T @ samples / len(samples)
    got = odom_covariance(covariance, T_world_rig, T_base_rig)
    sigma = np.sqrt(np.diag(expected))
    correlation_error = (got - expected) / np.outer(sigma, sigma)
    assert np.abs(correlation_error).max() < 0.05
    # The lever arm must matter in this setting, or the test proves nothing about it.
    no_lever = make_transform(T_base_rig[:3, :3], np.zeros(3))
    without = odom_covariance(covariance, T_world_rig, no_lever)
    assert np.abs((without - expected) / np.outer(sigma, sigma)).max() > 0.2


def test_twist_matches_differences_of_the_base_pose(rng):
    """Move the rig with a constant twist for a short time and watch base_link itself."""
    T_base_rig, T_world_rig = mounted_rig(), exp_se3(rng.normal(size=6))
    twist = rng.normal(size=6)
    dt = 1e-6
    before, after = (
        odom_pose(T_world_rig @ exp_se3(sign * dt / 2 * twist), T_base_rig) for sign in (-1, 1)
    )
    now = odom_pose(T_world_rig, T_base_rig)
    linear = now[:3, :3].T @ (after[:3, 3] - before[:3, 3]) / dt
    angular = log_so3(before[:3, :3].T @ after[:3, :3]) / dt
    got, _ = base_twist(twist, T_base_rig)
    assert np.allclose(got, np.concatenate([linear, angular]), atol=1e-6)


def test_twist_covariance_matches_monte_carlo(rng):
    T_base_rig, covariance = mounted_rig(), random_covariance(rng, 0.3)
    twists = rng.multivariate_normal(np.arange(6.0), covariance, size=50_000)
    moved = np.array([base_twist(twist, T_base_rig)[0] for twist in twists])
    expected = np.cov(moved.T)
    fields = odometry_fields(result(twist=np.arange(6.0), twist_covariance=covariance), T_base_rig)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((fields.twist_covariance - expected) / np.outer(sigma, sigma)).max() < 0.03


def test_odometry_fields_hold_the_pose_of_base_link(rng):
    T_base_rig, T_world_rig = mounted_rig(), exp_se3(rng.normal(size=6))
    fields = odometry_fields(result(T_world_rig=T_world_rig), T_base_rig)
    expected = odom_pose(T_world_rig, T_base_rig)
    assert np.allclose(fields.position_m, expected[:3, 3])
    assert np.allclose(rotation_from_quat_xyzw(fields.quat_xyzw), expected[:3, :3])
    assert (fields.frame_id, fields.child_frame_id) == ("odom", "base_link")
    assert fields.stamp_ns == 1_700_000_000_123_456_789


def test_lost_is_silent():
    lost = result(status=TrackingStatus.LOST, T_world_rig=None, covariance=None)
    assert odometry_fields(lost, default_T_base_rig()) is None


def test_what_was_not_measured_is_declared_unknown():
    fields = odometry_fields(result(covariance=None), default_T_base_rig())
    assert np.array_equal(np.diag(fields.pose_covariance), np.full(6, UNKNOWN_VARIANCE))
    assert np.array_equal(np.diag(fields.twist_covariance), np.full(6, UNKNOWN_VARIANCE))
    assert not fields.linear_m_s.any()


def test_stamp_splits_exactly():
    assert stamp_fields(1_700_000_000_123_456_789) == (1_700_000_000, 123_456_789)


def test_point_cloud_bytes_are_little_endian_xyz_intensity():
    cloud = PointCloud(
        np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, 5.0, 6.0]], np.float32),
        np.array([10.0, 11.0, 12.0], np.float32),
    )
    fields = point_cloud_fields(5, cloud, np.eye(4))
    assert fields.width == 2
    assert fields.data.tobytes() == struct.pack("<8f", 1, 2, 3, 10, 4, 5, 6, 12)


def test_a_point_of_one_band_is_kept_with_the_other_unknown():
    xyz = np.array([[1, 2, 3], [4, np.nan, 6], [7, 8, 9]], np.float32)
    visible = np.array([10, 11, np.nan], np.float32)
    thermal = np.array([np.nan, 7000, 7100], np.float32)
    fields = point_cloud_fields(5, PointCloud(xyz, visible, thermal_counts=thermal), np.eye(4))
    assert fields.names == ("x", "y", "z", "intensity", "thermal")
    rows = fields.data.view("<f4").reshape(-1, 5)
    np.testing.assert_array_equal(rows, [[1, 2, 3, 10, np.nan], [7, 8, 9, np.nan, 7100]])


def test_an_empty_cloud_packs_to_nothing():
    fields = point_cloud_fields(5, PointCloud.empty(), default_T_base_rig())
    assert (fields.width, len(fields.data)) == (0, 0)


@pytest.mark.parametrize(
    ("status", "level"),
    [
        (TrackingStatus.INITIALISING, OK),
        (TrackingStatus.TRACKING, OK),
        (TrackingStatus.DEGRADED, WARN),
        (TrackingStatus.GAP, WARN),
        (TrackingStatus.LOST, ERROR),
    ],
)
def test_level_follows_status(status, level):
    assert status_fields(result(status=status)).level == level


def test_status_tells_counts_and_reason():
    stats = TrackStats(
        features=800, matches=300, inliers=120, rms_px=0.4567, stage_ms={"detect": 3.25}
    )
    fields = status_fields(
        result(status=TrackingStatus.DEGRADED, stats=stats, reason="few inliers", reset_counter=2)
    )
    values = dict(fields.values)
    assert fields.message == "few inliers"
    assert values["status"] == "DEGRADED"
    assert values["reset_counter"] == "2"
    assert (values["features"], values["matches"], values["inliers"]) == ("800", "300", "120")
    assert values["rms_px"] == "0.457"
    assert values["detect_ms"] == "3.250"


@pytest.mark.parametrize(("converged", "said"), [(False, "false"), (True, "true")])
def test_status_tells_whether_an_unknown_scale_is_known(converged, said):
    stats = TrackStats(scale_sigma=0.0312)
    values = dict(status_fields(result(stats=stats, scale_converged=converged)).values)
    assert (values["scale_converged"], values["scale_sigma"]) == (said, "0.0312")


def test_status_is_silent_on_the_scale_of_a_method_without_that_unknown():
    assert not {"scale_converged", "scale_sigma"} & dict(status_fields(result()).values).keys()


def test_telemetry_survives_as_text():
    telemetry = Telemetry(
        fpa_temperature_kelvin=301.123456789,
        ffc_state=FfcState.IN_PROGRESS,
        frames_since_ffc=0,
        time_since_ffc_ns=12_345_678_901,
    )
    fields = telemetry_fields(7, "left", telemetry)
    assert isinstance(fields, DiagnosticFields)
    assert "housing_temperature_kelvin" not in dict(fields.values)
    assert telemetry_from_values(dict(fields.values)) == telemetry


@pytest.mark.parametrize("values", [{}, {"cpu": "3"}, {"ffc_state": "perhaps"}])
def test_foreign_or_broken_values_are_no_telemetry(values):
    assert telemetry_from_values(values) is None
