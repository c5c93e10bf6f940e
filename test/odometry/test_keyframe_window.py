"""The book-keeping of keyframes and points: slots, poses with covariances, what is forgotten."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    RHO_MIN,
    adjust_bundle,
)
from thermal_stereo_vo.odometry.feature_based.image_pyramid import build_pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

from .stereo_problems import CAMERA
from .window_problems import NO_TURN, TURN, path, poses_apart, seen_by

SHAPE = (512, 640)
SMALL = (40, 48)
GAIN = CAMERA.fx * CAMERA.baseline_m
PIXELS = np.array([[100, 90], [300, 250], [500, 400], [620, 30], [50, 480]])
DISPARITY = np.array([30.0, 12.0, 8.0, 10.0, 60.0])
RIGHT_X = PIXELS[:, 0] - (CAMERA.cx - CAMERA.cx_right) - DISPARITY


def covariance(rng, size=1e-3):
    root = rng.normal(0, size, (6, 6))
    return root @ root.T


def picture(value=0.0, shape=SMALL):
    return build_pyramid(np.full(shape, value, np.float32), 0.0)


def make(keyframes=3, capacity=50, turn=NO_TURN, shape=SMALL):
    window = KeyframeWindow(keyframes, capacity, shape, CAMERA)
    window.right_turn_rad = np.array(turn)
    return window


def with_points(turn=NO_TURN, shape=SMALL, **options):
    """One keyframe at the origin with five points."""
    window = make(turn=turn, shape=shape, **options)
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), picture(shape=shape))
    window.add_points(PIXELS, RIGHT_X, np.arange(5.0))
    return window


def fly(window, T_k_w, covariances, start=None):
    """Add keyframes by measured steps, as the odometry does; returns the poses it was given."""
    poses = [PoseEstimate.start() if start is None else start]
    window.add_keyframe(poses[0], np.zeros((6, 6)), picture(0.0))
    for k in range(1, len(T_k_w)):
        step = T_k_w[k] @ inverse(T_k_w[k - 1])
        poses.append(poses[-1].moved(step, covariances[k]))
        window.add_keyframe(poses[-1], covariances[k], picture(float(k)))
    return poses


# ---------------------------------------------------------------------------------------- keyframes


def test_slots_are_used_again_and_hold_the_newest_pictures(rng):
    window, T = make(3), path(rng, 6)
    fly(window, T, [covariance(rng) for _ in T])
    assert sorted(window.order) == [0, 1, 2]
    assert window.newest == window.order[-1]
    np.testing.assert_allclose(window.T_keyframe_world[window.order], T[3:], atol=1e-12)
    for slot, value in zip(window.order, (3.0, 4.0, 5.0), strict=True):
        assert all((stack[slot] == value).all() for stack in window.images.stacks)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5))
def test_the_newest_pose_is_the_chain_of_steps_whatever_was_forgotten(seed, room):
    """Independent steps: the window must say of the newest what composing them says."""
    rng = np.random.default_rng(seed)
    window, T = make(room), path(rng, 8, turn_rad=0.3)
    start = PoseEstimate(np.eye(4), covariance(rng))
    poses = fly(window, T, [covariance(rng) for _ in T], start)
    known = window.newest_pose()
    np.testing.assert_allclose(known.T_world_rig, poses[-1].T_world_rig, atol=1e-10)
    np.testing.assert_allclose(
        known.covariance, poses[-1].covariance, atol=1e-6 * np.abs(known.covariance).max()
    )


def test_forgetting_changes_no_pose_and_keeps_covariances_positive(rng):
    """After an adjustment, whose covariances are no chain: as good a difference as there is."""
    window = KeyframeWindow(4, 200, SMALL, CAMERA)
    T = path(rng, 5)
    fly(window, T[:4], [covariance(rng) for _ in range(4)])
    for slot in window.order[1:]:
        window._poses._relative[slot] = covariance(rng)
    before = {slot: window._poses._pose(slot) for slot in window.order[1:]}
    window._forget_oldest()
    assert window.order == list(before)
    for slot, was in before.items():
        now = window._poses._pose(slot)
        np.testing.assert_allclose(now.T_world_rig, was.T_world_rig, atol=1e-12)
        values = np.linalg.eigvalsh(now.covariance)
        assert values[0] > -1e-12 * values[-1]
    heir = window.order[0]
    np.testing.assert_allclose(window._poses._pose(heir).covariance, before[heir].covariance)


def test_points_go_with_their_host(rng):
    window = with_points(keyframes=2)
    second = PoseEstimate(inverse(path(rng, 2)[1]), np.zeros((6, 6)))
    window.add_keyframe(second, np.eye(6), picture())
    window.add_points(PIXELS[:2] + 7, RIGHT_X[:2], np.zeros(2))
    assert len(window.points()) == 7
    first, second = window.order
    third = PoseEstimate(exp_se3([0, 0, 1.0, 0, 0, 0]), np.zeros((6, 6)))
    points = window.points()
    observed = np.column_stack([np.arange(7.0)] * 4)
    pixels = window.add_keyframe(third, np.eye(6), picture(), points, observed)
    assert (window.points().hosts == second).all()
    assert len(window.points()) == 2
    np.testing.assert_array_equal(pixels[:, 0], np.flatnonzero(points.hosts == second))
    assert window.newest == first  # its slot
    seen = window.seen_by_newest()
    np.testing.assert_array_equal(seen[:, 0], pixels[:, 0])


def test_clear_leaves_room_only():
    window = with_points()
    window.clear()
    assert window.order == []
    assert len(window.points()) == 0
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), picture())
    window.add_points(PIXELS, RIGHT_X, np.zeros(5))
    assert len(window.points()) == 5


# ------------------------------------------------------------------------------------------- points


@pytest.mark.parametrize("turn", [NO_TURN, TURN], ids=("straight", "turned"))
def test_a_new_point_is_predicted_where_it_was_seen(turn):
    window = with_points(turn)
    points = window.points()
    predicted, warps = window.predict(points, np.eye(4), 5.0)
    np.testing.assert_allclose(predicted[:, :2], PIXELS, atol=1e-9)
    # The inverse of the turn is of first order: TURN is ten times what calibration leaves.
    off = np.abs(predicted[:, 2] - RIGHT_X)
    assert off.max() < (0.08 if turn.any() else 1e-9)
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (5, 1, 1)), atol=1e-9)
    if turn.any():
        straight = with_points(NO_TURN).points()
        changed = np.abs(points.rhos - straight.rhos) * GAIN
        assert 1.0 < changed.max() < 10.0
    np.testing.assert_array_equal(window.intensities(points), np.arange(5.0))


def test_depths_follow_from_disparities():
    points = with_points().points()
    np.testing.assert_allclose(1.0 / points.rhos, GAIN / DISPARITY)
    np.testing.assert_array_equal(points.rho_information, GAIN**2)
    window = make()
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), picture())
    window.add_points(PIXELS, PIXELS[:, 0] + 20.0, np.zeros(5))
    np.testing.assert_array_equal(window.points().rhos, RHO_MIN)


def test_positions_lie_on_the_rays_of_their_hosts(rng):
    window = with_points()
    T = path(rng, 2, turn_rad=0.3)
    window.add_keyframe(PoseEstimate(inverse(T[1]), np.zeros((6, 6))), np.eye(6), picture())
    window.add_points(PIXELS + 3, RIGHT_X, np.zeros(5))
    points = window.points()
    positions = window.positions_m(points)
    for host, T_k in zip(window.order, T, strict=True):
        mine = points.hosts == host
        seen = seen_by(T_k, positions[mine])
        np.testing.assert_allclose(seen[:, :2], points.host_px[mine], atol=1e-8)
        disparity = seen[:, 0] - CAMERA.cx - (seen[:, 2] - CAMERA.cx_right)
        np.testing.assert_allclose(disparity, GAIN * points.rhos[mine])


def test_more_points_than_room_are_left_out():
    window = make(capacity=3)
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), picture())
    window.add_points(PIXELS, RIGHT_X, np.arange(5.0))
    points = window.points()
    assert len(points) == 3
    np.testing.assert_array_equal(points.host_px, PIXELS[:3])
    chosen = points.take(np.array([2, 0]))
    np.testing.assert_array_equal(chosen.host_px, PIXELS[[2, 0]])
    np.testing.assert_array_equal(chosen.rhos, points.rhos[[2, 0]])


def test_points_that_should_be_seen_but_are_not_are_given_up():
    window = with_points(shape=SHAPE)
    points = window.points()
    good = np.array([True, False, False, True, True])
    for _ in range(3):
        window.note_tracking(points, good, np.eye(4), 3)
    assert len(window.points()) == 5
    window.note_tracking(points, np.array([True, True, False, True, True]), np.eye(4), 3)
    np.testing.assert_array_equal(window.points().index, np.delete(points.index, 2))
    window.note_tracking(window.points(), np.ones(4, bool), np.eye(4), 3)
    for _ in range(3):  # once found, all is forgiven
        window.note_tracking(window.points(), np.zeros(4, bool), np.eye(4), 3)
    assert len(window.points()) == 4
    window.note_tracking(window.points(), np.zeros(4, bool), np.eye(4), 3)
    assert len(window.points()) == 0


def test_points_out_of_sight_are_not_blamed():
    window = with_points(shape=SHAPE)
    T_away = exp_se3([0, 0, 0, 0, np.pi, 0])
    T_aside = exp_se3([0, 0, 0, 0, 0.3, 0])
    predicted, _ = window.predict(window.points(), T_aside, 1.0)
    beyond = predicted[:, 0] > SHAPE[1] - 8
    assert 0 < beyond.sum() < 5
    for _ in range(5):
        window.note_tracking(window.points(), np.zeros(5, bool), T_away, 3)
    assert len(window.points()) == 5
    for _ in range(5):
        window.note_tracking(window.points(), np.zeros(len(window.points()), bool), T_aside, 3)
    assert len(window.points()) == beyond.sum()


def test_parallax_is_of_translation_alone():
    window = with_points()
    points = window.points()
    turned = exp_se3([0, 0, 0, 0.05, -0.1, 0.2])
    assert window.parallax_px(points, turned) == pytest.approx(0.0, abs=1e-9)
    # Half a baseline to the side moves points by half their disparity; the median one has 12 px.
    aside = exp_se3([-0.5 * CAMERA.baseline_m, 0, 0, 0, 0, 0])
    assert window.parallax_px(points, aside) == pytest.approx(6.0)


def test_weights_fall_with_the_angle_from_the_axis():
    window = with_points()
    centre = np.array([[CAMERA.cx, CAMERA.cy]])
    aside = centre + np.array([0.5 * CAMERA.fx, 0.0])

    def weight(host, seen, trust=0.5):
        return window.radial_weights(host, np.column_stack([seen, seen]), trust)[0]

    assert weight(centre, centre) == 1.0
    assert weight(centre, aside) == pytest.approx(0.5)
    assert weight(aside, centre) == pytest.approx(0.5)
    assert weight(aside, aside) == pytest.approx(1.0 / 3.0)
    assert weight(aside, aside, trust=0.0) == 1.0
    blind = np.column_stack([np.full((1, 2), np.nan), aside])
    assert window.radial_weights(centre, blind, 0.5)[0] == pytest.approx(0.5)
    nothing = np.full((1, 4), np.nan)
    assert window.radial_weights(aside, nothing, 0.5)[0] == pytest.approx(0.5)


# --------------------------------------------------------------------------------------- adjustment


def adjusted_window(rng, wrong=()):
    """Four keyframes that see 60 points of the first with 0.1 px; some of the last's wrong."""
    window, T = KeyframeWindow(4, 100, SHAPE, CAMERA), path(rng, 4)
    pixels = rng.integers((60, 60), (580, 450), (60, 2))
    depths = np.exp(rng.uniform(np.log(4), np.log(30), 60))
    right_x = pixels[:, 0] - (CAMERA.cx - CAMERA.cx_right) - GAIN / depths
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), picture(shape=SHAPE))
    window.add_points(pixels, right_x, np.zeros(60))
    positions = window.positions_m(window.points())
    for k in (1, 2, 3):
        points = window.points()
        observed = seen_by(T[k], positions) + rng.normal(0, 0.1, (60, 4))
        if k == 3:
            observed[list(wrong)] += 15.0
        off = exp_se3(rng.normal(0, 0.003, 6)) @ T[k]
        pose = PoseEstimate(inverse(off), np.zeros((6, 6)))
        window.add_keyframe(pose, np.eye(6), picture(shape=SHAPE), points, observed)
    problem, index = window.bundle_problem(0.0)
    return window, T, index, adjust_bundle(problem, sigma_floor_px=0.05, iterations=12)


