"""Poses of keyframes and how sure they are of themselves."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.keyframe_poses import KeyframePoses
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate


def chain(rng, count):
    step_covariance = np.diag([1e-4] * 3 + [1e-6] * 3)
    poses = [PoseEstimate.start(exp_se3(rng.normal(size=6)))]
    for _ in range(count - 1):
        poses.append(poses[-1].moved(exp_se3(rng.normal(size=6) * 0.2), step_covariance))
    return poses, step_covariance


def test_a_chain_of_steps_is_as_unsure_as_the_steps_in_a_row(rng):
    poses, step = chain(rng, 4)
    window = KeyframePoses(4)
    for i, pose in enumerate(poses):
        window.append(pose, np.zeros((6, 6)) if i == 0 else step)
        np.testing.assert_allclose(window.newest_pose().T_world_rig, pose.T_world_rig, atol=1e-9)
        np.testing.assert_allclose(
            window.newest_pose().covariance, pose.covariance, rtol=1e-6, atol=1e-15
        )
    assert window.is_full


def test_dropping_the_oldest_forgets_no_uncertainty(rng):
    poses, step = chain(rng, 5)
    window = KeyframePoses(4)
    for i, pose in enumerate(poses[:4]):
        window.append(pose, np.zeros((6, 6)) if i == 0 else step)
    before = window.newest_pose()
    assert window.drop_oldest() == 0
    after = window.newest_pose()
    np.testing.assert_allclose(after.T_world_rig, before.T_world_rig, atol=1e-9)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=0.05, atol=1e-12)
    assert window.append(poses[4], step) == 0  # the slot is used again
    assert window.order == [1, 2, 3, 0]


def test_an_adjustment_is_taken_over_slot_by_slot(rng):
    poses, step = chain(rng, 3)
    window = KeyframePoses(3)
    for i, pose in enumerate(poses):
        window.append(pose, np.zeros((6, 6)) if i == 0 else step)
    refined = np.stack([exp_se3(rng.normal(size=6)) for _ in range(3)])
    root = rng.normal(size=(12, 12)) * 1e-3
    window.refine(refined, root @ root.T)
    np.testing.assert_allclose(window.newest_pose().T_world_rig, inverse(refined[2]), atol=1e-9)
    alone = PoseEstimate(inverse(refined[0]), np.zeros((6, 6))).moved(
        refined[2] @ inverse(refined[0]), (root @ root.T)[6:, 6:]
    )
    np.testing.assert_allclose(window.newest_pose().covariance, alone.covariance, atol=1e-12)


def filled(poses, step):
    window = KeyframePoses(len(poses))
    for i, pose in enumerate(poses):
        window.append(pose, np.zeros((6, 6)) if i == 0 else step)
    return window


def test_any_keyframe_may_go_without_moving_the_others(rng):
    poses, step = chain(rng, 4)
    window = filled(poses, step)
    before = window.newest_pose()
    window.drop(2)
    assert window.order == [0, 1, 3]
    np.testing.assert_array_equal(window.newest_pose().T_world_rig, before.T_world_rig)
    np.testing.assert_array_equal(window.newest_pose().covariance, before.covariance)
    window.drop(0)
    assert window.order == [1, 3]
    np.testing.assert_allclose(
        window.newest_pose().covariance, before.covariance, rtol=0.05, atol=1e-12
    )


def test_lengths_in_another_unit(rng):
    """Positions as seen from a point that stays, and the variances of lengths with them."""
    poses, step = chain(rng, 3)
    window = filled(poses, step)
    before, origin_m = window.newest_pose(), poses[0].T_world_rig[:3, 3]
    window.rescale(2.5, origin_m)
    after = window.newest_pose()
    way_m = before.T_world_rig[:3, 3] - origin_m
    np.testing.assert_allclose(after.T_world_rig[:3, 3], origin_m + 2.5 * way_m, atol=1e-12)
    np.testing.assert_allclose(after.T_world_rig[:3, :3], before.T_world_rig[:3, :3], atol=1e-12)
    both = np.outer([2.5] * 3 + [1] * 3, [2.5] * 3 + [1] * 3)
    np.testing.assert_allclose(after.covariance, before.covariance * both, rtol=1e-6, atol=1e-15)
