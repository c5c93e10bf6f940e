"""Features and the motion between two frames, as both feature methods use them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig, FeatureMatcher
from thermal_stereo_vo.odometry.feature_based.loop_matching import LoopMatches
from thermal_stereo_vo.odometry.feature_based.motion import MotionConfig
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.solvers import DOUBLE_DOGLEG
from thermal_stereo_vo.odometry.workers import make_worker

from .stereo_problems import CAMERA, difference, make_problem


def matcher(**motion) -> FeatureMatcher:
    config = FeatureConfig(motion=MotionConfig(**motion))
    return FeatureMatcher(config, DOUBLE_DOGLEG, make_worker(1, "test"), 0)


def loops_of(problem) -> LoopMatches:
    """The problem as the four images' pixels."""
    before = CAMERA.project(problem.points).astype(np.float32)
    now = problem.observed.astype(np.float32)
    n = len(before)
    return LoopMatches(
        now[:, :2], now[:, 2:], before[:, :2], before[:, 2:], np.zeros(n, np.int64),
        np.zeros((n, 4), np.int64),
    )  # fmt: skip


def test_a_prediction_stands_in_for_samples(rng):
    """With six of ten wrong and one sample, only the predicted motion can tell the good ones."""
    problem = make_problem(rng, 100, sigma_px=0.2, translation_m=1.0, rotation_rad=0.1)
    observed = problem.observed.copy()
    observed[:60] += rng.uniform(20, 80, (60, 4))
    loops = loops_of(replace(problem, observed=observed))
    one_sample = matcher(ransac_iterations=1)
    motion = one_sample.measure(loops, CAMERA, inverse(problem.T_true))
    assert motion.inliers[60:].all()
    assert not motion.inliers[:60].any()
    assert np.abs(difference(motion.T_current_previous, problem.T_true)).max() < 0.05
    assert one_sample.measure(loops, CAMERA, None) is None
    assert one_sample.measure(loops, CAMERA, problem.T_true) is None  # the wrong way round


def test_frames_that_show_depth_are_told_from_those_that_do_not(room):
    frame = room.rig_frame(0, np.eye(4), np.random.default_rng(0))
    left, right = frame.views["left"], frame.views["right"]
    camera = StereoCamera.of(left, right)
    m = matcher()
    assert m.sees_enough(m.extract(left, right), camera)
    black = replace(left, display=np.zeros(left.image.shape, np.uint8))
    assert not m.sees_enough(m.extract(black, right), camera)
    assert not m.sees_enough(m.extract(right, left), camera)  # swapped eyes


def test_views_without_8_bit_form_are_refused(room):
    views = room.rig_frame(0, np.eye(4)).views
    with pytest.raises(
        FrameError, match="view 'right' has no 8-bit form: run the frame through the AGC"
    ):
        matcher().extract(views["left"], replace(views["right"], display=None))