def test_an_adjustment_is_taken_over(rng):
    window, T, index, solution = adjusted_window(rng)
    window.apply(solution, index, 6.0)
    now = window.T_keyframe_world[window.order]
    np.testing.assert_array_equal(now, solution.T_k_w)
    assert np.abs(poses_apart(now, T)).max() < 0.01
    points = window.points()
    np.testing.assert_array_equal(points.rhos, solution.rhos)
    np.testing.assert_array_equal(points.rho_information, solution.rho_information)
    # The covariance in axes of the keyframe, turned into those of the world by newest_pose.
    pose = window.newest_pose()
    turned = np.kron(np.eye(2), pose.T_world_rig[:3, :3])
    np.testing.assert_allclose(pose.covariance, turned @ solution.covariance[12:, 12:] @ turned.T)
    assert np.isfinite(window.seen_by_newest()[:, :3]).all()


def test_observations_that_do_not_fit_are_forgotten(rng):
    wrong = [3, 17, 40]
    window, T, index, solution = adjusted_window(rng, wrong)
    window.apply(solution, index, 6.0)
    assert np.abs(poses_apart(window.T_keyframe_world[window.order], T)).max() < 0.02
    unseen = np.isnan(window.seen_by_newest()).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(unseen), wrong)
    assert len(window.points()) == 60  # the other keyframes still see them


