"""From disparities to points: where, which, and how warm."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.radiometry.thermometer import Thermometer, ThermometerConfig
from thermal_stereo_vo.stereo.dense import DisparityMap
from thermal_stereo_vo.stereo.dense_cloud import camera_cloud, points_of

CAMERA = Camera(6, 4, 100.0, 110.0, 2.5, 1.5)


def made_map(right_cx: float = 2.5) -> DisparityMap:
    disparity = np.full((4, 6), np.nan, np.float32)
    disparity[1, 2], disparity[2, 4], disparity[3, 3] = 10.0, 5.0, 0.5
    counts = np.arange(24, dtype=np.uint16).reshape(4, 6) + 7000
    return DisparityMap(9, disparity, disparity, (0.0, 15.0), CAMERA, right_cx, 0.3, counts)


def test_points_project_to_their_pixels_in_both_eyes():
    cloud = camera_cloud(made_map())
    assert cloud.xyz.shape == (3, 3)
    np.testing.assert_allclose(CAMERA.project(cloud.xyz), [[2, 1], [4, 2], [3, 3]], atol=1e-4)
    in_right = CAMERA.project(cloud.xyz - [0.3, 0.0, 0.0])
    np.testing.assert_allclose(in_right[:, 0], [2 - 10, 4 - 5, 3 - 0.5], atol=1e-3)
    np.testing.assert_array_equal(cloud.intensity, [7008, 7016, 7021])
    assert cloud.temperature_kelvin is None


def test_principal_points_of_both_eyes_count():
    nearer = camera_cloud(made_map(right_cx=3.5)).xyz[0, 2]
    np.testing.assert_allclose(nearer, 100.0 * 0.3 / (10.0 + 1.0), rtol=1e-6)


def test_far_points_and_pixels_between_steps_are_left_out():
    rows, columns, depth_m = points_of(made_map(), max_range_m=10.0)
    np.testing.assert_array_equal(np.column_stack([rows, columns]), [[1, 2], [2, 4]])
    np.testing.assert_allclose(depth_m, [3.0, 6.0])
    rows, columns, _ = points_of(made_map(), step=2)
    np.testing.assert_array_equal(np.column_stack([rows, columns]), [[2, 4]])


def test_temperatures_come_from_the_counts_of_the_same_pixel():
    thermometer = Thermometer(ThermometerConfig(planck_r=400_000.0))
    cloud = camera_cloud(made_map(), thermometer.kelvin)
    expected = thermometer.kelvin(np.array([7008, 7016, 7021]))
    np.testing.assert_array_equal(cloud.temperature_kelvin, expected)
