"""Cameras undistorted one by one: each obeys the pinhole it claims, and stays where it is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import (
    THERMAL,
    VISIBLE,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, identity, make_transform
from thermal_stereo_vo.stereo.rectification import assemble
from thermal_stereo_vo.stereo.undistortion import Undistorter, common_percent

VISIBLE_LENS = Camera(
    376, 240, 210.0, 211.0, 190.0, 118.0, DistortionModel.RADIAL_TANGENTIAL, (-0.2, 0.05, 0.001, 0)
)
THERMAL_LENS = Camera(
    160, 128, 150.0, 149.0, 81.0, 62.0, DistortionModel.EQUIDISTANT, (-0.013, 0.02, -0.012, 0.003)
)
T_RIG_THERMAL = make_transform(exp_so3([0.01, -0.02, 0.03]), [0.09, 0.01, -0.02])
RIG = RigCalibration(
    {
        VISIBLE: RigCamera(VISIBLE_LENS, exp_se3([0.01, 0.02, 0.03, 0.02, 0.01, -0.02])),
        THERMAL: RigCamera(THERMAL_LENS, T_RIG_THERMAL),
    },
    origin="two bands",
)
ROLES = (VISIBLE, THERMAL)


def dots(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """An image with a soft dot where each ray meets it."""
    image = np.zeros((camera.height, camera.width), np.float32)
    y, x = np.mgrid[: camera.height, : camera.width]
    for u, v in camera.project(rays):
        image += np.exp(-((x - u) ** 2 + (y - v) ** 2) / 4.0)
    return (20000 * image).astype(np.uint16)


def centre(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    x0, y0 = np.rint(near).astype(int) - 5
    patch = image[y0 : y0 + 11, x0 : x0 + 11].astype(float)
    y, x = np.mgrid[y0 : y0 + 11, x0 : x0 + 11]
    return np.array([(x * patch).sum(), (y * patch).sum()]) / patch.sum()


@pytest.mark.parametrize("role", ROLES)
def test_a_ray_meets_the_ideal_pinhole_where_it_says(role):
    undistorter = Undistorter(RIG, ROLES)
    raw = RIG[role].camera
    rays = np.array([[0.0, 0.0, 1.0], [0.35, 0.2, 1.0], [-0.3, 0.22, 1.0], [0.2, -0.25, 1.0]])
    view = undistorter.process(RadiometricFrame(dots(raw, rays), 5, role), role)
    assert not view.camera.has_distortion
    assert view.camera.size == raw.size
    for pixel in view.camera.project(rays):
        assert np.linalg.norm(centre(view.image, pixel) - pixel) < 0.1
    displaced = np.linalg.norm(raw.project(rays) - view.camera.project(rays), axis=1)
    assert displaced.max() > 0.5  # else the test would see nothing


def test_cameras_stay_where_the_calibration_says():
    undistorter = Undistorter(RIG, ROLES)
    np.testing.assert_array_equal(undistorter.T_rig_rectified, identity())
    for role in ROLES:
        image = np.ones(RIG[role].camera.size[::-1], np.uint8)
        view = undistorter.process(RadiometricFrame(image, 1, role), role)
        np.testing.assert_array_equal(view.T_rig_camera, RIG[role].T_rig_camera)
        assert undistorter.rectified_calibration[role].camera == view.camera
    assert not undistorter.rectified_calibration.rectified


@pytest.mark.parametrize("role", ROLES)
def test_alpha_goes_from_the_pinhole_of_the_lens_to_the_whole_image(role):
    raw = RIG[role].camera
    own, half, whole = (
        Undistorter(RIG, ROLES, alpha).rectified_calibration[role].camera for alpha in (0, 0.5, 1)
    )
    assert own == raw.without_distortion()
    assert half.fx == pytest.approx((own.fx + whole.fx) / 2)
    corners = np.array([[0, 0], [raw.width - 1, 0], [0, raw.height - 1]], float)
    outside = [
        np.maximum(-pixels, pixels - raw.size).max()
        for pixels in (camera.project(raw.unproject(corners)) for camera in (own, whole))
    ]
    assert outside[1] < 8.0 < outside[0]


def test_pixels_never_seen_are_masked_and_keep_out_those_asked_for():
    undistorter = Undistorter(RIG, ROLES, alpha=1.0)
    image = np.full((240, 376), 900, np.uint16)
    given = np.ones(image.shape, bool)
    given[100:140, 150:200] = False
    gap = Gap(10, GapReason.DARK, True)
    frame = RadiometricFrame(image, 1, VISIBLE, mask=given, epoch=3, gap=gap)
    view = undistorter.process(frame, VISIBLE)
    assert view.image.dtype == np.uint16
    assert np.all(view.image[view.mask] == 900)
    assert not view.mask[view.camera.height // 2, 0]
    assert view.mask[200, 300]
    assert not view.mask[view.camera.height // 2, round(view.camera.cx) - 15]
    assert (view.epoch, view.gap) == (3, gap)


def test_images_of_an_ideal_camera_pass_untouched():
    plain = RigCalibration(
        {role: RigCamera(rig.camera.without_distortion()) for role, rig in RIG.cameras.items()}
    )
    image = np.random.default_rng(3).integers(0, 4000, (240, 376)).astype(np.uint16)
    view = Undistorter(plain, ROLES).process(RadiometricFrame(image, 1, VISIBLE), VISIBLE)
    assert view.image is image
    assert view.mask is None


def test_a_pair_becomes_one_frame_and_a_missing_camera_is_told():
    undistorter = Undistorter(RIG, ROLES)
    visible = RadiometricFrame(np.ones((240, 376), np.uint8), 1000, VISIBLE)
    thermal = RadiometricFrame(np.ones((128, 160), np.uint16), 1400, THERMAL)
    both = assemble(undistorter, visible, thermal, 1000)
    assert list(both.views) == [VISIBLE, THERMAL]
    assert both.skew_ns == 400
    blind = RadiometricFrame(None, 1400, THERMAL, blind=GapReason.FFC)
    assert assemble(undistorter, visible, blind, 1000).blind == {THERMAL: GapReason.FFC}
    assert assemble(undistorter, None, thermal, 1400).blind == {VISIBLE: GapReason.DROPPED}


def test_wrong_size_is_said_with_the_name_of_the_camera():
    undistorter = Undistorter(RIG, ROLES)
    with pytest.raises(FrameError, match="'thermal' gives 376x240 pixels, but the calibration two"):
        undistorter.process(RadiometricFrame(np.ones((240, 376), np.uint8), 1, THERMAL), THERMAL)


def test_cameras_that_look_apart_are_refused():
    behind = replace(
        RIG[THERMAL], T_rig_camera=make_transform(exp_so3([0.0, np.pi, 0.0]), [0.1, 0.0, 0.0])
    )
    apart = replace(RIG, cameras={VISIBLE: RIG[VISIBLE], THERMAL: behind})
    with pytest.raises(CalibrationError, match="visible and thermal of two bands share 0 %"):
        Undistorter(apart, ROLES)


def test_common_share_of_views_is_that_of_the_geometry():
    wide = Camera(101, 101, 50.0, 50.0, 50.0, 50.0)
    narrow = Camera(101, 101, 100.0, 100.0, 50.0, 50.0)
    same_place = identity()
    assert common_percent(narrow, wide, same_place, 5.0) == 100.0
    assert common_percent(wide, narrow, same_place, 5.0) == pytest.approx(25.0, abs=5.0)
    beside = make_transform(np.eye(3), [-5.0, 0.0, 0.0])
    assert common_percent(wide, wide, beside, 5.0) == pytest.approx(50.0, abs=5.0)
    assert common_percent(wide, wide, beside, 2.0) == 0.0


def test_undistortion_is_that_of_opencv():
    """The whole way against ``cv2.undistort``, an independent path through the same model."""
    undistorter = Undistorter(RIG, ROLES)
    image = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 255, (240, 376)).astype(np.float32), (0, 0), 3.0
    )
    image = (200 * image).astype(np.uint16)
    view = undistorter.process(RadiometricFrame(image, 1, VISIBLE), VISIBLE)
    lens = np.array(VISIBLE_LENS.distortion)
    expected = cv2.undistort(image, VISIBLE_LENS.matrix, lens, None, view.camera.matrix)
    assert np.abs(view.image.astype(int) - expected)[view.mask].max() <= 4
