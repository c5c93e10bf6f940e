"""The windowed method as a whole: keyframes, gaps, the map, and a yaw that is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import GapReason
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, make_transform
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry

INITIALISING, TRACKING, DEGRADED, GAP, LOST = TrackingStatus
PERIOD_NS = 100_000_000
FAST = (0.05, 0.0, 0.2, 0.0, 0.01, 0.0)


@pytest.fixture(scope="module")
def flight(room):
    """Sixteen frames, 3.2 m; a keyframe comes every few."""
    rng = np.random.default_rng(11)
    poses = room.path(16, FAST)
    return poses, [room.rig_frame(k * PERIOD_NS, T, rng) for k, T in enumerate(poses)]


def create(*settings):
    return create_odometry(with_overrides(OdometryConfig(), ["window=5", *settings]))


def fly(frames, *settings):
    odometry = create(*settings)
    return odometry, [odometry.process(frame) for frame in frames]


def error_m(result, T_true):
    return float(np.linalg.norm(result.T_world_rig[:3, 3] - T_true[:3, 3]))


def keyframes(results):
    return [k for k, result in enumerate(results) if result.stats.keyframe]


def blind(frame):
    return replace(frame, views={}, blind=dict.fromkeys(("left", "right"), GapReason.FFC))


# ---------------------------------------------------------------------------------------- keyframes


def test_where_nothing_moves_nothing_drifts(room):
    """Noise of its own in each frame; however long it hovers, the keyframe stays the first."""
    rng = np.random.default_rng(2)
    frames = [room.rig_frame(k * PERIOD_NS, np.eye(4), rng) for k in range(12)]
    _, results = fly(frames)
    assert keyframes(results) == [0]
    off = np.array([error_m(result, np.eye(4)) for result in results[1:]])
    assert 1e-6 < off.max() < 0.004
    assert off[-4:].mean() < 3.0 * off[:4].mean()  # of the same size at the end as before
    sigmas = [np.sqrt(np.trace(result.covariance[:3, :3])) for result in results[1:]]
    assert max(sigmas) < 1.5 * min(sigmas)
    # The claim has a floor of a tenth of a pixel, which this picture is better than.
    assert 0.02 < np.sqrt(np.mean(off**2)) / np.mean(sigmas) < 3.0


def test_keyframes_come_with_parallax(flight):
    poses, frames = flight
    _, rarely = fly(frames, "windowed.keyframes.parallax_px=30")
    _, often = fly(frames, "windowed.keyframes.parallax_px=4")
    assert 1 < len(keyframes(rarely)) < len(keyframes(often)) < len(frames)
    for results in (rarely, often):
        assert all(result.status is TRACKING for result in results[1:])
        assert 1e-4 < error_m(results[-1], poses[-1]) < 0.06


def test_the_covariance_grows_with_keyframes_and_covers_the_error(flight):
    poses, frames = flight
    _, results = fly(frames)
    sigmas = [np.sqrt(np.trace(result.covariance[:3, :3])) for result in results]
    assert sigmas[0] == 0.0
    assert 0.001 < sigmas[-1] < 0.1
    assert sigmas[-1] > sigmas[1]
    assert 0.05 < error_m(results[-1], poses[-1]) / sigmas[-1] < 5.0


@pytest.mark.parametrize(
    ("settings", "scale_sigma"),
    [
        ((), 0.03),
        (("windowed.extrinsics.scale_share=1",), 0.2),
        (("windowed.extrinsics.refine=false",), 0.2),
    ],
    ids=("yaw refined", "all is left", "yaw not refined"),
)
def test_less_of_the_scale_is_unsure_where_the_yaw_is_refined(flight, settings, scale_sigma):
    """Against the same flight with a scale that is certain: the way so far times the rest."""
    _, frames = flight
    certain = [s for s in settings if "share" not in s] + ["status.scale_sigma=0"]
    _, sure = fly(frames, *certain)
    _, unsure = fly(frames, *settings, "status.scale_sigma=0.2")
    way_m = unsure[-1].T_world_rig[:3, 3] - unsure[0].T_world_rig[:3, 3]
    more = unsure[-1].covariance - sure[-1].covariance
    np.testing.assert_allclose(more[:3, :3], scale_sigma**2 * np.outer(way_m, way_m), atol=1e-6)
    np.testing.assert_allclose(more[3:], 0.0, atol=1e-9)


def test_the_factor_on_covariances_reaches_those_of_adjusted_keyframes(flight):
    _, frames = flight
    certain = ("status.scale_sigma=0", "status.bolometer_lag_sigma_ms=0")
    _, once = fly(frames, *certain)
    _, twice = fly(frames, *certain, "windowed.covariance_scale=4")
    assert len(keyframes(once)) >= 3
    # Not to the last digit: what a keyframe leaves behind is kept positive.
    wanted = 4.0 * once[-1].covariance
    np.testing.assert_allclose(twice[-1].covariance, wanted, rtol=0.05, atol=1e-9)


def test_turning_on_the_spot_makes_keyframes_but_no_way(room):
    rng = np.random.default_rng(3)
    poses = room.path(10, (0.0, 0.0, 0.0, 0.0, 0.05, 0.0))
    _, results = fly([room.rig_frame(k * PERIOD_NS, T, rng) for k, T in enumerate(poses)])
    assert len(keyframes(results)) >= 2
    assert 1e-6 < error_m(results[-1], np.eye(4)) < 0.02


# --------------------------------------------------------------------------------- gaps and the map


def test_a_gap_is_coasted_and_measured_away(flight):
    poses, frames = flight
    gone = range(6, 9)
    _, results = fly([blind(f) if k in gone else f for k, f in enumerate(frames)])
    for k, result in enumerate(results[1:], 1):
        assert result.status is (GAP if k in gone else TRACKING)
    assert error_m(results[8], poses[8]) < 0.2  # by the last twist
    assert error_m(results[9], poses[9]) < 0.05  # against the keyframes before the gap
    assert error_m(results[-1], poses[-1]) < 0.06
    trace = [np.trace(result.covariance[:3, :3]) for result in results]
    assert trace[8] > 10.0 * trace[5]
    assert trace[9] < 0.1 * trace[8]


def test_lost_and_found_again_is_a_reset_from_where_it_was_lost(flight):
    poses, frames = flight
    late = [replace(f, stamp_ns=f.stamp_ns + 3 * 10**9) for f in frames]
    elsewhere = [blind(late[6]), *late[7:12]]
    _, results = fly([*frames[:6], *elsewhere])
    assert [r.status for r in results[:7]] == [INITIALISING, *[TRACKING] * 5, LOST]
    assert results[6].T_world_rig is None
    assert results[-1].status is TRACKING
    assert results[-1].reset_counter == 1
    moved = np.linalg.inv(results[-2].T_world_rig) @ results[-1].T_world_rig
    np.testing.assert_allclose(moved, np.linalg.inv(poses[10]) @ poses[11], atol=0.02)


def test_the_map_is_what_the_last_frame_saw(flight, room):
    _, frames = flight
    odometry = create()
    assert len(odometry.local_map().xyz) == 0
    for frame in frames[:8]:
        result = odometry.process(frame)
    cloud = odometry.local_map()
    assert len(cloud.xyz) == result.stats.inliers
    to_wall_m = np.minimum(np.abs(cloud.xyz - room.low), np.abs(cloud.xyz - room.high)).min(axis=1)
    assert 1e-4 < np.median(to_wall_m) < 0.1
    odometry.process(blind(frames[8]))
    assert len(odometry.local_map().xyz) == 0
    odometry.reset(np.eye(4))
    assert len(odometry.local_map().xyz) == 0


def test_the_map_holds_when_a_keyframe_makes_room_for_another(flight, room):
    """Points of the keyframe that goes are where they were, not seen from its successor."""
    _, frames = flight
    odometry = create("window=2", "windowed.keyframes.parallax_px=4")
    full = []
    for frame in frames:
        result = odometry.process(frame)
        if result.stats.keyframe:
            full.append(odometry.local_map().xyz)
    assert len(full) > 5
    for xyz in full[3:]:
        to_wall_m = np.minimum(np.abs(xyz - room.low), np.abs(xyz - room.high)).min(axis=1)
        assert 1e-4 < np.percentile(to_wall_m, 80) < 0.12


# ------------------------------------------------------------------------------- work that fails


def fails(odometry, first, last=None, *, has_points=False):
    """Let the work on these keyframes fail (0 is the first one), with new points or before them."""
    complete, asked = odometry._complete, []

    def complete_or_fail(*args):
        asked.append(args)
        is_sound = not first <= len(asked) - 1 <= (last or first)
        completed = complete(*args) if is_sound or has_points else None
        if not is_sound:
            raise np.linalg.LinAlgError("singular matrix")
        return completed

    odometry._complete = complete_or_fail
    return odometry


def failures(results):
    return [k for k, result in enumerate(results) if "LinAlgError: singular" in result.reason]


@pytest.fixture(params=[1, 2], ids=["alone", "with a worker"])
def often(request):
    """Odometry that makes a keyframe every few frames, with and without a worker."""
    return create(f"threads={request.param}", "windowed.keyframes.parallax_px=4")


@pytest.mark.parametrize("has_points", [False, True], ids=["no points", "no adjustment"])
def test_work_that_fails_is_told_once_and_the_next_keyframe_has_another_try(
    flight, often, has_points
):
    poses, frames = flight
    fails(often, 1, has_points=has_points)
    results = [often.process(frame) for frame in frames]
    second = keyframes(results)[1]
    assert failures(results) == [second + 1]
    # A keyframe without points of its own is followed by another at once.
    assert (second + 1 in keyframes(results)) == (not has_points)
    assert len(keyframes(results)) >= 5
    for result, T in zip(results[1:], poses[1:], strict=True):
        assert result.status is TRACKING
        assert error_m(result, T) < 0.03
    assert any(results[-1].stats.right_turn_mrad)  # later ones were adjusted


@pytest.mark.parametrize("has_points", [False, True], ids=["no points", "no adjustment"])
def test_a_keyframe_whose_work_failed_counts_the_points_it_has(flight, often, has_points):
    """The next one is due when too few of those are left."""
    _, frames = flight
    sound = create("windowed.keyframes.parallax_px=4")
    fails(often, 1, has_points=has_points)
    for frame in frames:
        inliers = often.process(frame).stats.inliers
        if sound.process(frame).stats.keyframe and inliers:
            break
    counts = []
    for odometry in (often, sound):
        odometry.process(blind(frames[-1]))
        counts.append(odometry._keyframe_count)
    assert counts[0] == (counts[1] if has_points else inliers)
    assert inliers < counts[1]


def test_a_start_that_fails_is_told_and_tried_again(flight, often):
    poses, frames = flight
    fails(often, 0)
    results = [often.process(frame) for frame in frames[:4]]
    assert results[0].status is INITIALISING
    assert "too few points with a depth to start from; the work on the newest" in results[0].reason
    assert failures(results) == [0]
    assert results[1].reason == "first frame"
    moved = np.linalg.inv(results[1].T_world_rig) @ results[3].T_world_rig
    np.testing.assert_allclose(moved, np.linalg.inv(poses[1]) @ poses[3], atol=0.02)


def test_work_that_fails_for_long_costs_the_window_but_not_the_odometry(flight):
    """Room for three keyframes: nothing is left of the points when it works again."""
    poses, frames = flight
    odometry = fails(create("window=3", "windowed.keyframes.parallax_px=4"), 1, 5)
    results = [odometry.process(frame) for frame in frames]
    assert GAP in {result.status for result in results}
    assert len(failures(results)) >= 4
    assert failures(results)[-1] < 10
    assert results[-1].status is TRACKING
    moved = np.linalg.inv(results[-4].T_world_rig) @ results[-1].T_world_rig
    np.testing.assert_allclose(moved, np.linalg.inv(poses[-4]) @ poses[-1], atol=0.02)


def until_keyframe(odometry, frames):
    """How many frames it takes until the last one has become a keyframe, after the first."""
    made = (odometry.process(frame).stats.keyframe for frame in frames)
    return next(n for n, keyframe in enumerate(made, start=1) if keyframe and n > 1)


def test_a_failure_does_not_hide_why_a_frame_was_not_measured(flight, often):
    poses, frames = flight
    n = until_keyframe(fails(often, 1), frames)
    results = [often.process(blind(frames[n]))]
    assert "ffc" in results[0].reason
    assert "; the work on the newest keyframe failed: LinAlgError: sing" in results[0].reason
    results += [often.process(frame) for frame in frames[n + 1 :]]
    assert failures(results) == [0]
    assert error_m(results[-1], poses[-1]) < 0.03


@pytest.mark.parametrize("threads", [1, 2])
def test_a_last_view_that_cannot_be_kept_is_told_at_once(flight, threads):
    """What one eye goes on with are the keyframes there were."""
    poses, frames = flight
    odometry = fails(create(f"threads={threads}"), 1)
    assert keyframes([odometry.process(frame) for frame in frames[:6]]) == [0]
    one_eyed = [replace(f, views={"left": f.views["left"]}) for f in frames[6:9]]
    results = [odometry.process(frame) for frame in [*one_eyed, *frames[9:]]]
    assert failures(results) == [0]
    for result, T in zip(results, poses[6:], strict=True):
        assert result.status in (TRACKING, DEGRADED)
        assert error_m(result, T) < 0.05


def test_work_that_fails_does_not_hold_up_a_reset(flight, often):
    poses, frames = flight
    n = until_keyframe(fails(often, 1), frames)
    often.reset(poses[n])
    results = [often.process(frame) for frame in frames[n:]]
    assert not failures(results)
    assert results[0].reason == "first frame"
    for result, T in zip(results, poses[n:], strict=True):
        assert error_m(result, T) < 0.03


# ---------------------------------------------------------------------------- turn of the right eye


@pytest.fixture(scope="module")
def crooked(room):
    """The right eye of a rig that calls itself rectified is yawed by 3 mrad, 0.8 px."""
    turn = np.array([0.0, 3e-3, 0.0])
    rng = np.random.default_rng(8)
    poses = room.path(24, (0.1, 0.0, 0.3, 0.0, 0.01, 0.0))
    # The right eye sees a point p at p + turn x p, so that the eye itself turned the other way.
    T_left_right = room.T_left_right @ make_transform(exp_so3(-turn), np.zeros(3))
    frames = []
    for k, T in enumerate(poses):
        frame = room.rig_frame(k * PERIOD_NS, T, rng)
        image = room.render(T @ T_left_right) + rng.normal(0, 1.0, (240, 320))
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        right = replace(frame.views["right"], image=image, display=image)
        frames.append(replace(frame, views={**frame.views, "right": right}))
    return turn, poses, frames


def test_a_wrong_yaw_is_refined_in_flight(crooked):
    """Left alone it changes the scale; found in flight, most of that is gone."""
    turn, poses, frames = crooked
    trusted = (
        "windowed.extrinsics.sigma_mrad=5",
        "windowed.extrinsics.images_sigma_mrad=0.2",
    )
    way_m = np.linalg.norm(poses[-1][:3, 3])
    _, left_alone = fly(frames, "windowed.extrinsics.refine=false")
    _, refined = fly(frames, *trusted)
    assert left_alone[-1].stats.right_turn_mrad == (0.0, 0.0, 0.0)
    found = np.array(refined[-1].stats.right_turn_mrad)
    assert found[1] == pytest.approx(1e3 * turn[1], abs=1.0)
    assert np.abs(found[[0, 2]]).max() < 0.5
    errors = [error_m(results[-1], poses[-1]) / way_m for results in (left_alone, refined)]
    assert 0.03 < errors[0] < 0.3
    assert errors[1] < 0.5 * errors[0]


def test_a_true_calibration_stays(flight):
    _, frames = flight
    _, results = fly(frames)
    assert 0.0 < np.abs(results[-1].stats.right_turn_mrad).max() < 0.3


def test_reset_goes_back_to_the_calibration(crooked):
    _, _, frames = crooked
    odometry, results = fly(frames[:10])
    assert any(results[-1].stats.right_turn_mrad)
    odometry.reset(exp_se3([1.0, 0, 0, 0, 0, 0]))
    again = [odometry.process(frame) for frame in frames[:2]]
    assert again[-1].stats.right_turn_mrad == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(again[0].T_world_rig, exp_se3([1.0, 0, 0, 0, 0, 0]))
