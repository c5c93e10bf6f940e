"""Poses and covariances composed over many steps, against Monte Carlo."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, inverse, log_so3, make_transform
from thermal_stereo_vo.evaluation.consistency import nees, nees_band
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

STEPS = 12
# Turning while climbing ahead, so that every axis takes part.
T_BEFORE_AFTER = exp_se3([0.1, -0.05, 0.8, 0.02, 0.12, -0.03])
SIGMA = np.array([0.01, 0.005, 0.03, 0.004, 0.006, 0.002])


def chain(start: PoseEstimate, steps, covariance) -> PoseEstimate:
    pose = start
    for T_after_before in steps:
        pose = pose.moved(T_after_before, covariance)
    return pose


def test_poses_are_composed_in_order():
    pose = PoseEstimate.start(exp_se3([1, 2, 3, 0.1, 0.2, 0.3]))
    expected = pose.T_world_rig @ T_BEFORE_AFTER @ exp_se3([0, 0, 1, 0, 0, 0])
    moved = pose.moved(inverse(T_BEFORE_AFTER), np.zeros((6, 6)))
    moved = moved.moved(inverse(exp_se3([0, 0, 1, 0, 0, 0])), np.zeros((6, 6)))
    np.testing.assert_allclose(moved.T_world_rig, expected, atol=1e-12)
    np.testing.assert_array_equal(moved.covariance, 0.0)


def test_a_step_ahead_after_a_turn_to_the_right_goes_right():
    """Optical axes: z ahead, x right, y down; a turn to the right is positive about y."""
    T_before_after = make_transform(exp_so3([0.0, np.pi / 2, 0.0]), np.zeros(3))
    pose = PoseEstimate.start().moved(inverse(T_before_after), np.zeros((6, 6)))
    ahead = make_transform(np.eye(3), [0.0, 0.0, 1.0])
    pose = pose.moved(inverse(ahead), np.zeros((6, 6)))
    np.testing.assert_allclose(pose.T_world_rig[:3, 3], [1.0, 0.0, 0.0], atol=1e-12)


def test_covariance_is_that_of_monte_carlo():
    """p_true = p + e[:3] and R_true = Exp(e[3:]) R in world axes, as ``core`` defines them."""
    rng = np.random.default_rng(2)
    C_step = np.diag(SIGMA**2)
    C_step[0, 4] = C_step[4, 0] = 0.8 * SIGMA[0] * SIGMA[4]
    C_step[2, 3] = C_step[3, 2] = -0.5 * SIGMA[2] * SIGMA[3]
    T_start = exp_se3([3.0, -1.0, 2.0, 0.4, -0.3, 0.8])
    T_after_before = inverse(T_BEFORE_AFTER)
    estimate = chain(PoseEstimate.start(T_start), [T_after_before] * STEPS, C_step)
    errors = []
    for _ in range(4000):
        noise = rng.multivariate_normal(np.zeros(6), C_step, size=STEPS)
        T_true = T_start
        for e in noise:
            T_true = T_true @ inverse(exp_se3(e) @ T_after_before)
        R = estimate.T_world_rig[:3, :3]
        errors.append(
            np.concatenate([
                T_true[:3, 3] - estimate.T_world_rig[:3, 3],
                log_so3(T_true[:3, :3] @ R.T),
            ])
        )  # fmt: skip
    scatter = np.cov(np.array(errors).T)
    whitened = np.linalg.solve(np.linalg.cholesky(estimate.covariance), np.array(errors).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.12)
    ratio = np.sqrt(np.diag(estimate.covariance) / np.diag(scatter))
    assert np.all((ratio > 0.94) & (ratio < 1.06)), ratio


def test_a_heading_error_becomes_a_position_error_along_the_way():
    """After 100 m ahead a yaw error of 1 mrad is 0.1 m sideways, and nothing along the path."""
    yaw = np.zeros((6, 6))
    yaw[4, 4] = 1e-6
    pose = PoseEstimate(np.eye(4), yaw).moved(
        inverse(make_transform(np.eye(3), [0.0, 0.0, 100.0])), np.zeros((6, 6))
    )
    sigma = np.sqrt(np.diag(pose.covariance))
    np.testing.assert_allclose(sigma[:3], [0.1, 0.0, 0.0], atol=1e-9)
    assert pose.covariance[0, 4] > 0  # turned right (y down) is gone right


def test_step_noise_enters_in_world_axes():
    """Noise along the optical axis of a rig that looks along world x is noise in world x."""
    looks_along_x = make_transform(exp_so3([0.0, np.pi / 2, 0.0]), np.zeros(3))
    C = np.zeros((6, 6))
    C[2, 2] = 0.04
    pose = PoseEstimate.start(looks_along_x).moved(np.eye(4), C)
    np.testing.assert_allclose(np.diag(pose.covariance)[:3], [0.04, 0.0, 0.0], atol=1e-12)


def test_covariance_stays_symmetric_and_positive_and_never_shrinks():
    pose = PoseEstimate.start()
    last = 0.0
    for _ in range(500):
        pose = pose.moved(inverse(T_BEFORE_AFTER), np.diag(SIGMA**2))
        assert np.array_equal(pose.covariance, pose.covariance.T)
        rotation = np.trace(pose.covariance[3:, 3:])
        assert rotation > last
        last = rotation
    assert np.linalg.eigvalsh(pose.covariance).min() > 0


def test_rotations_stay_rotations_over_many_steps():
    pose = chain(PoseEstimate.start(), [inverse(T_BEFORE_AFTER)] * 5000, np.zeros((6, 6)))
    R = pose.T_world_rig[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)


def test_the_start_is_a_copy():
    T = np.eye(4)
    pose = PoseEstimate.start(T)
    T[0, 3] = 5.0
    assert pose.T_world_rig[0, 3] == 0.0
    np.testing.assert_array_equal(PoseEstimate.start().T_world_rig, np.eye(4))


def test_nees_of_a_long_way_with_turns_is_that_of_a_true_covariance():
    """500 m with turns to both sides: axes and order of the noise show only on long ways."""
    rng = np.random.default_rng(7)
    C_step = np.diag([4e-3, 3e-3, 6e-3, 2e-4, 3e-4, 4e-4]) ** 2
    C_step[0, 4] = C_step[4, 0] = -0.8 * 4e-3 * 3e-4
    C_step[1, 3] = C_step[3, 1] = 0.7 * 3e-3 * 2e-4
    root = np.linalg.cholesky(C_step)
    turns = np.repeat([0.0, 0.05, 0.0, 0.05, 0.0, -0.05, 0.0, 0.05, 0.0, 0.05], 50)
    steps = [inverse(exp_se3([0.02, -0.1, 1.0, 0.002, turn, -0.001])) for turn in turns]
    flights, estimated, covariances = 40, [], []
    for _ in range(flights):
        pose = PoseEstimate.start()
        for T_after_before in steps:
            # What is measured is the truth with noise, so that the truth is the same every time.
            pose = pose.moved(exp_se3(root @ rng.normal(size=6)) @ T_after_before, C_step)
        estimated.append(pose.T_world_rig)
        covariances.append(pose.covariance)
    T_true = np.eye(4)
    for T_after_before in steps:
        T_true = T_true @ inverse(T_after_before)
    truth = np.tile(T_true, (flights, 1, 1))
    low, high = nees_band(flights, confidence=0.999)
    assert low < np.mean(nees(truth, np.array(estimated), np.array(covariances))) < high
