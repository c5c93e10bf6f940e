"""New points: corners that both eyes see, with the column of the right eye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.odometry.feature_based.corners import CornerConfig
from thermal_stereo_vo.odometry.feature_based.image_pyramid import build_pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.feature_based.patch_tracker import TrackingConfig
from thermal_stereo_vo.odometry.feature_based.stereo_points import find_stereo_points
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

NONE = np.zeros((0, 2))


@pytest.fixture(scope="module")
def pair(room):
    """The stereo images with noise, and the true disparity of each pixel of the left one."""
    images = room.pair(np.eye(4), np.random.default_rng(3))
    camera = room.camera
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(x.shape)], axis=-1
    )
    with np.errstate(divide="ignore"):
        walls = np.where(rays > 0, room.high / rays, room.low / rays)
    return images, camera.fx * room.baseline_m / walls.min(axis=-1)


def find(room, images, shift_px=0, occupied=NONE, mask=None, most_px=60.0, **tracking):
    camera = room.camera
    stereo = StereoCamera(
        camera.fx, camera.fy, camera.cx, camera.cy, camera.cx - shift_px, room.baseline_m
    )
    window = KeyframeWindow(3, 400, images[0].shape, stereo)
    left, right = (build_pyramid(image, 0.8) for image in images)
    window.add_keyframe(PoseEstimate.start(), np.zeros((6, 6)), left)
    corners, config = CornerConfig(points=200), replace(TrackingConfig(), **tracking)
    return find_stereo_points(window, left, right, mask, occupied, most_px, corners, config)


def errors_px(found, disparity, shift_px=0.0):
    pixels, right_x_px = found
    return pixels[:, 0] - right_x_px - shift_px - disparity[pixels[:, 1], pixels[:, 0]]


def test_columns_are_those_of_the_scene(room, pair):
    images, disparity = pair
    found = find(room, images)
    off = errors_px(found, disparity)
    assert 80 < len(off) < 200
    assert 0.005 < np.median(np.abs(off)) < 0.1
    assert abs(np.median(off)) < 0.03
    assert np.mean(np.abs(off) > 1.0) < 0.05
    assert len(np.unique(found[0], axis=0)) == len(off)


@pytest.mark.parametrize("shift_px", [16, -16])
def test_principal_points_may_differ(room, pair, shift_px):
    """The right image moved by whole columns: what counts is the disparity beyond them."""
    images, disparity = pair
    moved = np.roll(images[1], -shift_px, axis=1)
    off = errors_px(find(room, [images[0], moved], shift_px), disparity, shift_px)
    assert 60 < len(off) < 200
    assert 0.005 < np.median(np.abs(off)) < 0.1


def test_nearer_than_the_largest_disparity_there_is_nothing(room, pair):
    """Alignment goes on from the searched column by 4 px at most."""
    images, disparity = pair
    everything, far = (
        disparity[pixels[:, 1], pixels[:, 0]]
        for pixels, _ in (find(room, images, most_px=most) for most in (60.0, 2.0))
    )
    assert np.mean(everything > 7.0) > 0.3
    assert np.mean(far > 7.0) < 0.02
    assert len(far) > 10


def test_mask_and_points_already_there_are_respected(room, pair):
    images, _ = pair
    mask = np.zeros(images[0].shape, np.bool_)
    mask[:, 160:] = True
    pixels, right_x_px = find(room, images, mask=mask)
    assert 30 < len(pixels) == len(right_x_px) < 120
    assert pixels[:, 0].min() >= 160
    again, _ = find(room, images, occupied=pixels.astype(float))
    apart = np.abs(again[:, None] - pixels[None]).max(axis=2)
    assert apart.min() > 5


def test_rows_that_do_not_agree_are_no_pair(room, pair):
    images, _ = pair
    crooked = np.roll(images[1], 3, axis=0)
    assert len(find(room, [images[0], crooked])[0]) < 15
    assert len(find(room, [images[0], crooked], row_tolerance_px=6.0)[0]) > 60


def test_noise_gives_no_points(room):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (240, 320)).astype(np.uint8) for _ in range(2)]
    pixels, right_x_px = find(room, images)
    assert len(pixels) == len(right_x_px) < 5
    black = [np.zeros((240, 320), np.uint8)] * 2
    assert find(room, black)[0].shape == (0, 2)
