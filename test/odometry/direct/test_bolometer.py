"""Images of bolometers without their memory."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import adjoint, exp_se3, inverse, make_transform
from thermal_stereo_vo.odometry.direct.bolometer import camera_twist, without_memory

CAMERA = np.array([150.0, 148.0, 79.0, 61.0])
TAU_S = 0.01
RHO = 0.4


def scene(x, y):
    """Brightness of a plane at depth 1 / RHO in front of the camera at time zero."""
    return 50 * np.sin(9 * x + 4 * y) + 30 * np.sin(14 * y - 6 * x + 1)


def seen(twist, time_s):
    """(120, 160) by a camera that has moved for that long."""
    T = exp_se3(twist * time_s)  # first camera from the one now
    v, u = np.mgrid[:120, :160].astype(float)
    rays = np.stack([(u - 79) / 150, (v - 61) / 148, np.ones_like(u)], axis=-1) @ T[:3, :3].T
    points = T[:3, 3] + rays * ((1 / RHO - T[2, 3]) / rays[..., 2])[..., None]
    return scene(points[..., 0] * RHO, points[..., 1] * RHO)


@pytest.mark.parametrize(
    "twist",
    [
        [0, 0, 0, 0.3, -0.8, 0.0],
        [0, 0, 0, 0, 0, 1.5],
        [1.2, -0.6, 0, 0, 0, 0],
        [0, 0, 2, 0, 0, 0],
    ],
)
def test_smear_delay_and_loss_of_contrast_go(twist):
    twist = np.array(twist, float)
    ages_s = TAU_S * -np.log(1 - (np.arange(200) + 0.5) / 200)
    smeared = np.mean([seen(twist, -age_s) for age_s in ages_s], axis=0)
    sharp, now = np.empty((120, 160), np.float32), seen(twist, 0.0)
    without_memory(smeared, TAU_S, twist, RHO, CAMERA, sharp)
    inner = np.s_[3:-3, 3:-3]
    before = np.std((smeared - now)[inner])
    assert before > 0.9
    assert np.std((sharp - now)[inner]) < 0.2 * before


def test_a_camera_at_rest_sees_what_it_sees():
    image, out = seen(np.zeros(6), 0.0), np.empty((120, 160), np.float32)
    without_memory(image, TAU_S, np.zeros(6), RHO, CAMERA, out)
    np.testing.assert_array_equal(out, image.astype(np.float32))


def test_a_camera_moves_with_its_rig(rng):
    T_camera_rig = make_transform(exp_se3(rng.normal(size=6))[:3, :3], [0.2, -0.1, 0.05])
    twist = rng.normal(size=6)
    expected = adjoint(T_camera_rig) @ twist
    np.testing.assert_allclose(camera_twist(twist, T_camera_rig), expected, atol=1e-12)
    assert np.abs(camera_twist(twist, inverse(T_camera_rig)) - expected).max() > 0.1
