"""What direct methods make of images: units, gradients, points and their depth."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry.direct.gradient_pyramid import (
    BrightnessUnit,
    build_gradient_pyramid,
    fill_gradients,
    gradients_reference,
)
from thermal_stereo_vo.odometry.direct.photometric_window import invert_all
from thermal_stereo_vo.odometry.direct.point_selection import (
    SelectionConfig,
    clear_below,
    fill_steepness,
    select_points,
)
from thermal_stereo_vo.odometry.direct.static_stereo import find_disparities


def test_gradients_are_those_of_numpy(rng):
    image = rng.normal(size=(30, 40)).astype(np.float32) * 100 + 5000
    unit = BrightnessUnit(5000.0, 4.0)
    out = np.empty((30, 40, 3), np.float32)
    fill_gradients(image, np.float32(5000), np.float32(0.25), out)
    np.testing.assert_allclose(out, gradients_reference(image, unit), atol=1e-4)


def test_counts_of_any_span_look_alike(rng):
    grey = np.clip(rng.normal(120, 40, (120, 160)), 0, 255)
    mask = np.ones((120, 160), bool)
    small = BrightnessUnit.of((grey * 4 + 7000).astype(np.uint16), mask)
    large = BrightnessUnit.of((grey * 40).astype(np.uint16), None)
    assert large.unit_counts == pytest.approx(10 * small.unit_counts, rel=0.02)
    a = build_gradient_pyramid((grey * 4 + 7000).astype(np.uint16), 0.8, small)
    b = build_gradient_pyramid((grey * 40).astype(np.uint16), 0.8, large)
    assert [level.shape for level in a] == [(120, 160, 3), (60, 80, 3), (30, 40, 3), (15, 20, 3)]
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x, y, atol=2.0)
    assert 20 < a[0][..., 0].std() < 70


def test_a_flat_or_masked_image_has_no_unit():
    flat = np.full((64, 64), 77, np.uint8)
    assert BrightnessUnit.of(flat, None) is None
    assert BrightnessUnit.of(flat, np.zeros((64, 64), bool)) is None


def test_points_are_steep_spread_and_away_from_others(room, rng):
    image = room.pair(np.eye(4), rng)[0]
    level = build_gradient_pyramid(image, 0.8, BrightnessUnit.of(image, None))[0]
    config = SelectionConfig(points=300)
    mask = np.ones(image.shape, bool)
    mask[:, :100] = False
    points = select_points(level, np.zeros((0, 2)), mask, config)
    assert 100 < len(points) <= 330
    assert points[:, 0].min() >= 100
    slope = np.hypot(level[..., 1], level[..., 2])
    assert np.median(slope[points[:, 1], points[:, 0]]) > 2 * np.median(slope)
    cells = {(x // 80, y // 80) for x, y in points}
    assert len(cells) >= 8  # of 9 that the mask leaves
    rest = select_points(level, points[::2].astype(float), mask, config)
    assert 0.2 * len(points) < len(rest) < 0.8 * len(points)
    apart = np.abs(rest[:, None] - points[None, ::2]).max(axis=2).min(axis=1)
    assert apart.min() > 3


@pytest.mark.parametrize(("shown", "least", "most"), [(1.0, 0.9, 1.1), (0.5, 0.75, 1.1)])
def test_what_shows_something_gets_the_points_of_what_does_not(rng, shown, least, most):
    image = np.zeros((240, 320), np.float32)
    width = int(shown * 320)
    image[:, :width] = rng.normal(0, 60, (240, width))
    level = build_gradient_pyramid(image, 0.8, BrightnessUnit(0.0, 1.0))[0]
    points = select_points(level, np.zeros((0, 2)), None, SelectionConfig(points=300))
    assert least < len(points) / 300 < most
    assert points[:, 0].max() < width + 3
    assert len(np.unique(points, axis=0)) == len(points)
    more = select_points(level, points.astype(float), None, SelectionConfig(points=300))
    assert len(more) < 0.2 * len(points)


def test_a_scene_that_shows_next_to_nothing_is_not_filled_at_any_price(rng):
    image = np.zeros((240, 320), np.float32)
    image[100:140, 100:140] = rng.normal(0, 60, (40, 40))
    level = build_gradient_pyramid(image, 0.8, BrightnessUnit(0.0, 1.0))[0]
    points = select_points(level, np.zeros((0, 2)), None, SelectionConfig(points=300))
    assert 10 < len(points) < 40
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 100 * np.eye(len(points))
    assert apart.min() > 3


def test_disparities_are_those_of_the_room(room, rng):
    T = exp_se3([0.0, 0.0, 0.0, 0.0, 0.2, 0.0])
    left, right = room.pair(T, rng)
    unit = BrightnessUnit.of(left, None)
    pyramids = [build_gradient_pyramid(image, 0.8, unit) for image in (left, right)]
    pixels = select_points(pyramids[0][0], np.zeros((0, 2)), None, SelectionConfig(points=300))
    found, score = find_disparities(*pyramids, pixels, 0.0, 60.0)
    good = np.isfinite(found)
    assert 0.5 < good.mean() <= 1.0
    assert (score[good] >= 0.7).all()
    camera = room.camera
    rays = np.column_stack(
        [(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))]
    )
    directions = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, room.high / directions, room.low / directions)
    true = camera.fx * room.baseline_m / reach.min(axis=1)
    errors = np.abs(found - true)[good]
    assert 1e-3 < np.median(errors) < 0.15
    assert np.mean(errors < 0.5) > 0.9


def test_many_motions_are_inverted_at_once(rng):
    T = np.stack([exp_se3(rng.normal(size=6)) for _ in range(6)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(invert_all(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)


def test_steepness_and_what_is_too_flat_are_those_of_the_plain_form(rng):
    image = rng.normal(size=(50, 70, 3)).astype(np.float32)
    steep = np.empty((50, 70), np.float32)
    fill_steepness(image, steep)
    np.testing.assert_allclose(steep, np.hypot(image[..., 1], image[..., 2]), rtol=1e-6)
    least = rng.uniform(0.5, 2.0, (3, 4)).astype(np.float32)
    wide = np.repeat(np.repeat(least, 16, axis=0), 16, axis=1)
    wide = np.pad(wide, ((0, 2), (0, 6)), mode="edge")
    expected = np.where(steep < wide, 0.0, steep)
    clear_below(steep, least, 16)
    np.testing.assert_array_equal(steep, expected)
    assert 0.1 < np.mean(steep == 0.0) < 0.9
