"""Camera models against OpenCV and against themselves; rigs that no stereo method can use."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.cameras import (
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, make_transform

RADTAN = (-0.285, 0.09, 0.0006, -0.0004, 0.01)
KANNALA = (-0.013, 0.02, -0.012, 0.003)
PINHOLE = Camera(640, 512, 522.0, 524.0, 321.5, 254.0)
LENSES = {
    "none": PINHOLE,
    "radial tangential": Camera(
        640, 512, 522.0, 524.0, 321.5, 254.0, DistortionModel.RADIAL_TANGENTIAL, RADTAN
    ),
    "equidistant": Camera(
        640, 512, 322.0, 324.0, 321.5, 254.0, DistortionModel.EQUIDISTANT, KANNALA
    ),
    "equidistant without coefficients": Camera(
        640, 512, 322.0, 324.0, 321.5, 254.0, DistortionModel.EQUIDISTANT, (0.0,) * 4
    ),
}
each_lens = pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)


def reference_projection(camera: Camera, points):
    """The textbook formulas, written out once more."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if camera.model is DistortionModel.RADIAL_TANGENTIAL:
        k1, k2, p1, p2, k3 = camera.distortion
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    elif camera.model is DistortionModel.EQUIDISTANT:
        k1, k2, k3, k4 = camera.distortion
        r = np.hypot(x, y)
        theta = np.arctan(r)
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        x, y = x * scale, y * scale
    return np.column_stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy])


@each_lens
def test_projection_is_the_textbook_one(camera, rng):
    points = np.column_stack([rng.uniform(-4, 4, (200, 2)), rng.uniform(6, 60, 200)])
    np.testing.assert_allclose(
        camera.project(points), reference_projection(camera, points), atol=1e-8
    )


@each_lens
@given(seed=st.integers(0, 2**32 - 1))
def test_unproject_undoes_project(camera, seed):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (639, 511), (20, 2))
    rays = camera.unproject(pixels)
    assert rays.shape == (20, 3)
    np.testing.assert_array_equal(rays[:, 2], 1.0)
    np.testing.assert_allclose(
        camera.project(rays * rng.uniform(0.5, 90, (20, 1))), pixels, atol=1e-5
    )


@each_lens
def test_the_axis_meets_the_principal_point(camera):
    np.testing.assert_allclose(camera.project(np.array([[0.0, 0.0, 3.0]])), [[321.5, 254.0]])
    np.testing.assert_allclose(
        camera.unproject(np.array([[321.5, 254.0]])), [[0.0, 0.0, 1.0]], atol=1e-9
    )


def test_x_is_right_and_y_is_down():
    u, v = PINHOLE.project(np.array([[1.0, 2.0, 10.0]]))[0]
    assert u == pytest.approx(321.5 + 52.2)
    assert v == pytest.approx(254.0 + 104.8)


@each_lens
def test_what_is_not_in_front_is_nan(camera):
    pixels = camera.project(np.array([[0, 0, 1.0], [0, 0, 0.0], [1.0, 1.0, -5.0]]))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    assert np.isnan(camera.project(np.array([[0, 0, -1.0]]))).all()


def test_an_equidistant_lens_bends_rays_even_without_coefficients():
    """r = f theta, not f tan(theta): at 45 degrees the difference is a fifth."""
    camera = LENSES["equidistant without coefficients"]
    pixel = camera.project(np.array([[1.0, 0.0, 1.0]]))[0]
    assert pixel[0] - camera.cx == pytest.approx(322.0 * np.pi / 4)
    assert camera.has_distortion


def test_has_distortion():
    assert LENSES["radial tangential"].has_distortion
    assert LENSES["equidistant"].has_distortion
    assert not PINHOLE.has_distortion
    flat = Camera(
        640, 512, 522.0, 524.0, 321.5, 254.0, DistortionModel.RADIAL_TANGENTIAL, (0.0,) * 5
    )
    assert not flat.has_distortion
    assert not LENSES["equidistant"].without_distortion().has_distortion
    assert LENSES["equidistant"].without_distortion().matrix[0, 2] == 321.5


