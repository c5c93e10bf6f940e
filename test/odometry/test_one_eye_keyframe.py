"""Keyframes of one eye: geometry of that eye, guessed depths, and what becomes of the guesses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import adjust_bundle
from thermal_stereo_vo.odometry.feature_based.image_pyramid import build_pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import NO_GUESS, KeyframeWindow
from thermal_stereo_vo.odometry.feature_based.one_eye_keyframe import (
    guess_inverse_depths,
    right_eye_pose,
    seen_by_one_eye,
)
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

from .stereo_problems import CAMERA

EYES = replace(CAMERA, cx_right=CAMERA.cx)
TURN = np.array([2e-3, -3e-3, 1e-3])
SHAPE = (40, 48)
PICTURE = build_pyramid(np.zeros(SHAPE, np.float32), 0.0)


def make(turn=TURN) -> KeyframeWindow:
    window = KeyframeWindow(3, 200, SHAPE, EYES)
    window.right_turn_rad = turn
    return window


def scene(rng, n=60):
    """Pixels of a left eye at the origin and their inverse depths, 3 to 20 m away."""
    return rng.integers([30, 30], [600, 480], (n, 2)), 1.0 / rng.uniform(3.0, 20.0, n)


def test_the_right_eye_is_a_left_eye_elsewhere(rng):
    """Where a frame's right eye sees points is where a left eye at its place would."""
    window = make()
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), PICTURE)
    pixels, rhos = scene(rng)
    right_x = pixels[:, 0] - EYES.fx * EYES.baseline_m * rhos
    window.add_points(pixels, right_x, np.zeros(len(pixels)))
    T = exp_se3([0.2, -0.1, 0.3, 0.02, -0.05, 0.01])
    points = window.points()
    by_pair, _ = window.predict(points, T, 1.0)
    alone, _ = window.predict(points, right_eye_pose(window) @ T, 1.0)
    np.testing.assert_allclose(alone[:, :2], by_pair[:, 2:], atol=0.02)  # the turn is first order
    assert np.abs(by_pair[:, 0] - by_pair[:, 2]).min() > 2.0


def test_observations_of_either_eye_become_those_of_a_left_one():
    nan = np.nan
    observed = np.array([[1.0, 2, nan, nan], [nan, nan, 3, 4], [nan, nan, nan, nan]])
    np.testing.assert_array_equal(
        seen_by_one_eye(observed), [[1, 2, nan, nan], [3, 4, nan, nan], [nan] * 4]
    )


def test_depths_are_guessed_from_neighbours(rng):
    """Two walls side by side; an outlier among the neighbours does no harm."""
    known_px = rng.uniform([0, 0], [640, 512], (400, 2))
    known = np.where(known_px[:, 0] < 320, 0.1, 0.3)
    known[::11] = 5.0
    pixels = np.array([[100, 200], [540, 300]])
    guessed, sigmas = guess_inverse_depths(known_px, known, pixels)
    np.testing.assert_allclose(guessed, [0.1, 0.3])
    np.testing.assert_allclose(sigmas, [0.03, 0.09])
    # Where neighbours disagree, little is known; a single one is all there is.
    mixed = rng.uniform(0.02, 0.6, 400)
    guessed, sigmas = guess_inverse_depths(known_px, mixed, rng.integers(0, 500, (50, 2)))
    assert np.mean(sigmas / guessed) > 0.5
    guessed, _ = guess_inverse_depths(known_px[:1], known[:1], pixels)
    np.testing.assert_array_equal(guessed, known[[0, 0]])
    empty, _ = guess_inverse_depths(known_px, known, np.zeros((0, 2), np.int64))
    assert len(empty) == 0


def test_a_guess_gives_way_to_what_is_seen(rng):
    """Points guessed 30 % too near, then seen by a pair 0.3 m aside: the depths come right."""
    window = make(np.zeros(3))
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), PICTURE)
    pixels, rhos = scene(rng)
    guess = 1.3 * rhos
    window.add_guessed_points(pixels, guess, 0.3 * guess, np.zeros(len(pixels)), eye=1)
    points = window.points()
    np.testing.assert_allclose(points.rhos, guess)
    assert np.all(points.guesser == 1)
    # Worth what was said: sigma_px / sqrt(information) = 30 %.
    np.testing.assert_allclose(0.4 / np.sqrt(points.rho_information), 0.3 * guess, rtol=1e-9)
    T = exp_se3([-0.3, 0.02, 0.05, 0.0, 0.01, 0.0])
    truth = replace(points, rhos=rhos)
    observed, _ = window.predict(truth, T, 1.0)
    observed += 0.05 * rng.standard_normal(observed.shape)
    window.add_keyframe(PoseEstimate.start(inverse(T)), 1e-6 * np.eye(6), PICTURE, points, observed)
    problem, index = window.bundle_problem(0.5)
    solution = adjust_bundle(problem, sigma_floor_px=0.1, iterations=20)
    np.testing.assert_allclose(solution.rhos, rhos, rtol=0.05)
    window.apply(solution, index, 4.0)
    after = window.points()
    assert len(after) == len(points)  # a wrong guess is no reason to drop a point
    assert np.all(after.guesser == NO_GUESS)
    np.testing.assert_allclose(inverse(window.newest_pose().T_world_rig), T, atol=5e-3)


def test_a_slot_that_held_a_guess_forgets_it(rng):
    window = make()
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), PICTURE)
    pixels, rhos = scene(rng)
    window.add_guessed_points(pixels, rhos, 0.3 * rhos, np.zeros(len(pixels)), eye=0)
    window.clear()
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), PICTURE)
    window.add_points(pixels, pixels[:, 0] - 20.0, np.zeros(len(pixels)))
    assert np.all(window.points().guesser == NO_GUESS)
    problem, _ = window.bundle_problem(0.0)
    np.testing.assert_array_equal(problem.weights, 1.0)
