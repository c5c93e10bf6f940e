"""Rectified images obey the pinholes they claim, eye by eye and pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import (
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame
from thermal_stereo_vo.core.transforms import (
    exp_se3,
    exp_so3,
    inverse,
    make_transform,
    transform_points,
)
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.stereo.rectification import (
    RectificationConfig,
    Rectifier,
    assemble,
    with_rectification,
)

WIDTH, HEIGHT = 320, 256
RADTAN = (-0.285, 0.09, 0.0006, -0.0004, 0.0)
KANNALA = (-0.013, 0.02, -0.012, 0.003)
T_LEFT_RIGHT = make_transform(exp_so3([0.012, -0.02, 0.03]), [0.268, 0.006, -0.009])


def camera(model=DistortionModel.NONE, lens=(), fx=261.0, cx=158.0) -> Camera:
    return Camera(WIDTH, HEIGHT, fx, fx + 1.5, cx, 129.0, model, lens)


def make_rig(model=DistortionModel.NONE, lens=(), T_left_right=T_LEFT_RIGHT) -> RigCalibration:
    """Two different cameras on a rig whose frame is neither of them."""
    T_rig_left = exp_se3([0.1, -0.2, 0.3, 0.2, -0.1, 0.4])
    return RigCalibration(
        {
            "left": RigCamera(camera(model, lens), T_rig_left),
            "right": RigCamera(camera(model, lens, 265.0, 164.0), T_rig_left @ T_left_right),
        },
        origin="this rig",
    )


RIGS = {
    "radial tangential": make_rig(DistortionModel.RADIAL_TANGENTIAL, RADTAN),
    "equidistant": make_rig(DistortionModel.EQUIDISTANT, KANNALA),
    "turned but without distortion": make_rig(),
}
each_rig = pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)


def frame(image, role="left", **more) -> RadiometricFrame:
    return RadiometricFrame(image, 0, role, **more)


def raw_pixels(rig, rectifier, role):
    """(H * W, 2) raw pixel that each rectified pixel must show, by the camera models alone."""
    pinhole = rectifier.rectified_calibration[role].camera
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = pinhole.unproject(np.column_stack([x.ravel(), y.ravel()]))
    # The rectified eyes share one orientation, that of the rectified left camera.
    R_rig_rectified = rectifier.T_rig_rectified[:3, :3]
    R_camera_rig = rig[role].T_rig_camera[:3, :3].T
    return rig[role].camera.project(rays @ (R_camera_rig @ R_rig_rectified).T)


@each_rig
@pytest.mark.parametrize("role", ["left", "right"])
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_each_rectified_pixel_shows_the_ray_it_claims(rig, role, alpha):
    """Ramps survive bilinear interpolation, so the image itself tells where it was sampled."""
    rectifier = Rectifier(rig, RectificationConfig(alpha=alpha))
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    expected = raw_pixels(rig, rectifier, role).reshape(HEIGHT, WIDTH, 2)
    for k, coordinate in enumerate((x, y)):
        view = rectifier.process(frame((100 * coordinate + 50).astype(np.uint16), role), role)
        seen = view.mask
        assert seen.mean() > (0.9 if alpha == 0.0 else 0.4)
        sampled = (view.image.astype(np.float64) - 50) / 100
        assert np.abs(sampled - expected[..., k])[seen].max() < 0.05


@each_rig
def test_the_mask_is_what_the_raw_image_shows(rig):
    rectifier = Rectifier(rig, RectificationConfig(alpha=1.0))
    x, y = raw_pixels(rig, rectifier, "right").T.reshape(2, HEIGHT, WIDTH)
    view = rectifier.process(frame(np.zeros((HEIGHT, WIDTH), np.uint8), "right"), "right")
    surely_in = (x > 0.1) & (y > 0.1) & (x < WIDTH - 1.1) & (y < HEIGHT - 1.1)
    surely_out = (x < -0.1) | (y < -0.1) | (x > WIDTH - 0.9) | (y > HEIGHT - 0.9)
    assert surely_out.any()
    assert view.mask[surely_in].all()
    assert not view.mask[surely_out].any()


def test_alpha_0_shows_almost_nothing_unseen():
    rig = RIGS["radial tangential"]
    unseen = [
        np.mean(~Rectifier(rig, RectificationConfig(alpha=a)).process(
            frame(np.zeros((HEIGHT, WIDTH), np.uint8)), "left").mask)
        for a in (0.0, 1.0)
    ]  # fmt: skip
    assert unseen[0] < 0.02 < unseen[1]


def points_before(rectifier, rng, n=400):
    """Points that both rectified eyes see: in rig axes, and in those of the rectified left eye."""
    points = np.column_stack([rng.uniform(-3, 3, (n, 2)), rng.uniform(4, 40, n)])
    return transform_points(rectifier.T_rig_rectified, points), points


@each_rig
def test_points_land_on_equal_rows_and_triangulate_to_where_they_are(rig, rng):
    rectifier = Rectifier(rig, RectificationConfig())
    calibration = rectifier.rectified_calibration
    in_rig, in_left = points_before(rectifier, rng)
    pixels = {}
    for role in ("left", "right"):
        T_camera_rig = inverse(rig[role].T_rig_camera)
        raw = rig[role].camera.project(transform_points(T_camera_rig, in_rig))
        # Undo the raw lens, turn into the rectified camera, project by its pinhole.
        R = rectifier.T_rig_rectified[:3, :3].T @ rig[role].T_rig_camera[:3, :3]
        pixels[role] = calibration[role].camera.project(rig[role].camera.unproject(raw) @ R.T)
    np.testing.assert_allclose(pixels["left"][:, 1], pixels["right"][:, 1], atol=1e-4)
    views = {r: rectifier.process(frame(np.zeros((HEIGHT, WIDTH), np.uint8), r), r) for r in pixels}
    stereo = StereoCamera.of(views["left"], views["right"])
    assert stereo.baseline_m == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), rel=1e-6)
    np.testing.assert_allclose(
        stereo.triangulate(pixels["left"], pixels["right"]), in_left, rtol=1e-3, atol=1e-3
    )


def test_rows_would_not_agree_without_the_rotation():
    """The rig of these tests would show a rectification that is skipped when D = 0."""
    rig = RIGS["turned but without distortion"]
    rng = np.random.default_rng(1)
    in_rig, _ = points_before(Rectifier(rig, RectificationConfig()), rng)
    rows = [
        rig[r].camera.project(transform_points(inverse(rig[r].T_rig_camera), in_rig))[:, 1]
        for r in ("left", "right")
    ]
    assert np.median(np.abs(rows[0] - rows[1])) > 2.0
    assert not any(rig[r].camera.has_distortion for r in ("left", "right"))


@each_rig
def test_r_and_p_of_the_file_are_used(rig):
    """Files may carry another R and P than OpenCV would choose: theirs count."""
    completed, _ = with_rectification(rig, RectificationConfig())
    P = {r: completed[r].projection.copy() for r in ("left", "right")}
    for p in P.values():
        p[0, 0] = p[1, 1] = 250.0
        p[0, 3] *= 250.0 / completed["left"].projection[0, 0]
        p[0, 3] += 250.0 * 0.04  # as in KITTI, where both eyes are seen from a third camera
    # Both eyes turned alike about y would move the baseline out of the rows: only about x may be
    # chosen freely.
    tilt = exp_so3([0.03, 0.0, 0.0])
    cameras = {
        r: replace(completed[r], rectification=tilt @ completed[r].rectification, projection=P[r])
        for r in P
    }
    given = replace(completed, cameras=cameras)
    rectifier = Rectifier(given, RectificationConfig(alpha=1.0))
    assert rectifier.rectified_calibration["left"].camera.fx == 250.0
    np.testing.assert_allclose(
        rectifier.T_rig_rectified[:3, :3],
        completed["left"].T_rig_camera[:3, :3] @ cameras["left"].rectification.T,
        atol=1e-12,
    )
    assert rectifier.baseline_m == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), rel=1e-6)
    x = np.tile(100 * np.arange(WIDTH), (HEIGHT, 1)).astype(np.uint16)
    view = rectifier.process(frame(x, "right"), "right")
    expected = raw_pixels(given, rectifier, "right")[:, 0].reshape(HEIGHT, WIDTH)
    assert np.abs(view.image / 100.0 - expected)[view.mask].max() < 0.05


@each_rig
def test_completed_calibration_rectifies_alike(rig, rng):
    """Written with R and P and read again, a rig gives the same images and poses."""
    rig = replace(rig, T_base_rig=default_T_base_rig())
    first = Rectifier(rig, RectificationConfig())
    completed, T_rig_rectified = with_rectification(rig, RectificationConfig())
    second = Rectifier(completed, RectificationConfig())
    np.testing.assert_allclose(T_rig_rectified, first.T_rig_rectified)
    np.testing.assert_allclose(second.T_rig_rectified, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        second.rectified_calibration.T_base_rig, first.rectified_calibration.T_base_rig, atol=1e-12
    )
    image = rng.integers(0, 2**14, (HEIGHT, WIDTH)).astype(np.uint16)
    for role in ("left", "right"):
        a, b = (r.process(frame(image.copy(), role), role) for r in (first, second))
        assert np.array_equal(a.image, b.image)
        assert np.array_equal(a.mask, b.mask)


def test_rectified_images_pass_untouched():
    rig = RigCalibration(
        {
            "left": RigCamera(camera(), exp_se3([0, 0, 0, 0.1, 0, 0])),
            "right": RigCamera(
                camera(cx=150.0),
                exp_se3([0, 0, 0, 0.1, 0, 0]) @ make_transform(np.eye(3), [0.2, 0, 0]),
            ),
        },
        rectified=True,
    )
    rectifier = Rectifier(rig, RectificationConfig())
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    mask = np.ones((HEIGHT, WIDTH), bool)
    view = rectifier.process(frame(image, "right", mask=mask), "right")
    assert view.image is image
    assert view.mask is mask
    assert view.camera == rig["right"].camera
    np.testing.assert_allclose(view.T_rig_camera[:3, 3], [0.2, 0, 0])
    np.testing.assert_allclose(rectifier.T_rig_rectified, rig["left"].T_rig_camera)
    completed, T_rig_rectified = with_rectification(rig, RectificationConfig())
    assert completed.rectified
    np.testing.assert_allclose(completed["left"].T_rig_camera, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T_rig_rectified, rig["left"].T_rig_camera)


def test_counts_stay_linear_and_keep_their_type():
    """A ramp of 300 counts comes out as 300 levels, not squeezed into 8 bits."""
    rectifier = Rectifier(RIGS["radial tangential"], RectificationConfig())
    ramp = np.tile(7000 + np.arange(WIDTH), (HEIGHT, 1)).clip(7000, 7299).astype(np.uint16)
    view = rectifier.process(frame(ramp), "left")
    assert view.image.dtype == np.uint16
    levels = np.unique(view.image[view.mask])
    assert 250 <= len(levels) <= 300
    assert levels.min() >= 7000
    assert levels.max() <= 7299
    shown8 = rectifier.process(frame((ramp - 7000).clip(0, 255).astype(np.uint8)), "left")
    assert shown8.image.dtype == np.uint8


def test_bad_pixels_stay_bad_with_all_that_was_mixed_with_them():
    rectifier = Rectifier(RIGS["turned but without distortion"], RectificationConfig(alpha=1.0))
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[100, 150] = False
    image = np.full((HEIGHT, WIDTH), 1000, np.uint16)
    image[100, 150] = 60000
    view = rectifier.process(frame(image, mask=mask), "left")
    bare = rectifier.process(frame(np.full((HEIGHT, WIDTH), 1000, np.uint16)), "left")
    spoilt = bare.mask & ~view.mask
    assert 1 <= spoilt.sum() <= 9
    assert (view.image[view.mask] == 1000).all()
    assert (view.image[spoilt] > 1000).any()


def test_blindness_epoch_and_gap_travel_with_the_frame():
    rectifier = Rectifier(RIGS["radial tangential"], RectificationConfig())
    gap = Gap(500_000_000, GapReason.FFC, epoch_changed=True)
    assert rectifier.process(frame(None), "left") is None
    view = rectifier.process(frame(np.zeros((HEIGHT, WIDTH), np.uint8), epoch=3, gap=gap), "left")
    assert view.epoch == 3
    assert view.gap is gap


def test_assembled_frame_says_who_is_blind_and_why():
    rectifier = Rectifier(RIGS["radial tangential"], RectificationConfig())
    good = RadiometricFrame(np.zeros((HEIGHT, WIDTH), np.uint8), 1_000, "left")
    late = replace(good, stamp_ns=1_500, camera="right")
    both = assemble(rectifier, good, late, 1_000)
    assert set(both.views) == {"left", "right"}
    assert (both.stamp_ns, both.skew_ns, dict(both.blind)) == (1_000, 500, {})
    assert assemble(rectifier, replace(good, stamp_ns=2_000), late, 2_000).skew_ns == -500

    blind = assemble(rectifier, good, replace(late, image=None, blind=GapReason.FROZEN), 1_000)
    assert set(blind.views) == {"left"}
    assert blind.blind == {"right": GapReason.FROZEN}
    alone = assemble(rectifier, None, late, 1_500)
    assert set(alone.views) == {"right"}
    assert alone.blind == {"left": GapReason.DROPPED}
    assert alone.skew_ns == 0


def test_images_of_another_size_are_refused():
    rectifier = Rectifier(RIGS["radial tangential"], RectificationConfig())
    with pytest.raises(
        FrameError,
        match="camera 'right' gives 640x512 pixels, but the calibration this rig is for 320x256: "
        "use the calibration of this camera and video mode",
    ):
        rectifier.process(frame(np.zeros((512, 640), np.uint8), "right"), "right")


def test_eyes_of_different_lens_models_are_refused():
    left = RigCamera(camera(DistortionModel.EQUIDISTANT, KANNALA))
    right = RigCamera(camera(DistortionModel.RADIAL_TANGENTIAL, RADTAN), T_LEFT_RIGHT)
    with pytest.raises(
        CalibrationError,
        match=r"mixed\.yaml: one eye is equidistant and the other is not; calibrate both with the "
        "same model",
    ):
        Rectifier(
            RigCalibration({"left": left, "right": right}, origin="mixed.yaml"),
            RectificationConfig(),
        )


def test_impossible_pairs_are_refused_before_anything_is_built():
    with pytest.raises(CalibrationError, match="the eyes of this rig are swapped"):
        Rectifier(make_rig(T_left_right=inverse(T_LEFT_RIGHT)), RectificationConfig())


def test_two_rigs_of_different_size_live_side_by_side():
    """No state is shared between rectifiers."""
    small = Rectifier(RIGS["radial tangential"], RectificationConfig())
    big_camera = replace(camera(), width=400, height=300)
    big = Rectifier(
        RigCalibration(
            {"left": RigCamera(big_camera), "right": RigCamera(big_camera, T_LEFT_RIGHT)}
        ),
        RectificationConfig(),
    )
    assert big.process(frame(np.zeros((300, 400), np.uint8)), "left").image.shape == (300, 400)
    assert small.process(frame(np.zeros((256, 320), np.uint8)), "left").image.shape == (256, 320)
