"""Keyframes adjusted window by window along a way with turns: do the poses err as claimed?"""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, inverse, transform_points
from thermal_stereo_vo.evaluation.consistency import nees, nees_band
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import BundleProblem, adjust_bundle
from thermal_stereo_vo.odometry.keyframe_poses import KeyframePoses
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

from .stereo_problems import CAMERA
from .window_problems import bearings_of, eyes_of, seen_by

ROOM, KEYFRAMES, POINTS = 5, 36, 90
SIGMA_PX = 0.15


def way():
    """(KEYFRAMES, 4, 4) T_world_keyframe: 2 m a step, turns to one side and the other."""
    poses = [np.eye(4)]
    for i in range(KEYFRAMES - 1):
        turn = 0.06 * np.sin(i / 6.0)
        poses.append(poses[-1] @ exp_se3([0.1, -0.2, 2.0, 0.01 * np.cos(i), turn, 0.0]))
    return np.array(poses)


def noisy_view(rng, T_k_w, points_w):
    """(N, 4) where both eyes see points, with noise; NaN outside the picture."""
    seen = seen_by(T_k_w, points_w)
    with np.errstate(invalid="ignore"):
        inside = np.all((seen > 0.0) & (seen < [640.0, 512.0, 640.0, 512.0]), axis=1)
    seen[~inside] = np.nan
    return seen + rng.normal(0.0, SIGMA_PX, seen.shape)


def new_points(rng, count, T_w_k):
    """Pixels of the left eye and where in the world they are, 8 to 60 m off."""
    pixels = rng.uniform([20.0, 20.0], [620.0, 490.0], (count, 2))
    depth_m = 1.0 / rng.uniform(1 / 60.0, 1 / 8.0, count)
    return pixels, transform_points(T_w_k, bearings_of(pixels) * depth_m[:, None])


def fly(rng, poses_true):
    """The newest pose after each keyframe, as the windowed method finds it."""
    gain = CAMERA.fx * CAMERA.baseline_m
    window, names, found = KeyframePoses(ROOM), [], []
    hosts, pixels, rhos = np.zeros(0, int), np.zeros((0, 2)), np.zeros(0)
    points_w, observed = np.zeros((0, 3)), np.zeros((len(poses_true), 0, 4))
    for k, T_w_k in enumerate(poses_true):
        if window.is_full:
            window.drop_oldest()
            kept = hosts != names.pop(0)
            hosts, pixels, rhos = hosts[kept], pixels[kept], rhos[kept]
            points_w, observed = points_w[kept], observed[:, kept]
        pose = PoseEstimate.start()
        if names:
            pose = window.newest_pose().moved(inverse(T_w_k) @ poses_true[k - 1], np.zeros((6, 6)))
        window.append(pose, np.zeros((6, 6)))
        names.append(k)
        observed[k] = noisy_view(rng, inverse(T_w_k), points_w)
        count = max(POINTS - int(np.isfinite(observed[k, :, 0]).sum()), 0)
        px, fresh_w = new_points(rng, count, T_w_k)
        fresh = np.full((len(poses_true), count, 4), np.nan)
        fresh[k] = noisy_view(rng, inverse(T_w_k), fresh_w)
        fresh[k, :, :2] = px  # in its host a point is the centre of its patch
        disparity = px[:, 0] - CAMERA.cx - fresh[k, :, 2] + CAMERA.cx_right
        hosts, pixels = np.append(hosts, np.full(count, k)), np.vstack([pixels, px])
        rhos = np.append(rhos, np.maximum(np.nan_to_num(disparity, nan=1.0) / gain, 1e-3))
        points_w = np.vstack([points_w, fresh_w])
        observed = np.concatenate([observed, fresh], axis=1)
        if len(names) > 1:
            problem = BundleProblem(
                window.T_k_w[window.order].copy(), np.searchsorted(names, hosts),
                bearings_of(pixels), rhos.copy(), np.ascontiguousarray(observed[names]),
                np.ones((len(names), len(hosts))), eyes_of(),
            )  # fmt: skip
            solution = adjust_bundle(problem, sigma_floor_px=0.05, iterations=8)
            window.refine(solution.T_k_w, solution.covariance)
            rhos = solution.rhos
        found.append(window.newest_pose())
    return found


def test_a_flight_of_windows_errs_as_claimed():
    """Independent noise over 70 m: neither too sure of itself, nor much too unsure.

    Steps share points with their neighbours and err against each other, which the chain of poses
    does not know: it claims more rather than less.
    """
    truth, runs = way(), 12
    ends = [fly(np.random.default_rng(seed), truth)[-1] for seed in range(runs)]
    values = nees(
        np.tile(truth[-1], (runs, 1, 1)),
        np.array([pose.T_world_rig for pose in ends]),
        np.array([pose.covariance for pose in ends]),
    )
    low, high = nees_band(runs, confidence=0.99)
    assert 0.8 * low < np.mean(values) < high
