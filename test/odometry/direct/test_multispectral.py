"""What a method of two bands that never compares one with the other must be asked."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import GapReason
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.evaluation.alignment import umeyama
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry
from thermal_stereo_vo.odometry.workers import InlineExecutor

from .two_band_room import Room, sliding, swaying

FRAMES, START = 100, 75
SETTINGS = (
    "method=multispectral",
    "status.bolometer_lag_ms=0",
    "multispectral.selection.points=250",
    "multispectral.keyframes.flow_px=25",
    "threads=1",
)


def odometry(*settings):
    return create_odometry(with_overrides(OdometryConfig(), [*SETTINGS, *settings]))


def fly(method, frames):
    return [method.process(frame) for frame in frames]


def copied(method):
    """With its adjustment under way, which has no thread of its own here and is done."""
    return copy.deepcopy(method, {id(method._update): method._update})


def without(frame, role):
    views = {name: view for name, view in frame.views.items() if name != role}
    return replace(frame, views=views, blind={role: GapReason.FFC})


@pytest.fixture(scope="module")
def flight():
    poses, room, rng = swaying(FRAMES), Room(3), np.random.default_rng(5)
    return [room.frame(i, T, rng) for i, T in enumerate(poses)], poses


@pytest.fixture(scope="module")
def flown(flight):
    """The method at ``START`` and what it has said until then."""
    method = odometry()
    return method, fly(method, flight[0][:START])


@pytest.fixture(scope="module")
def results(flight, flown):
    method, before = flown
    return before + fly(copied(method), flight[0][START:])


def metric(results, poses):
    """Positions found and true, in metres, while the scale is known."""
    known = [i for i, result in enumerate(results) if result.scale_converged]
    return (
        np.array([results[i].T_world_rig[:3, 3] for i in known]),
        np.array([poses[i][:3, 3] for i in known]),
    )


def scale_and_error(found, true):
    """Lengths found by true ones, and the error that is left with those lengths as they are."""
    scale = umeyama(found, true, with_scale=True).scale
    return 1.0 / scale, rms_m(umeyama(found, true), found, true)


def rms_m(similarity, found, true):
    T = similarity.T_true_est
    left = true - similarity.scale * found @ T[:3, :3].T - T[:3, 3]
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def test_metres_are_found_by_turning(flight, results):
    found, true = metric(results, flight[1])
    assert 30 < len(found) < FRAMES - 10
    scale, error_m = scale_and_error(found, true)
    assert 0.97 < scale < 1.03
    assert error_m < 0.01
    assert all(result.status is TrackingStatus.TRACKING for result in results[1:])


def test_until_then_it_says_that_lengths_are_in_no_unit(results):
    first = next(i for i, result in enumerate(results) if result.scale_converged)
    assert first > 10
    for result in results[1:first]:
        assert result.scale_converged is False
        assert np.diag(result.covariance)[:3].min() > 1e5
        assert np.diag(result.twist_covariance)[:3].min() > 1e5
        assert np.diag(result.covariance)[3:].max() < 0.1
    for result in results[first + 1 :]:
        assert result.scale_converged is True
        assert np.diag(result.covariance)[:3].max() < 0.1


def test_the_unit_is_that_of_the_lever_arm(flight, results):
    """A calibration whose arm is 30 % too long makes everything 30 % too long."""
    frames, poses = flight
    wrong = []
    for frame in frames:
        T = frame.views[THERMAL].T_rig_camera.copy()
        T[:3, 3] *= 1.3
        views = {**frame.views, THERMAL: replace(frame.views[THERMAL], T_rig_camera=T)}
        wrong.append(replace(frame, views=views))
    scale, _ = scale_and_error(*metric(fly(odometry(), wrong), poses))
    assert 1.25 < scale < 1.36


@pytest.mark.parametrize(("away", "count"), [(THERMAL, 8), (VISIBLE, 20)])
def test_either_camera_carries_on_alone(flight, flown, away, count):
    check_that_it_goes_on(flight, flown, lambda frame: without(frame, away), count)


def test_one_camera_takes_over_the_points_of_the_other(flight, flown):
    method, before = flown
    alone = [without(frame, VISIBLE) for frame in flight[0][START:]]
    results = fly(copied(method), alone)
    assert results[0].stats.inliers < 0.6 * before[-1].stats.inliers
    assert results[-1].stats.inliers > 1.5 * results[0].stats.inliers


def test_what_never_fits_makes_no_keyframes(flight):
    """A third of the picture is another one each time."""
    rng, frames = np.random.default_rng(8), []
    for frame in flight[0][:40]:
        view = frame.views[VISIBLE]
        image = view.image.copy()
        waves = rng.normal(0, 60, (12, 14)).astype(np.float32)
        noise = cv2.resize(waves, (107, 240), interpolation=cv2.INTER_CUBIC)
        image[:, :107] = np.clip(120 + noise, 0, 255)
        seen = replace(frame, views={**frame.views, VISIBLE: replace(view, image=image)})
        frames.append(without(seen, THERMAL))
    results = fly(odometry("multispectral.keyframes.inlier_share=0.9"), frames)
    assert all(result.status is TrackingStatus.TRACKING for result in results[1:])
    assert 2 < sum(result.stats.keyframe for result in results[20:]) < 12


@pytest.mark.parametrize(("role", "value"), [(VISIBLE, 0), (VISIBLE, 255), (THERMAL, 16383)])
def test_a_picture_that_shows_nothing_does_no_harm(flight, flown, role, value):
    """Black or saturated, and nobody says that the camera is blind."""

    def filled(frame):
        view = frame.views[role]
        image = np.full_like(view.image, value)
        return replace(frame, views={**frame.views, role: replace(view, image=image)})

    check_that_it_goes_on(flight, flown, filled, 8)


def noise(view, rng):
    """Nobody's scene, as strong as the true one, another one each time."""
    height, width = view.image.shape
    waves = rng.normal(0, 100, (height // 8, width // 8)).astype(np.float32)
    return 7000 + cv2.resize(waves, (width, height), interpolation=cv2.INTER_CUBIC)


def shutter(view, rng):
    """A warm blade out of focus."""
    y, x = np.indices(view.image.shape)
    return 7300 + 60 * np.cos(x / 60) * np.cos(y / 50)


def contradicting(image_of):
    """Frames whose thermal picture nobody says is not of the scene."""
    rng = np.random.default_rng(8)

    def part(frame):
        view = frame.views[THERMAL]
        image = np.clip(image_of(view, rng), 0, 16383).astype(np.uint16)
        return replace(frame, views={**frame.views, THERMAL: replace(view, image=image)})

    return part


@pytest.mark.parametrize("image_of", [noise, shutter])
def test_a_picture_that_contradicts_the_other_camera_is_left_out_and_said_to_be(
    flight, flown, image_of
):
    results = check_that_it_goes_on(flight, flown, contradicting(image_of), 8)
    told = ["thermal camera shows does not fit" in result.reason for result in results]
    assert told == [True] * 8 + [False] * (len(told) - 8)
    # It makes no keyframes: those would be full of what it shows.
    gone = fly(copied(flown[0]), [without(f, THERMAL) for f in flight[0][START : START + 8]])
    assert [r.stats.keyframe for r in results[:8]] == [r.stats.keyframe for r in gone]


def test_a_camera_that_has_long_contradicted_begins_anew(flight, flown):
    method = copied(flown[0])
    method._patience_ns = 200_000_000
    strange = contradicting(noise)
    fly(method, map(strange, flight[0][START : START + 7]))
    results = fly(method, flight[0][START + 7 : START + 20])
    assert all(result.status is TrackingStatus.TRACKING for result in results)
    assert results[-1].reason == ""
    assert method._shown[1]
    assert method._map.count(1) > 100


def check_that_it_goes_on(flight, flown, part, count):
    """Measured in metres and without a jump, while a camera is away and when it is back."""
    frames, poses = flight
    method, before = flown
    parted = [*map(part, frames[START : START + count]), *frames[START + count :]]
    results = fly(copied(method), parted)
    assert all(result.scale_converged for result in results)
    assert all(result.status is TrackingStatus.TRACKING for result in results)
    found = np.array([result.T_world_rig for result in [before[-1], *results]])
    true = poses[START - 1 :]
    steps = [
        np.linalg.norm((inverse(a) @ b)[:3, 3] - (inverse(c) @ d)[:3, 3])
        for a, b, c, d in zip(found, found[1:], true, true[1:], strict=False)
    ]
    assert max(steps) < 0.015
    _, error_m = scale_and_error(found[:, :3, 3], true[:, :3, 3])
    assert error_m < 0.02
    return results


@pytest.mark.parametrize("path", [sliding, lambda count: np.tile(np.eye(4), (count, 1, 1))])
def test_motion_that_tells_no_scale_is_said_to_tell_none(path):
    """Straight ahead, and at rest: it goes on in its own unit and diverges nowhere."""
    poses, room, rng = path(45), Room(4), np.random.default_rng(6)
    results = fly(odometry(), [room.frame(i, T, rng) for i, T in enumerate(poses)])
    assert not any(result.scale_converged for result in results)
    assert all(result.status is TrackingStatus.TRACKING for result in results[1:])
    assert all("scale" in result.reason for result in results[1:])
    assert all("move sideways and turn" in result.reason for result in results[1:])
    found = np.array([result.T_world_rig[:3, 3] for result in results])
    turned = [np.trace(result.T_world_rig[:3, :3]) for result in results]
    assert min(turned) > 1.0 + 2.0 * np.cos(0.03)
    if np.ptp(poses[:, :3, 3]) > 0.0:
        aligned = umeyama(found, poses[:, :3, 3], with_scale=True)
        assert rms_m(aligned, found, poses[:, :3, 3]) < 0.03
    else:
        assert np.linalg.norm(found, axis=1).max() < 0.01


def test_before_the_scale_is_known_the_second_camera_has_no_say():
    """The first one flies as it does alone: keyframes, depths and what is given up."""
    poses, room, rng = sliding(60), Room(4), np.random.default_rng(6)
    frames = [room.frame(i, T, rng) for i, T in enumerate(poses)]
    # One camera alone has a prior after some keyframes, two of them once the scale is known.
    settings = (
        "multispectral.keyframes.parallax_px=2",
        "multispectral.photometric.marginal_weight=0",
    )
    both = fly(odometry(*settings), frames)
    alone = fly(odometry(*settings), [without(frame, THERMAL) for frame in frames])
    assert sum(result.stats.keyframe for result in both) > 9  # more than there is room for
    assert not any(result.scale_converged for result in both)
    for one, other in zip(both, alone, strict=True):
        assert one.stats.keyframe == other.stats.keyframe
        np.testing.assert_allclose(one.T_world_rig, other.T_world_rig, atol=1e-9)


@pytest.mark.parametrize("role", [VISIBLE, THERMAL])
def test_one_camera_alone_makes_a_map_without_unit(flight, role):
    frames, poses = flight
    alone = [without(frame, THERMAL if role == VISIBLE else VISIBLE) for frame in frames[:60]]
    results = fly(odometry(), alone)
    assert not any(result.scale_converged for result in results)
    assert f"the {role} camera alone does not tell them" in results[-1].reason
    T_rig_camera = frames[0].views[role].T_rig_camera
    found = np.array([result.T_world_rig[:3, 3] for result in results])
    true = (poses[:60] @ T_rig_camera)[:, :3, 3]
    aligned = umeyama(found, true, with_scale=True)
    assert rms_m(aligned, found, true) < 0.02
    # In a unit of about the distance of what it looks at.
    assert 1.5 < aligned.scale < 8.0


def test_points_bear_what_both_cameras_show(flown):
    method, _ = flown
    cloud = method.local_map()
    assert len(cloud.xyz) > 150
    both = np.isfinite(cloud.intensity) & np.isfinite(cloud.thermal_counts)
    assert both.mean() > 0.5
    assert 50.0 < np.nanmedian(cloud.intensity) < 200.0
    assert 6000.0 < np.nanmedian(cloud.thermal_counts) < 8000.0
    # On the walls of the room, as the rig was when it began.
    inside = np.abs(cloud.xyz) / np.array([2.5, 1.8, 3.0])
    assert np.median(np.abs(inside.max(axis=1) - 1.0)) < 0.06


def test_threads_change_nothing(flight):
    frames, _ = flight
    one, two = (fly(odometry(f"threads={n}"), frames[:30]) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.T_world_rig, b.T_world_rig)
        assert a.stats == b.stats


def test_a_map_shows_what_was_measured_and_nothing_that_was_guessed(flown):
    method = copied(flown[0])
    tracked = method._tracked
    assert len(method.local_map().xyz) > 0.5 * tracked.count
    sigma, rhos = method._map.window.sigma, tracked.points.rhos
    guessed = replace(tracked.points, rho_information=(sigma / (0.5 * rhos)) ** 2)
    method._tracked = replace(tracked, points=guessed)
    assert len(method.local_map().xyz) == 0


def test_what_covariances_are_multiplied_by_moves_no_pose(flight, flown, results):
    method = copied(flown[0])
    method._config = method._map._config = replace(method._config, covariance_scale=80.0)
    after = fly(method, flight[0][START:])
    for one, other in zip(after, results[START:], strict=True):
        # What is predicted hangs on them, and is where the search begins.
        np.testing.assert_allclose(one.T_world_rig, other.T_world_rig, atol=1e-7)
        assert one.stats.scale_sigma == pytest.approx(other.stats.scale_sigma, rel=1e-4)
    assert np.all(np.diag(after[-1].covariance) > np.diag(results[-1].covariance))


def test_the_frame_after_a_keyframe_does_not_wait_for_its_adjustment(flight, flown):
    method, ready = copied(flown[0]), []
    keyframes = []
    for frame in flight[0][START:]:
        keyframes.append(method.process(frame).stats.keyframe)
        ready.append(method._update is None)
    for i in range(2, len(ready)):
        if keyframes[i - 1] and not keyframes[i]:
            assert not ready[i]
        if not keyframes[i] and not keyframes[i - 1]:
            assert ready[i]
    assert sum(keyframes[1:-1]) > 2


class Failing(InlineExecutor):
    """Its first job fails."""

    failed = False

    def submit(self, job, /, *args, **kwargs):
        if self.failed:
            return super().submit(job, *args, **kwargs)
        self.failed = True
        return super().submit(np.linalg.cholesky, -np.eye(2))


def test_an_adjustment_that_fails_is_told_once_and_the_next_one_counts(flight, flown):
    frames, poses = flight
    method = copied(flown[0])
    method._update, method._worker = None, Failing()
    results = fly(method, frames[START:])
    told = [result.reason for result in results if result.reason]
    assert len(told) == 1
    assert "adjustment of the keyframes failed: LinAlgError: " in told[0]
    assert sum("bundle" in result.stats.stage_ms for result in results) >= 2
    found = np.array([result.T_world_rig[:3, 3] for result in results])
    assert scale_and_error(found, poses[START:, :3, 3])[1] < 0.02


def test_an_adjustment_that_fails_does_not_hold_up_a_reset(flight, flown):
    method = copied(flown[0])
    method._update = Failing().submit(max, 1)
    method.reset(np.eye(4))
    assert method.process(flight[0][START]).reason == "first frame"


def contradicted(method):
    """Windows agree that the size is wrong by 40 %."""
    for _ in range(8):
        method._map._search.note(np.log(1.4))
    method._map._watch(SimpleNamespace(log_scale=np.log(1.4), log_scale_sigma=0.01))
    return method


def test_a_size_that_was_wrong_is_looked_for_again_and_said_to_be(flight, flown):
    method = copied(flown[0])
    assert method._map.doubt is None
    results = fly(contradicted(method), flight[0][START:])
    wrong = [result for result in results if not result.scale_converged]
    assert len(wrong) > 3
    for result in wrong:
        assert result.status is TrackingStatus.DEGRADED
        assert "looked for again: move sideways" in result.reason
        assert np.diag(result.covariance)[:3].min() > 1e5


def test_first_depths_count_as_a_few_only_where_the_size_is_known(flight, flown):
    young, method = odometry(), copied(flown[0])
    fly(young, flight[0][:12])
    assert young._map.window.problem()[0].guesses is None
    assert method._map.window.problem()[0].guesses is not None
    assert contradicted(method)._map.window.problem()[0].guesses is None


def test_a_size_that_is_found_again_stretches_only_what_was_flown_without(flown):
    method = copied(flown[0])
    window = method._map.window
    window.drop_keyframe(window.poses.order[0])
    contradicted(method)

    def places_m():
        return np.array([inverse(window.poses.T_k_w[i])[:3, 3] for i in window.poses.order])

    before_m = places_m()
    assert np.linalg.norm(before_m[0]) > 0.01
    window.rescale(1.4, method._map._known_to_m)
    np.testing.assert_allclose(places_m()[0], before_m[0], atol=1e-9)
    np.testing.assert_allclose(np.diff(places_m(), axis=0), 1.4 * np.diff(before_m, axis=0))


def test_what_came_into_view_and_is_of_unknown_size_is_said_to_be(flight, flown):
    method = copied(flown[0])
    # No adjustment has looked at it yet.
    method._update = None
    method._map.scale_sigma = 0.3
    result = method.process(flight[0][START])
    assert result.status is TrackingStatus.DEGRADED
    assert "is known to 30 % only" in result.reason
    assert result.scale_converged is True


def test_a_window_that_says_little_of_its_poses_hands_little_on(flight, flown):
    sure, unsure = copied(flown[0]), copied(flown[0])
    sure._update = unsure._update = None
    solved = unsure._map._solved
    unsure._map._solved = replace(solved, covariance=1e4 * solved.covariance)
    for method in (sure, unsure):
        next(r for r in map(method.process, flight[0][START:]) if r.stats.keyframe)
    assert sure._map.scale_sigma < 0.05
    assert unsure._map.scale_sigma > 2.0 * sure._map.scale_sigma
