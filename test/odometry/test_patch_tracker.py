"""One stereo frame against the patches of a keyframe, by either eye or both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3
from thermal_stereo_vo.odometry.feature_based.corners import CornerConfig
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.feature_based.patch_tracker import PatchTracker, TrackingConfig
from thermal_stereo_vo.odometry.feature_based.stereo_points import find_stereo_points
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.workers import make_worker

STEP = exp_se3([0.05, -0.02, 0.2, 0.01, 0.02, -0.01])
"""T_world_rig of the second frame."""


@pytest.fixture(scope="module")
def frames(room):
    rng = np.random.default_rng(6)
    return [room.rig_frame(k, T, rng) for k, T in enumerate((np.eye(4), STEP))]


def tracker(**settings):
    return PatchTracker(replace(TrackingConfig(), **settings), make_worker(1, "test"), 0)


def keyframe(patches, frame):
    """A window with the points of one frame at the origin."""
    left, right = frame.views["left"], frame.views["right"]
    pyramids = patches.pyramids(left, right)
    window = KeyframeWindow(3, 600, left.image.shape, StereoCamera.of(left, right))
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), pyramids[0])
    pixels, right_x_px = find_stereo_points(
        window, *pyramids, None, np.zeros((0, 2)), 60.0, CornerConfig(points=200), TrackingConfig()
    )
    window.add_points(pixels, right_x_px, np.zeros(len(pixels)))
    return window


EYES = {"both": ("left", "right"), "left": ("left",), "right": ("right",)}


@pytest.mark.parametrize("eyes", EYES.values(), ids=EYES)
def test_the_pose_is_found_by_either_eye_from_a_wrong_start(frames, eyes):
    patches = tracker()
    window = keyframe(patches, frames[0])
    seen = [frames[1].views[role] if role in eyes else None for role in ("left", "right")]
    start = exp_se3([0.02, 0.01, -0.05, 0.003, -0.004, 0.002]) @ inverse(STEP)
    points, observed, score = patches.align(window, patches.pyramids(*seen), start)
    blind = [k for k, role in enumerate(("left", "right")) if role not in eyes]
    for k in blind:
        assert np.isnan(observed[:, 2 * k : 2 * k + 2]).all()
    tracked = patches.locate(window, points, observed, score, start)
    assert 60 < tracked.count <= len(points) == len(observed)
    off = log_se3(tracked.pose.T_camera_world @ STEP)
    assert 1e-6 < np.linalg.norm(off[:3]) < 0.03
    assert 1e-7 < np.linalg.norm(off[3:]) < 0.004
    assert off @ np.linalg.solve(tracked.pose.covariance, off) < 60.0
    dy_px = tracked.epipolar_dy_px()
    assert abs(dy_px) < 0.05
    assert (dy_px == 0.0) == bool(blind)


def test_same_seed_same_pose(frames):
    poses = []
    patches = tracker()
    window = keyframe(patches, frames[0])
    pyramids = patches.pyramids(frames[1].views["left"], frames[1].views["right"])
    for _ in range(2):
        patches.reset()
        found = patches.align(window, pyramids, inverse(STEP))
        poses.append(patches.locate(window, *found, inverse(STEP)).pose.T_camera_world)
    np.testing.assert_array_equal(*poses)


def test_rows_that_do_not_agree_are_not_seen_by_the_right_eye(frames):
    """Three rows off: the left eye alone is believed."""
    patches = tracker()
    window = keyframe(patches, frames[0])
    right = frames[1].views["right"]
    crooked = replace(right, image=np.roll(right.image, 3, axis=0))
    pyramids = patches.pyramids(frames[1].views["left"], crooked)
    _, observed, _ = patches.align(window, pyramids, inverse(STEP))
    seen = np.isfinite(observed[:, [0, 2]]).mean(axis=0)
    assert seen[0] > 0.7
    assert seen[1] < 0.1


def test_too_few_points_are_no_measurement(frames):
    patches = tracker()
    window = keyframe(patches, frames[0])
    pyramids = patches.pyramids(frames[1].views["left"], frames[1].views["right"])
    points, observed, score = patches.align(window, pyramids, inverse(STEP))
    found = np.flatnonzero(np.isfinite(observed).all(axis=1))
    observed[found[TrackingConfig().min_inliers - 1 :]] = np.nan
    observed[np.isnan(observed).any(axis=1)] = np.nan
    assert patches.locate(window, points, observed, score, inverse(STEP)) is None
    shuffled = np.random.default_rng(0).uniform(0, 240, observed.shape)
    assert patches.locate(window, points, shuffled, score, inverse(STEP)) is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_frame_for_warming_up_can_be_tracked(dtype):
    """A plane at 260 px * 0.25 m / 8 px: every kernel has something to do."""
    patches = tracker()
    frame = synthetic_pair(0, dtype)
    window = keyframe(patches, frame)
    points = window.points()
    assert len(points) > 80
    assert np.median(1.0 / points.rhos) == pytest.approx(260 * 0.25 / 8, rel=0.01)
    pyramids = patches.pyramids(frame.views["left"], frame.views["right"])
    found = patches.align(window, pyramids, np.eye(4))
    # Its points stay where they were on the sensor, but so they should.
    assert patches.locate(window, *found, np.eye(4)).count > 60