def test_a_point_contradicted_by_its_own_right_eye_goes(rng):
    window, _, index, _ = adjusted_window(rng)
    window._observed[window.order[0], index[5], 2] += 12.0
    window._observed[window.order[1:], index[5]] = np.nan  # nobody else to speak for it
    window._observed[window.order[0], index[9], 2] += 12.0
    problem, index = window.bundle_problem(0.0)
    solution = adjust_bundle(problem, sigma_floor_px=0.05, iterations=12)
    solution.residuals[0, 5, 2] = 12.0  # alone it would be believed
    window.apply(solution, index, 6.0)
    left = window.points().index
    assert index[5] not in left
    assert index[9] in left  # three others speak for it
    assert len(left) == 59


def test_a_problem_is_a_copy_in_the_order_of_age(rng):
    window, _, _, _ = adjusted_window(rng)
    for k in range(2):  # go round so that slots and ages differ
        pose = PoseEstimate(exp_se3([0, 0, 2.0 + k, 0, 0, 0]), np.zeros((6, 6)))
        window.add_keyframe(pose, np.eye(6), picture(shape=SHAPE))
    window.add_points(PIXELS, RIGHT_X, np.zeros(5))
    assert window.order != sorted(window.order)
    problem, index = window.bundle_problem(0.5)
    np.testing.assert_array_equal(problem.T_k_w, window.T_keyframe_world[window.order])
    assert set(problem.hosts) == {3}
    assert len(index) == 5
    seen = problem.observed[problem.hosts, np.arange(5)]
    np.testing.assert_array_equal(seen[:, :2], PIXELS)
    problem.T_k_w[:] = problem.observed[:] = 0.0
    assert np.isfinite(log_se3(window.T_keyframe_world[window.newest])).all()
    assert window.seen_by_newest()[:, 0].min() > 0.0
