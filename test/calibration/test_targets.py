import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.calibration.targets import Target, TargetKind, parse_target
from thermal_stereo_vo.core.errors import CalibrationError


def test_points_run_row_by_row():
    target = parse_target("chessboard:9x6:0.04")
    assert target.points_m.shape == (54, 3)
    np.testing.assert_allclose(target.points_m[1] - target.points_m[0], [0.04, 0, 0])
    np.testing.assert_allclose(target.points_m[9] - target.points_m[0], [0, 0.04, 0])


def test_mask_has_four_corners_a_hole():
    target = parse_target("mask:6x4:0.04:0.09")
    x = target.points_m[:12, 0]
    np.testing.assert_allclose(np.diff(x), [0.04, 0.05] * 5 + [0.04])
    assert target.count == 96
    assert parse_target("mask:6x4:0.04").pitch_m == 0.08


@pytest.mark.parametrize("text", ["chessboard:7x5:0.03", "mask:5x3:0.04", "mask:5x3:0.04:0.1"])
def test_surface_changes_at_every_point(text):
    """The pattern that a simulator draws has its corners where the detectors look for them."""
    target = parse_target(text)
    step = 0.2 * target.spacing_m
    around = target.points_m[:, None, :2] + step * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    marked = target.marked(around)
    if target.kind is TargetKind.CHESSBOARD:
        assert (marked[:, 0] == marked[:, 2]).all()
        assert (marked[:, 1] == marked[:, 3]).all()
        assert (marked[:, 0] != marked[:, 1]).all()
    else:
        assert (marked.sum(1) == 1).all()


def test_only_one_mark_beside_the_first_hole():
    target = parse_target("mask:6x4:0.04")
    grid = np.stack(np.meshgrid(np.arange(-0.06, 0.5, 0.001), np.arange(-0.06, 0.34, 0.001)), -1)
    outside = (grid < -0.004).all(-1)
    assert target.marked(grid)[outside].sum() > 100
    for far_corner in (grid[..., 0] > 0.445, grid[..., 1] > 0.285):
        assert not target.marked(grid)[far_corner].any()


@given(
    kind=st.sampled_from(list(TargetKind)),
    columns=st.integers(3, 12),
    rows=st.integers(2, 12),
    millimetres=st.integers(5, 200),
)
def test_text_round_trip(kind, columns, rows, millimetres):
    target = Target(kind, columns, rows, millimetres / 1e3)
    assert parse_target(str(target)) == target


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("chess:9x6:0.04", "is not a board: write chessboard:9x6:0.04"),
        ("chessboard:9x6", "is not a board"),
        ("chessboard:9x6:0.04:0.08", "has a size too many"),
        ("chessboard:9x6:40", "between 0.001 and 2 m: give it in metres"),
        ("chessboard:1x9:0.04", "too small"),
        ("mask:6x4:0.04:0.02", "the mask pitch 0.02 m does not fit holes of 0.04 m"),
        ("mask:6x4:0.0.4", "is not a board"),
    ],
)
def test_refusals(text, says):
    with pytest.raises(CalibrationError, match=says):
        parse_target(text)
