from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import inverse, log_se3
from thermal_stereo_vo.evaluation.opencv_baseline import OpenCvBaseline

N = 10


@pytest.fixture(scope="module")
def frames(room):
    poses = room.path(N)
    rng = np.random.default_rng(1)
    return [room.rig_frame(i * 100_000_000, T, rng) for i, T in enumerate(poses)]


def test_follows_the_true_path(frames, room):
    baseline = OpenCvBaseline()
    results = [baseline.process(frame) for frame in frames]
    np.testing.assert_array_equal(results[0].T_world_rig, np.eye(4))
    assert results[0].status is TrackingStatus.INITIALISING
    assert {r.status for r in results[1:]} == {TrackingStatus.TRACKING}
    assert all(50 < r.stats.inliers <= 1000 for r in results[1:])
    truth = room.path(N)
    way_m = np.sum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))
    for result, T in zip(results, truth, strict=True):
        error = log_se3(inverse(T) @ result.T_world_rig)
        assert np.linalg.norm(error[:3]) < 0.04 * way_m
        assert np.linalg.norm(error[3:]) < 0.01


def test_same_frames_same_poses(frames):
    one, other = OpenCvBaseline(), OpenCvBaseline()
    for frame in frames[:4]:
        np.testing.assert_array_equal(
            one.process(frame).T_world_rig, other.process(frame).T_world_rig
        )


def test_without_texture_it_goes_on_as_before(frames):
    baseline = OpenCvBaseline()
    last, now = [baseline.process(frame).T_world_rig for frame in frames[:4]][-2:]
    grey = {
        role: dataclasses.replace(view, display=np.full_like(view.display, 128))
        for role, view in frames[4].views.items()
    }
    result = baseline.process(RigFrame(frames[4].stamp_ns, grey))
    assert result.status is TrackingStatus.GAP
    np.testing.assert_allclose(inverse(now) @ result.T_world_rig, inverse(last) @ now, atol=1e-12)
    # Nothing to go on from: the next frame has no corners to look for.
    assert baseline.process(frames[5]).status is TrackingStatus.GAP
    assert baseline.process(frames[6]).status is TrackingStatus.TRACKING


@pytest.mark.parametrize("role", ["left", "right"])
def test_a_blind_eye_is_refused(frames, role):
    views = {name: view for name, view in frames[0].views.items() if name != role}
    with pytest.raises(FrameError, match=f"needs an 8-bit view of the {role} eye"):
        OpenCvBaseline().process(RigFrame(0, views))
    views[role] = dataclasses.replace(frames[0].views[role], display=None)
    with pytest.raises(FrameError, match="run the frame through the AGC"):
        OpenCvBaseline().process(RigFrame(0, views))
