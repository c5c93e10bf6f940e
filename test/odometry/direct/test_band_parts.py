"""Small parts of the method of two bands: motion within a frame, depths, keyframes, scale."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, make_transform
from thermal_stereo_vo.odometry.direct.depth_filter import filter_depths
from thermal_stereo_vo.odometry.direct.depth_guess import depths_around, random_depths
from thermal_stereo_vo.odometry.direct.keyframe_choice import most_dispensable
from thermal_stereo_vo.odometry.direct.late_cameras import LateCameras
from thermal_stereo_vo.odometry.direct.multispectral_config import ScaleConfig
from thermal_stereo_vo.odometry.direct.photometric import take_patches
from thermal_stereo_vo.odometry.direct.photometric_window import invert_all
from thermal_stereo_vo.odometry.direct.rig import Rig
from thermal_stereo_vo.odometry.direct.scale_search import ScaleSearch

from .smooth_world import CAMERAS, T_RIG_CAMERA, smooth_image


def rig():
    return Rig(
        CAMERAS, T_RIG_CAMERA, invert_all(T_RIG_CAMERA), ((120, 160), (120, 160)), True,
        np.array([False, True]), np.zeros(2),
    )  # fmt: skip


def test_a_late_camera_looked_from_where_the_rig_was():
    """A rig that turns faster and faster: 8 ms before the stamp, and 5 ms after it."""

    def T_rig_world(t):
        return inverse(exp_se3([0.3 * t, 0.1 * t * t, 0, 0, 0.8 * t + 3.0 * t * t, 0]))

    step, now = 0.05, T_rig_world(0.0)
    for lag_s in (0.008, -0.005):
        older = LateCameras(np.zeros(2), T_rig_world(-2 * step), step, None)
        before = older.mean_twist(T_rig_world(-step)), step
        late = LateCameras.after(np.array([0.0, lag_s]), T_rig_world(-step), step, before)
        found = late.T_then_now(now)
        np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
        expected = T_rig_world(-lag_s) @ inverse(now)
        assert np.linalg.norm(log_se3(found[1] @ inverse(expected))) < 1e-4
        assert np.linalg.norm(log_se3(expected)) > 3e-3
        # Without the interval before, what speeds up is not known.
        blunt = LateCameras.after(late.lags_s, late.T_before, step, (before[0], 3 * step))
        assert blunt.twist_before is None
    np.testing.assert_allclose(late.twist(now), [0.3, 0, 0, 0, 0.8, 0], atol=0.02)


def test_random_depths_have_mean_one(rng):
    rhos = random_depths(500, rng)
    assert rhos.mean() == pytest.approx(1.0)
    assert 0.05 < rhos.std() < 0.2


def test_new_points_are_as_far_as_those_around_them(rng):
    """Known in the first camera, wanted in the second: a plane that recedes to the right."""
    pixels = np.column_stack([rng.uniform(5, 155, 300), rng.uniform(5, 115, 300)])
    bearings = rig().bearings(0, pixels)
    rhos = 0.4 - 0.3 * bearings[:, 0]
    T = np.tile(np.eye(4), (300, 1, 1))
    wanted = np.array([[40, 60], [80, 60], [120, 60]])
    found = depths_around(rig(), 1, T, bearings, rhos, wanted)
    assert 0.40 < found[0] < 0.55
    assert found[0] > found[1] > found[2]
    # The plane z (0.4 - 0.3 x / z) = 1 as the second camera sees it.
    T_1_rig = rig().T_camera_rig[1]
    n = T_1_rig[:3, :3] @ [-0.3, 0.0, 0.4]
    d = 1.0 + n @ T_1_rig[:3, 3]
    expected = rig().bearings(1, wanted) @ n / d
    np.testing.assert_allclose(found, expected, rtol=0.05)
    assert depths_around(rig(), 1, T[:3], bearings[:3], rhos[:3], wanted) is None


def keyframe_at(x, turn=0.0):
    return inverse(exp_se3([x, 0, 0, 0, turn, 0]))


def test_what_is_out_of_sight_goes_first():
    T = np.stack([keyframe_at(0.1 * i) for i in range(5)])
    points, all_there = np.full(5, 50), np.ones(5)
    sight = all_there.copy()
    sight[2] = 0.01
    assert most_dispensable(T, keyframe_at(0.5), 1.0, points, sight) == 2
    points[3] = 3
    assert most_dispensable(T, keyframe_at(0.5), 1.0, points, all_there) == 3


def test_the_newest_stays_and_one_of_a_cluster_goes():
    T = np.stack([keyframe_at(x) for x in (0.0, 1.0, 1.02, 1.9, 2.0)])
    chosen = most_dispensable(T, keyframe_at(2.1), 1.0, np.full(5, 50), np.ones(5))
    assert chosen in (1, 2)
    turned = np.stack([keyframe_at(0.0, turn) for turn in (0.0, 0.5, 0.51, 0.9, 1.0)])
    chosen = most_dispensable(turned, keyframe_at(0.0, 1.1), 1.0, np.full(5, 50), np.ones(5))
    assert chosen in (1, 2)


@pytest.mark.parametrize("error", [-0.3, 0.3])
def test_depths_are_found_along_the_epipolar_line(rng, error):
    """Patches of a plane, seen again from 20 cm aside; first guesses 30 % off."""
    texture = smooth_image(rng, (120, 260))
    shift_px = 150.0 * 0.2 * 0.4
    x, y = np.meshgrid(np.arange(40, 100, 6.0), np.arange(20, 100, 8.0))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    count = len(pixels)
    host, target = texture[:, 30:190], texture[:, 30 + round(shift_px) : 190 + round(shift_px)]
    patches, trusts = np.zeros((count, 8)), np.zeros((count, 8))
    take_patches(np.ascontiguousarray(host), pixels, 1.0, 50.0, patches, trusts)
    camera = np.array([[150.0, 150.0, 80.0, 60.0]])
    bearings = np.column_stack([(pixels - [80, 60]) / 150, np.ones(count)])
    rhos = np.full(count, 0.4 * (1 + error))
    information = np.full(count, (3.0 / 0.2) ** 2)
    refined = filter_depths(
        inverse(make_transform(np.eye(3), [0.2, 0, 0])), np.zeros((1, 2)),
        (np.ascontiguousarray(target),), np.array([True]), camera, np.eye(4)[None],
        np.eye(4)[None], np.zeros((1, 1, 2)), np.eye(4)[None, None], np.zeros(count, np.int64),
        np.zeros(count, np.int64), bearings, 1 / camera[:, :2], patches, trusts,
        np.array([False]), 9.0, 14.0, 3.0, 1.0, rhos, information,
    )  # fmt: skip
    assert refined > 0.6 * count
    better = information > 1.01 * (3.0 / 0.2) ** 2
    assert np.median(np.abs(rhos[better] / 0.4 - 1)) < 0.05


@pytest.mark.parametrize(
    ("scales", "wrong"),
    [
        ([1.4, 1.41] * 4, True),
        ([0.7, 0.71] * 4, True),
        ([1.05, 1.06] * 4, False),
        ([1.4] * 5, False),
        ([1.0, 2.2] * 4, False),
    ],
)
def test_a_size_that_turns_out_wrong_is_contradicted_by_many_that_agree(scales, wrong):
    search = ScaleSearch(ScaleConfig())
    for scale in scales:
        search.note(np.log(scale))
    assert search.contradicts() is wrong
