"""Features that stick to the sensor are told from points that stand still by right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import inverse, log_se3
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry
from thermal_stereo_vo.odometry.feature_based.fixed_pattern import on_fixed_pattern

NAN = float("nan")


def moved(flow_px):
    before = np.random.default_rng(0).uniform(50, 200, (len(flow_px), 2))
    return before, before + np.column_stack([flow_px, np.zeros(len(flow_px))])


def test_what_stands_still_though_it_should_move():
    """Far points stand still by right."""
    before, now = moved([5.0, 4.0, 0.1, 0.1, 6.0, 0.4, NAN])
    expected = np.array([5.0, 5.0, 0.9, 1.1, 6.0, 6.0, 6.0])
    predicted = before + np.column_stack([np.zeros(7), expected])
    got = on_fixed_pattern(before, now, predicted)
    np.testing.assert_array_equal(got, [0, 0, 0, 1, 0, 0, 0])


@pytest.mark.parametrize("flow", [[0.1, 0.2, 0.0, 9.0], [0.9, 0.9, 0.1], [NAN, NAN], []])
def test_a_wrong_prediction_rejects_nothing(flow):
    """The rig has stopped: most features stand still."""
    before, now = moved(flow)
    assert not on_fixed_pattern(before, now, before + 10.0).any()


def dirty(frame: RigFrame, patterns: np.ndarray) -> RigFrame:
    """The frame behind a pattern that sticks to the pixels of each eye."""
    views = {}
    for (role, view), pattern in zip(frame.views.items(), patterns, strict=True):
        image = np.clip(0.35 * view.image + pattern, 0, 255).astype(np.uint8)
        views[role] = replace(view, image=image, display=image)
    return replace(frame, views=views)


@pytest.mark.parametrize("window", [7])
def test_a_pattern_that_appears_in_flight_does_not_hold_the_pose_back(room, window):
    """Blots on the sensors from frame 4 on, as one scene at a fixed distance for both eyes."""
    rng = np.random.default_rng(3)
    height, width = room.camera.height, room.camera.width
    pattern = np.zeros((height, width))
    for y, x in rng.integers(6, (height - 6, width - 26), (60, 2)):
        pattern[y - 2 : y + 3, x - 2 : x + 3] += 90.0 * rng.random((5, 5))
    patterns = np.stack([pattern, np.roll(pattern, -8, axis=1)])
    poses = room.path(12, (0.08, 0.0, 0.0, 0.0, 0.0, 0.0))
    frames = [room.rig_frame(i * 10**8, T, rng) for i, T in enumerate(poses)]
    frames = frames[:4] + [dirty(frame, patterns) for frame in frames[4:]]
    odometry = create_odometry(with_overrides(OdometryConfig(), [f"window={window}"]))
    results = [odometry.process(frame) for frame in frames]
    assert all(r.status is TrackingStatus.TRACKING for r in results[1:])
    error = log_se3(inverse(results[-1].T_world_rig) @ poses[-1])
    assert np.linalg.norm(error[:3]) < 0.05 * 0.88
    late = results[5:]
    assert sum(r.stats.zero_flow for r in late) < 0.01 * sum(r.stats.inliers for r in late)
