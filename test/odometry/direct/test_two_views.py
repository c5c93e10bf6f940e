"""The start from two views that are far apart."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.transforms import exp_so3, inverse, log_so3, make_transform
from thermal_stereo_vo.odometry.direct.two_views import two_views

from .test_multispectral import fly, odometry, rms_m, umeyama, without
from .two_band_room import CAMERAS, HALF_M, Room

CAMERA = CAMERAS[VISIBLE]
PINHOLE = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


def grey(room, T):
    return np.clip(128 + 32 * room.look(VISIBLE, T), 0, 255).astype(np.uint8)


def test_motion_and_depths_are_those_of_the_room():
    room = Room(3)
    # Into a corner: one wall alone would leave two motions.
    T_world_first = make_transform(exp_so3([0.25, 0.7, 0.0]), np.zeros(3))
    T_first_second = make_transform(exp_so3([0.02, -0.05, 0.03]), [0.25, -0.05, 0.3])
    views = two_views(
        grey(room, T_world_first), grey(room, T_world_first @ T_first_second), PINHOLE
    )
    true = inverse(T_first_second)
    found = views.T_second_first
    assert np.linalg.norm(log_so3(found[:3, :3].T @ true[:3, :3])) < 0.01
    ways = [T[:3, 3] / np.linalg.norm(T[:3, 3]) for T in (found, true)]
    assert ways[0] @ ways[1] > np.cos(0.05)
    assert np.median(views.rhos) == pytest.approx(1.0)
    rays = np.column_stack([(views.pixels - PINHOLE[2:]) / PINHOLE[:2], np.ones(len(views.pixels))])
    true_rhos = 1.0 / (HALF_M / np.abs(rays @ T_world_first[:3, :3].T)).min(axis=1)
    ratio = views.rhos / true_rhos
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.05
    unit_m = np.linalg.norm(true[:3, 3]) / np.linalg.norm(found[:3, 3])
    assert np.median(ratio) == pytest.approx(unit_m, rel=0.05)


def test_views_that_tell_nothing_are_told_from_those_that_do():
    room = Room(3)
    here = grey(room, np.eye(4))
    assert two_views(here, here, PINHOLE) is None
    assert two_views(here, np.full_like(here, 100), PINHOLE) is None
    assert two_views(np.full_like(here, 100), here, PINHOLE) is None


def test_a_camera_that_starts_in_full_motion_is_followed():
    """30 cm from frame to frame: random depths alone do not find the second one."""
    room, rng = Room(3), np.random.default_rng(2)
    poses = np.stack([make_transform(np.eye(3), [0.02 * i, 0, -1.5 + 0.3 * i]) for i in range(7)])
    frames = [without(room.frame(i, T, rng), THERMAL) for i, T in enumerate(poses)]
    results = fly(odometry(), frames)
    assert all(result.status.value == "TRACKING" for result in results[1:])
    found = np.array([result.T_world_rig[:3, 3] for result in results])
    true = poses[:, :3, 3]
    assert rms_m(umeyama(found, true, with_scale=True), found, true) < 0.03