@pytest.mark.parametrize("lens", ["radial tangential", "equidistant"])
def test_projection_agrees_with_opencv(lens, rng):
    camera = LENSES[lens]
    points = np.column_stack([rng.uniform(-3, 3, (50, 2)), rng.uniform(5, 9, 50)])
    project = cv2.fisheye.projectPoints if lens == "equidistant" else cv2.projectPoints
    expected = project(
        points.reshape(-1, 1, 3),
        np.zeros(3),
        np.zeros(3),
        camera.matrix,
        np.array(camera.distortion),
    )[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, r"focal lengths \(0.0, 5.0\) px must be positive and every parameter finite: "
         "calibrate the camera first"),
        ({"fy": -1.0}, "must be positive"),
        ({"cx": np.nan}, "every parameter finite"),
        ({"fx": np.inf}, "every parameter finite"),
        ({"model": DistortionModel.RADIAL_TANGENTIAL, "distortion": (np.nan,) * 4}, "finite"),
        ({"width": 0}, "image size 0x4 must be positive"),
        ({"height": -3}, "image size 4x-3 must be positive"),
        ({"model": DistortionModel.EQUIDISTANT, "distortion": (0.1, 0.2)},
         "the equidistant model has 4 coefficients, got 2"),
    ],
)  # fmt: skip
def test_impossible_cameras_are_refused(change, message):
    parameters = {"width": 4, "height": 4, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 2.0} | change
    with pytest.raises(CalibrationError, match=message):
        Camera(**parameters)


def rig(T_left_right, right: Camera = PINHOLE) -> RigCalibration:
    return RigCalibration(
        {"left": RigCamera(PINHOLE), "right": RigCamera(right, T_left_right)}, origin="rig.yaml"
    )


def beside(x, y=0.0, z=0.0):
    return make_transform(np.eye(3), [x, y, z])


def test_a_usable_pair_passes():
    rig(beside(0.268, 0.01, -0.02)).check_stereo()
    assert rig(beside(0.268)).baseline_m == pytest.approx(0.268)
    assert rig(beside(-0.1)).baseline_m == pytest.approx(-0.1)


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        (rig(beside(0.00005)), r"the baseline of rig.yaml is 0.050 mm: a stereo pair needs two "
         r"cameras apart from each other; check the translation \(ROS: right P\[3\] = -fx\*B\)"),
        (rig(np.eye(4)), "is 0.000 mm"),
        (rig(beside(-0.268)), "the eyes of rig.yaml are swapped: the right camera lies 0.268 m "
         "to the LEFT of the left one; exchange the left and right images or calibrations"),
        (rig(beside(0.05, 0.2)), r"the cameras of rig.yaml are not side by side \(right eye at .* "
         r"m from the left\): turn the rig or its calibration so that the baseline is along x"),
        (rig(beside(0.0, 0.0, 0.3)), "not side by side"),
        (rig(beside(0.268), Camera(320, 256, 260.0, 260.0, 160.0, 128.0)),
         "left is 640x512 and right 320x256 pixels in rig.yaml: both eyes must have the same size"),
    ],
    ids=["tiny", "zero", "swapped", "above", "behind", "size"],
)  # fmt: skip
def test_pairs_no_method_can_work_with_are_refused(calibration, message):
    with pytest.raises(CalibrationError, match=message):
        calibration.check_stereo()


def test_a_missing_role_names_those_that_are_there():
    calibration = RigCalibration({"visible": RigCamera(PINHOLE)}, origin="rig.yaml")
    with pytest.raises(
        CalibrationError, match=r"the calibration rig.yaml has no camera 'left' \(it has: visible\)"
    ):
        calibration.check_stereo()
    with pytest.raises(CalibrationError, match=r"\(it has: none\)"):
        RigCalibration({})["left"]


def test_relative_poses_of_cameras(rng):
    T_rig_left, T_rig_right = exp_se3(rng.normal(size=6)), exp_se3(rng.normal(size=6))
    calibration = RigCalibration(
        {"left": RigCamera(PINHOLE, T_rig_left), "right": RigCamera(PINHOLE, T_rig_right)}
    )
    point_right = np.array([0.3, -0.2, 4.0, 1.0])
    in_rig = T_rig_right @ point_right
    np.testing.assert_allclose(
        T_rig_left @ (calibration.T_a_b("left", "right") @ point_right), in_rig, atol=1e-12
    )


def test_baseline_is_measured_in_the_axes_of_the_left_eye():
    """A rig frame that is turned against the camera must not swap the eyes."""
    half_turn = make_transform(exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
    turned = RigCalibration(
        {
            "left": RigCamera(PINHOLE, half_turn),
            "right": RigCamera(PINHOLE, half_turn @ beside(0.2)),
        }
    )
    turned.check_stereo()
    assert turned.baseline_m == pytest.approx(0.2)


def test_default_mount_looks_forward():
    """REP-103: what is ahead (optical z) is body x, right is -y, down is -z."""
    T_base_rig = default_T_base_rig()
    np.testing.assert_allclose(T_base_rig @ [0, 0, 1, 1], [1, 0, 0, 1])
    np.testing.assert_allclose(T_base_rig @ [1, 0, 0, 1], [0, -1, 0, 1])
    np.testing.assert_allclose(T_base_rig @ [0, 1, 0, 1], [0, 0, -1, 1])
    assert np.linalg.det(T_base_rig[:3, :3]) == pytest.approx(1.0)
