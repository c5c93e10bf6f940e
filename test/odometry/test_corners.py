"""Where new points come from: everywhere, but not on top of each other."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.odometry.feature_based.corners import (
    CornerConfig,
    find_corners,
    pick_corners,
    pick_corners_reference,
)

BORDER = 12
NONE = np.zeros((0, 2))


def texture(rng, shape=(240, 320), detail_px=6):
    cells = rng.normal(size=(shape[0] // detail_px, shape[1] // detail_px)).astype(np.float32)
    return 30.0 * cv2.resize(cells, shape[::-1], interpolation=cv2.INTER_CUBIC) + 128.0


def config(points=200, cell_px=40):
    return CornerConfig(points=points, cell_px=cell_px)


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(8, 30),
    st.integers(1, 4),
    st.integers(0, 12),
    st.booleans(),
)
def test_the_kernel_is_the_plain_form(seed, cell_px, per_cell, border, masked):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(30, 70, 2))
    strength = rng.uniform(-0.2, 1.0, shape).astype(np.float32)
    occupied = rng.uniform(-10, 80, (8, 2))
    mask = rng.random(shape) < 0.6 if masked else np.ones((1, 1), np.bool_)
    found = pick_corners(strength, occupied, mask, cell_px, per_cell, border)
    plain = pick_corners_reference(
        strength, occupied, np.broadcast_to(mask, shape), cell_px, per_cell, border
    )
    np.testing.assert_array_equal(found, plain)


def test_every_cell_gets_its_share(rng):
    """A tenth of the picture with ten times the contrast gets no more than its tenth."""
    image = texture(rng)
    image[:80, :80] = 128.0 + 10.0 * (image[:80, :80] - 128.0)
    corners = find_corners(image, NONE, BORDER, None, config())
    assert 150 <= len(corners) <= 200
    cells = np.zeros((6, 8), int)
    np.add.at(cells, (corners[:, 1] // 40, corners[:, 0] // 40), 1)
    assert cells.max() <= 4
    assert cells[1:-1, 1:-1].min() >= 3  # those at the border lose some of their area
    assert corners.min() >= BORDER
    assert corners[:, 0].max() < 320 - BORDER
    assert corners[:, 1].max() < 240 - BORDER


def test_corners_keep_their_distance(rng):
    corners = find_corners(texture(rng), NONE, BORDER, None, config())
    apart = np.abs(corners[:, None] - corners[None]).max(axis=2)
    np.fill_diagonal(apart, 1000)
    assert 8 < apart.min() < 20


def test_the_strongest_comes_first():
    """Two squares, in the same cell; the corners of the brighter are taken before."""
    image = np.full((100, 100), 100.0, np.float32)
    image[25:32, 25:32] += 20.0
    image[50:57, 50:57] += 60.0
    corners = find_corners(image, NONE, BORDER, None, config(points=50, cell_px=100))
    assert (np.abs(corners[0] - 53) < 7).all()
    one = find_corners(image, np.array([[53.0, 53.0]]), BORDER, None, config(50, 100))
    assert (np.abs(one[0] - 28) < 7).all()


def test_nothing_is_taken_where_the_mask_forbids_it(rng):
    mask = np.zeros((240, 320), np.bool_)
    mask[60:180, 100:200] = True
    corners = find_corners(texture(rng), NONE, BORDER, mask, config())
    assert 30 < len(corners) < 80
    assert mask[corners[:, 1], corners[:, 0]].all()
    assert len(find_corners(texture(rng), NONE, BORDER, ~mask & False, config())) == 0


def test_points_already_there_take_up_room(rng):
    image = texture(rng)
    alone = find_corners(image, NONE, BORDER, None, config())
    kept = alone[::2].astype(np.float64) + 0.3
    more = find_corners(image, kept, BORDER, None, config())
    assert len(alone) - 15 <= len(more) + len(kept) <= len(alone) + 5
    apart = np.abs(more[:, None] - np.rint(kept)[None]).max(axis=2)
    assert apart.min() > 8
    full = find_corners(image, np.repeat(kept, 9, axis=0), BORDER, None, config())
    assert len(full) < 0.5 * len(more)


@pytest.mark.parametrize("value", [0.0, 255.0, 8000.0])
def test_a_flat_picture_has_none(value):
    image = np.full((120, 160), value, np.float32)
    assert find_corners(image, NONE, BORDER, None, config()).shape == (0, 2)


def test_contrast_changes_nothing(rng):
    """There is no threshold: a hundredth of the contrast gives the same corners."""
    image = texture(rng)
    faint = find_corners(0.01 * image, NONE, BORDER, None, config())
    np.testing.assert_array_equal(faint, find_corners(image, NONE, BORDER, None, config()))
