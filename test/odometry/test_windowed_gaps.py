"""Corrections in fast turns: what the eyes see after them is not what they saw before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import GapReason, RigFrame
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import inverse, log_so3
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry

STEP = (0.01, 0.0, 0.03, 0.0, np.radians(6.0), 0.0)
"""60 deg/s at 10 Hz, and a little drift; the lens sees 64 deg."""


@pytest.fixture(scope="module")
def turn(room):
    rng = np.random.default_rng(4)
    poses = room.path(26, STEP)
    return poses, [room.rig_frame(i * 10**8, T, rng) for i, T in enumerate(poses)]


def without(frame: RigFrame, *roles: str) -> RigFrame:
    views = {role: view for role, view in frame.views.items() if role not in roles}
    return replace(frame, views=views, blind=dict.fromkeys(roles, GapReason.FFC))


def fly(frames):
    odometry = create_odometry(with_overrides(OdometryConfig(), ["window=7"]))
    return [odometry.process(frame) for frame in frames]


def letters(results) -> str:
    return "".join(result.status.value[0] for result in results)


def errors_m(results, poses):
    return [
        float(np.linalg.norm(r.T_world_rig[:3, 3] - T[:3, 3]))
        for r, T in zip(results, poses, strict=True)
    ]


def test_a_turn_out_of_sight_goes_on_from_the_prediction_at_once(turn):
    """Blind for 1.1 s and 66 deg: nothing of the keyframes is left to be found."""
    poses, frames = turn
    blind = range(6, 16)
    results = fly([without(f, "left", "right") if i in blind else f for i, f in enumerate(frames)])
    assert letters(results) == "I" + 5 * "T" + 11 * "G" + 9 * "T"
    assert {r.reset_counter for r in results} == {0}
    assert max(errors_m(results, poses)) < 0.1
    turned = log_so3(results[-1].T_world_rig[:3, :3].T @ poses[-1][:3, :3])
    assert np.linalg.norm(turned) < np.radians(3.0)
    # What was not seen stays unsure: a second at 3 m/s^2.
    sigma_m = np.sqrt(results[-1].covariance[0, 0])
    assert 1.0 < sigma_m < 4.0


def test_a_turn_that_leaves_a_strip_in_sight_is_measured_at_once(turn):
    """42 deg unseen: a third of the last view is enough, if it was kept."""
    poses, frames = turn
    blind = range(7, 13)
    results = fly([without(f, "left", "right") if i in blind else f for i, f in enumerate(frames)])
    assert letters(results) == "I" + 6 * "T" + 6 * "G" + 13 * "T"
    assert np.sqrt(results[13].covariance[0, 0]) < 0.1
    assert max(errors_m(results, poses)[13:]) < 0.06


@pytest.mark.parametrize("eye", ["left", "right"])
def test_one_blind_eye_does_not_end_a_turn(turn, eye):
    """For 1 s and 60 deg: new points take the place of those that leave the picture.

    Their depths are guesses until both eyes see them; then the way is as long as it was.
    """
    poses, frames = turn
    results = fly([without(f, eye) if 6 <= i < 16 else f for i, f in enumerate(frames)])
    assert letters(results) == "I" + 25 * "T"
    assert any(r.stats.keyframe for r in results[6:16])
    assert results[16].stats.keyframe
    assert min(r.stats.inliers for r in results[6:]) > 100
    assert max(errors_m(results, poses)) < 0.06
    assert max(errors_m(results, poses)[17:]) < 0.01


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("eye", ["left", "right"])
def test_points_of_one_eye_that_cannot_be_had_are_looked_for_in_the_next_frame(turn, eye, threads):
    """Two frames later the turn leaves hardly any of the old ones in the picture."""
    poses, frames = turn
    settings = ["window=7", f"threads={threads}"]
    odometry = create_odometry(with_overrides(OdometryConfig(), settings))
    complete, asked = odometry._complete_one_eye, []

    def fail_first(*args):
        asked.append(args)
        if len(asked) == 1:
            raise ValueError("no neighbours")
        return complete(*args)

    odometry._complete_one_eye = fail_first
    results = [
        odometry.process(without(f, eye) if 6 <= i < 16 else f) for i, f in enumerate(frames)
    ]
    told = [i for i, r in enumerate(results) if "ValueError: no neighbours" in r.reason]
    assert len(told) == 1
    assert len(asked) >= 2
    assert results[told[0] - 1].stats.keyframe
    assert results[told[0]].stats.keyframe
    assert letters(results) == "I" + 25 * "T"
    assert max(errors_m(results, poses)) < 0.06


def test_a_stop_within_a_gap_costs_no_keyframe(room):
    """What is predicted is far off; what is seen is what was seen before."""
    rng = np.random.default_rng(6)
    poses = room.path(7, (0.03, 0.0, 0.02, 0.0, 0.01, 0.0))
    poses = [*poses, *6 * [poses[-1]]]
    frames = [room.rig_frame(i * 10**8, T, rng) for i, T in enumerate(poses)]
    results = fly([without(f, "left", "right") if 7 <= i < 11 else f for i, f in enumerate(frames)])
    assert letters(results) == "I" + 6 * "T" + 4 * "G" + 2 * "T"
    errors = errors_m(results, poses)
    assert errors[10] > 0.1
    assert max(errors[11:]) < 0.003
    assert not any(r.stats.keyframe for r in results[11:])
    assert results[11].stats.inliers > 0.9 * results[12].stats.inliers


@pytest.mark.parametrize("eye", ["left", "right"])
def test_a_lens_that_is_covered_unnoticed_costs_no_pose(turn, eye):
    """Grey with noise, as a view like any other: the other eye goes on alone."""
    poses, frames = turn
    rng = np.random.default_rng(1)
    covered = list(frames)
    for i in range(6, 10):
        view = frames[i].views[eye]
        grey = np.round(128 + 1.5 * rng.standard_normal(view.image.shape)).astype(np.uint8)
        views = {**frames[i].views, eye: replace(view, image=grey, display=grey)}
        covered[i] = replace(frames[i], views=views)
    results = fly(covered)
    assert letters(results) == "I" + 25 * "T"
    assert max(errors_m(results, poses)) < 0.06


def test_no_motion_is_made_up_by_keeping_the_last_view(turn):
    """The same flight with a short gap ends where that without one ends."""
    _, frames = turn
    whole = fly(frames[:14])
    gap = fly([without(f, "left", "right") if i == 8 else f for i, f in enumerate(frames[:14])])
    apart = inverse(whole[-1].T_world_rig) @ gap[-1].T_world_rig
    assert np.linalg.norm(apart[:3, 3]) < 0.02
    assert all(r.status is TrackingStatus.TRACKING for r in gap[9:])
