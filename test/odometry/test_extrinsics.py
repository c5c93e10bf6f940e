"""The turn of the right eye that calibration left: watched, shrunk, and never made up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import adjust_bundle
from thermal_stereo_vo.odometry.feature_based.extrinsics import (
    LEAST_ROWS,
    ExtrinsicsConfig,
    ExtrinsicsRefiner,
    turn_in_rows,
)
from thermal_stereo_vo.odometry.feature_based.image_pyramid import build_pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

from .stereo_problems import CAMERA, seen_points
from .window_problems import NO_TURN, bearings_of, mean_nees_band, path, seen_by

SHAPE = (512, 640)
KEYFRAMES = 4
POINTS = 80
PICTURE = build_pyramid(np.zeros(SHAPE, np.float32), 0.0)
TRUE_TURN = np.array([0.5e-3, -0.7e-3, 0.9e-3])


def make_window(rng, turn, assumed=NO_TURN, sigma_px=0.1):
    """Keyframes that all see the same points with a truly turned right eye; bundle adjusted."""
    window, T = KeyframeWindow(KEYFRAMES, 2 * POINTS, SHAPE, CAMERA), path(rng, KEYFRAMES)
    window.right_turn_rad = np.array(assumed)
    in_first = seen_points(rng, POINTS, (3.0, 40.0))
    pixels = np.rint(seen_by(T[0], in_first)[:, :2])
    points_w = bearings_of(pixels) * in_first[:, 2:]
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), PICTURE)
    seen = seen_by(T[0], points_w, turn) + rng.normal(0, sigma_px, (POINTS, 4))
    window.add_points(pixels.astype(int), seen[:, 2], np.zeros(POINTS))
    for k in range(1, KEYFRAMES):
        points = window.points()
        observed = seen_by(T[k], points_w, turn) + rng.normal(0, sigma_px, (POINTS, 4))
        pose = PoseEstimate(inverse(T[k]), np.zeros((6, 6)))
        window.add_keyframe(pose, np.eye(6), PICTURE, points, observed)
    problem, index = window.bundle_problem(0.0)
    solution = adjust_bundle(problem, sigma_floor_px=0.05, iterations=12)
    window.apply(solution, index, 8.0)
    return window, solution


def refined(rounds, turn, config, seed=0, **options):
    """The refiner after some windows, each adjusted with the turn found until then."""
    refiner = ExtrinsicsRefiner(config, KEYFRAMES)
    for k in range(rounds):
        window, solution = make_window(
            np.random.default_rng(seed + k), turn, refiner.turn_rad, **options
        )
        refiner.learn(window, solution)
    return refiner


def config(sigma_mrad=0.1, images_sigma_mrad=0.1, refine=True):
    return ExtrinsicsConfig(refine, sigma_mrad, images_sigma_mrad)


# ----------------------------------------------------------------------------------- pitch and roll


@pytest.mark.parametrize("turn", [TRUE_TURN, -TRUE_TURN, np.array([0.0, 5e-3, 0.0])])
def test_rows_tell_pitch_and_roll(rng, turn):
    """Even beside a yaw that is known already; the yaw itself hardly enters."""
    points = seen_points(rng, 300)
    observed = seen_by(np.eye(4), points, turn)
    window = KeyframeWindow(2, 10, SHAPE, CAMERA)
    window.right_turn_rad = turn * [0.0, 1.0, 0.0]
    found, information = turn_in_rows(window, observed)
    np.testing.assert_allclose(found, turn[[0, 2]], atol=2e-5)  # second order
    assert (information > 0.0).all()
    window.right_turn_rad = turn
    np.testing.assert_allclose(turn_in_rows(window, observed)[0], 0.0, atol=2e-5)


def test_their_information_is_that_of_the_errors():
    squares, runs = [], 60
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        observed = seen_by(np.eye(4), seen_points(rng, 200), NO_TURN)
        observed += rng.normal(0, [0, 0, 0, 0.3], observed.shape)
        found, information = turn_in_rows(KeyframeWindow(2, 10, SHAPE, CAMERA), observed)
        squares.append(np.sum(found**2 * information))
    low, high = mean_nees_band(2, runs)
    assert 0.8 * low < np.mean(squares) < 1.2 * high


def test_wrong_rows_are_left_out(rng):
    observed = seen_by(np.eye(4), seen_points(rng, 200), TRUE_TURN)
    observed += rng.normal(0, 0.1, observed.shape)
    observed[::5, 3] += rng.uniform(5, 30, 40)
    found, _ = turn_in_rows(KeyframeWindow(2, 10, SHAPE, CAMERA), observed)
    np.testing.assert_allclose(found, TRUE_TURN[[0, 2]], atol=0.15e-3)


def test_few_rows_say_nothing(rng):
    observed = seen_by(np.eye(4), seen_points(rng, 200), TRUE_TURN)
    window = KeyframeWindow(2, 10, SHAPE, CAMERA)
    observed[LEAST_ROWS - 1 :, 1] = np.nan
    for nothing in (observed, np.zeros((0, 4)), np.tile(observed[:1], (50, 1))):
        found, information = turn_in_rows(window, nothing)
        np.testing.assert_array_equal(found, 0.0)
        np.testing.assert_array_equal(information, 0.0)


# -------------------------------------------------------------------------------------- the refiner


def test_it_begins_with_the_calibration():
    refiner = ExtrinsicsRefiner(config(), KEYFRAMES)
    assert refiner.turn_mrad == (0.0, 0.0, 0.0)


def test_trusted_images_find_the_turn():
    """A calibration that may be off by far, images that are good: nearly all of it is found."""
    refiner = refined(12, TRUE_TURN, config(2.0, 0.02))
    np.testing.assert_allclose(refiner.turn_rad, TRUE_TURN, atol=0.06e-3)
    assert np.abs(refiner.turn_rad - TRUE_TURN).max() > 1e-7
    np.testing.assert_allclose(refiner.turn_mrad, 1e3 * refiner.turn_rad)


def test_each_angle_is_shrunk_between_calibration_and_images():
    """However many images say so: theirs is half the weight when both are equally sure."""
    halfway = refined(25, TRUE_TURN, config(0.2, 0.2)).turn_rad / TRUE_TURN
    np.testing.assert_allclose(halfway, 0.5, atol=0.06)
    little = refined(25, TRUE_TURN, config(0.1, 0.3)).turn_rad / TRUE_TURN
    np.testing.assert_allclose(little, 0.1, atol=0.03)


def test_a_first_window_counts_less_than_many():
    first, later = (refined(n, TRUE_TURN, config(0.2, 0.02)).turn_rad[1] for n in (1, 12))
    assert 0.0 < first / later < 0.98
    assert later / TRUE_TURN[1] == pytest.approx(1.0, abs=0.1)


def test_a_turn_that_changes_is_followed():
    """What was learnt before a knock fades."""
    refiner = refined(15, TRUE_TURN, config(1.0, 0.3))
    before = refiner.turn_rad
    for k in range(60):
        window, solution = make_window(np.random.default_rng(k), -TRUE_TURN, refiner.turn_rad)
        refiner.learn(window, solution)
    assert np.all(before / TRUE_TURN > 0.7)
    assert np.all(refiner.turn_rad / TRUE_TURN < -0.2)


def test_without_a_turn_hardly_any_is_found():
    turn_rad = refined(12, NO_TURN, config(2.0, 0.02)).turn_rad
    assert 0.0 < np.abs(turn_rad).max() < 0.06e-3


def test_off_means_off():
    refiner = refined(3, TRUE_TURN, config(2.0, 0.02, refine=False))
    np.testing.assert_array_equal(refiner.turn_rad, 0.0)


def test_nothing_is_learnt_from_nothing(rng):
    """No evidence of one angle, or of none; no number is no evidence either."""
    window, solution = make_window(rng, TRUE_TURN)
    refiner = ExtrinsicsRefiner(config(), KEYFRAMES)
    bad = replace(solution, turn_score=np.full(3, np.nan))
    refiner.learn(window, bad)
    refiner.learn(window, replace(solution, turn_information=np.full((3, 3), np.nan)))
    refiner.learn(window, replace(solution, turn_information=np.diag([1.0, np.inf, 1.0])))
    np.testing.assert_array_equal(refiner.turn_rad, 0.0)
    silent = replace(solution, turn_information=np.zeros((3, 3)), turn_score=np.zeros(3))
    refiner.learn(window, silent)
    assert refiner.turn_rad[1] == 0.0
    assert (refiner.turn_rad[[0, 2]] != 0.0).all()  # rows spoke
    negative = replace(solution, turn_information=-np.eye(3), turn_score=np.ones(3))
    before = refiner.turn_rad[1]
    refiner.learn(window, negative)
    assert refiner.turn_rad[1] == before
