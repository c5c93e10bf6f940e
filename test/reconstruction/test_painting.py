"""Temperatures painted on a cloud through known extrinsics, with something in the way."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import Camera, DistortionModel
from thermal_stereo_vo.core.transforms import exp_se3, inverse, transform_points
from thermal_stereo_vo.reconstruction.painting import depth_buffer, painted

CAMERA = Camera(
    320, 240, 260.0, 262.0, 158.0, 121.0, DistortionModel.RADIAL_TANGENTIAL, (-0.28, 0.08, 0, 0)
)
T_CAMERA_POINTS = inverse(exp_se3([0.1, 0.01, -0.02, 0.01, -0.03, 0.02]))


def sheet(z_m, width_m=3.0, height_m=2.0, step_m=0.02):
    x, y = np.meshgrid(
        np.arange(-width_m / 2, width_m / 2, step_m), np.arange(-height_m / 2, height_m / 2, step_m)
    )
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])


def ramp():
    """(240, 320) image that tells its own pixel: 1000 y + x."""
    y, x = np.mgrid[:240, :320]
    return 1000.0 * y + x


def test_every_point_gets_the_value_where_the_lens_shows_it():
    points = sheet(4.0, step_m=0.01)  # more than OpenCV's remap takes at once
    values = painted(points, ramp(), CAMERA, T_CAMERA_POINTS)
    pixels = CAMERA.project(transform_points(T_CAMERA_POINTS, points))
    assert np.isfinite(values).mean() > 0.99
    given = np.isfinite(values)
    np.testing.assert_allclose(
        values[given], 1000.0 * pixels[given, 1] + pixels[given, 0], atol=1.0
    )


def test_what_stands_before_hides_what_is_behind():
    wall, pole = sheet(4.0), sheet(2.0, width_m=0.3, height_m=1.2)
    image = np.zeros((240, 320))
    values = painted(np.vstack([wall, pole]), image, CAMERA, T_CAMERA_POINTS)
    behind, before = np.isnan(values[: len(wall)]), np.isnan(values[len(wall) :])
    assert not before.any()
    # Seen from the camera, the pole's shadow on the wall is twice as wide.
    shadow = wall[behind]
    assert 0.5 < np.ptp(shadow[:, 0]) < 0.75
    assert 0.17 < behind.mean() < 0.26
    assert np.isfinite(painted(wall, image, CAMERA, T_CAMERA_POINTS)).all()


def test_points_behind_the_camera_and_beside_the_image_stay_bare():
    points = np.array([[0.0, 0.0, -2.0], [5.0, 0.0, 2.0], [0.0, 0.0, 2.0], [1e4, 0.0, 1.0]])
    values = painted(points, ramp(), CAMERA, np.eye(4))
    np.testing.assert_array_equal(np.isfinite(values), [False, False, True, False])


def test_no_points_no_paint():
    assert painted(np.zeros((0, 3)), ramp(), CAMERA, np.eye(4)).shape == (0,)


def test_the_nearest_point_wins_in_the_buffer():
    pixels = np.array([[10.0, 20.0], [10.2, 20.1], [100.0, 50.0]])
    buffer = depth_buffer(pixels, np.array([5.0, 3.0, 4.0]), CAMERA, 0.04)
    assert buffer[20, 10] == 3.0
    assert buffer[20, 12] == 3.0  # 4 cm at 3 m are 3.5 px
    assert np.isinf(buffer[20, 16])
    assert buffer[50, 100] == 4.0
