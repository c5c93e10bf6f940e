import numpy as np
import pytest

from thermal_stereo_vo.calibration.mask_model import (
    flattened,
    hole_sides,
    prior_sigma,
    seen_corners,
)
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.calibration.views import BoardView
from thermal_stereo_vo.core.transforms import inverse, transform_points

MASK = parse_target("mask:5x3:0.04")


def test_thin_mask_is_seen_as_it_is():
    seen, _ = seen_corners(MASK.points_m, hole_sides(MASK), np.zeros(4), np.array([0.3, 0.1, -0.8]))
    np.testing.assert_array_equal(seen, MASK.points_m)


def test_walls_narrow_holes_from_the_far_side_only():
    """A camera to the right of everything sees the left walls, and right edges as they are."""
    sides = hole_sides(MASK)
    seen, _ = seen_corners(
        MASK.points_m, sides, np.array([0.0, 0.004, 0.0, 0.0]), np.array([2.0, 0.1, -1.0])
    )
    shift = seen[:, 0] - MASK.points_m[:, 0]
    assert (shift[sides[:, 0] < 0] > 0.003).all()
    np.testing.assert_array_equal(shift[sides[:, 0] > 0], 0.0)


def test_widening_moves_opposite_sides_apart():
    seen, _ = seen_corners(
        MASK.points_m,
        hole_sides(MASK),
        np.array([0.002, 0.0, 0.0, 0.0]),
        np.array([0.1, 0.1, -1.0]),
    )
    assert seen[1, 0] - seen[0, 0] == pytest.approx(0.042)
    assert seen[2, 0] - seen[1, 0] == pytest.approx(0.038)


def test_a_wall_that_shows_pulls_at_the_other_side():
    """By its share of the seen wall, outwards; corners without any wall stay where they are."""
    sides, camera = hole_sides(MASK), np.array([2.0, -2.0, -1.0])
    plain, _ = seen_corners(MASK.points_m, sides, np.array([0.0, 0.004, 0.0, 0.0]), camera)
    pulled, _ = seen_corners(MASK.points_m, sides, np.array([0.0, 0.004, 0.1, 0.0]), camera)
    wall_x, wall_y = sides[:, 0] < 0, sides[:, 1] > 0
    shift = (pulled - plain)[:, :2] * sides
    only_x = wall_x & ~wall_y
    seen_wall = np.abs(plain - MASK.points_m)[only_x, 0]
    np.testing.assert_allclose(shift[only_x, 1], 0.1 * seen_wall)
    assert (np.abs(shift[only_x, 0]) < 1e-12).all()
    assert (np.abs(shift[wall_x == wall_y]) < 1e-12).all()
    both, _ = seen_corners(MASK.points_m, sides, np.array([0.0, 0.004, 0.0, 0.1]), camera)
    shift = (both - plain)[:, :2] * sides
    assert (shift[wall_x & wall_y] > 0.0002).all()
    assert (np.abs(shift[~(wall_x & wall_y)]) < 1e-12).all()


def test_derivatives(rng):
    board, camera = np.array([0.001, 0.004, 0.03, -0.02]), np.array([0.25, -0.1, -0.9])
    sides = hole_sides(MASK)
    _, derivative = seen_corners(MASK.points_m, sides, board, camera)
    for k, step in enumerate(1e-7 * np.eye(4)):
        numeric = (
            seen_corners(MASK.points_m, sides, board + step, camera)[0]
            - seen_corners(MASK.points_m, sides, board - step, camera)[0]
        ) / 2e-7
        np.testing.assert_allclose(derivative[:, :, k], numeric, atol=1e-6)


def test_flattening_undoes_the_thickness(stage, hold):
    board = np.array([0.0006, 0.004, -0.03, 0.03])
    T = hold(MASK, (25.0, -20.0, 10.0), (0.05, 0.0), 0.62)
    seen, _ = seen_corners(MASK.points_m, hole_sides(MASK), board, inverse(T)[:3, 3])
    pixels = stage.camera.project(transform_points(T, seen))
    view = BoardView(np.arange(MASK.count), pixels, np.full(MASK.count, 0.05))
    flat = flattened(view, stage.camera, MASK, board)
    assert np.abs(pixels - stage.pixels(MASK, T)).max() > 0.3
    assert np.abs(flat.pixels - stage.pixels(MASK, T)).max() < 0.03


def test_other_boards_have_no_holes():
    chessboard = parse_target("chessboard:5x4:0.04")
    assert hole_sides(chessboard) is None
    assert len(prior_sigma(chessboard)) == 0
