"""Rig calibrations on disk: every format read, every number kept, every refusal in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.calibration_files import (
    find_calibration,
    load_calibration,
    save_calibration,
)
from thermal_stereo_vo.core.camera_info import (
    CameraInfoFields,
    calibration_from_pair,
    camera_from_info,
    infos_from_calibration,
)
from thermal_stereo_vo.core.cameras import (
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform, transform_points

LENS = (-0.31, 0.12, 0.0007, -0.0004, 0.01)


def extrinsic_pair(model=DistortionModel.RADIAL_TANGENTIAL, lens=LENS) -> RigCalibration:
    """Two tilted cameras 0.27 m apart, as a calibration tool delivers them: no R and P yet."""
    left = Camera(640, 512, 520.5, 521.25, 318.0, 257.5, model, lens)
    right = replace(left, fx=523.125, cx=322.0)
    T_left_right = make_transform(exp_so3([0.01, -0.02, 0.015]), [0.268, 0.004, -0.006])
    return RigCalibration({"left": RigCamera(left), "right": RigCamera(right, T_left_right)})


def stereo_rectified(calibration: RigCalibration) -> RigCalibration:
    """R and P by OpenCV, independent of the package's rectifier."""
    left, right = calibration["left"].camera, calibration["right"].camera
    T_right_left = inverse(calibration.T_a_b("left", "right"))
    R1, R2, P1, P2 = cv2.stereoRectify(
        left.matrix,
        np.array(left.distortion),
        right.matrix,
        np.array(right.distortion),
        left.size,
        T_right_left[:3, :3],
        T_right_left[:3, 3].reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0.0,
    )[:4]
    return replace(
        calibration,
        cameras={
            "left": replace(calibration["left"], rectification=R1, projection=P1),
            "right": replace(calibration["right"], rectification=R2, projection=P2),
        },
    )


def info(**changes) -> CameraInfoFields:
    fields = {
        "width": 640,
        "height": 512,
        "distortion_model": "plumb_bob",
        "d": LENS,
        "k": (520.0, 0.0, 320.0, 0.0, 521.0, 256.0, 0.0, 0.0, 1.0),
        "p": (500.0, 0.0, 320.0, 0.0, 0.0, 500.0, 256.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        "name": "left_camera",
    }
    return CameraInfoFields(**(fields | changes))


def right_info(baseline_m: float = 0.25, **changes) -> CameraInfoFields:
    p = list(info().p)
    p[3] = -p[0] * baseline_m
    return info(**({"p": tuple(p), "name": "right_camera"} | changes))


def assert_same(a: RigCalibration, b: RigCalibration, atol: float = 0.0) -> None:
    assert list(a.cameras) == list(b.cameras)
    assert a.rectified == b.rectified
    assert (a.T_base_rig is None) == (b.T_base_rig is None)
    if a.T_base_rig is not None:
        assert np.allclose(a.T_base_rig, b.T_base_rig, rtol=0, atol=atol)
    for role in a.cameras:
        assert a[role].camera == b[role].camera
        for name in ("T_rig_camera", "rectification", "projection"):
            x, y = getattr(a[role], name), getattr(b[role], name)
            assert (x is None) == (y is None), name
            if x is not None:
                assert np.allclose(x, y, rtol=0, atol=atol), name


# --- camera_info ------------------------------------------------------------------------------


def test_extrinsics_come_back_from_R_and_P():
    """OpenCV turns extrinsics into R1, R2, P1, P2; we must turn them back."""
    original = stereo_rectified(extrinsic_pair())
    infos = infos_from_calibration(original)
    read = calibration_from_pair(infos["left"], infos["right"])
    assert np.allclose(
        read.T_a_b("left", "right"), original.T_a_b("left", "right"), rtol=0, atol=1e-12
    )
    assert read["left"].camera == original["left"].camera
    assert not read.rectified


def test_rig_frame_is_the_rectified_left_camera():
    """Points in rig axes land on one row of both rectified images, fx*B/z apart."""
    original = stereo_rectified(extrinsic_pair())
    infos = infos_from_calibration(original)
    rig = calibration_from_pair(infos["left"], infos["right"])
    points_rig = np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 9.0], [0.0, 0.0, 2.5]])
    pixels = {}
    for eye in ("left", "right"):
        mounted = rig[eye]
        points_camera = transform_points(inverse(mounted.T_rig_camera), points_rig)
        raw = mounted.camera.project(points_camera)
        pixels[eye] = cv2.undistortPoints(
            raw.reshape(-1, 1, 2),
            mounted.camera.matrix,
            np.array(mounted.camera.distortion),
            R=mounted.rectification,
            P=mounted.projection,
        ).reshape(-1, 2)
    assert np.allclose(pixels["left"][:, 1], pixels["right"][:, 1], atol=0.02)
    P = rig["left"].projection
    expected = P[0, 0] * np.linalg.norm(original["right"].T_rig_camera[:3, 3]) / points_rig[:, 2]
    disparity = pixels["left"][:, 0] - pixels["right"][:, 0]
    assert np.allclose(disparity, expected, atol=0.05)
    along_the_axis = pixels["left"][2]
    assert np.allclose(along_the_axis, [P[0, 2], P[1, 2]], atol=0.02)


def test_images_that_need_nothing_count_as_rectified():
    left = info(d=(0.0,) * 5, k=(500.0, 0.0, 320.0, 0.0, 500.0, 256.0, 0.0, 0.0, 1.0))
    right = right_info(d=(), k=left.k)
    read = calibration_from_pair(left, right)
    assert read.rectified
    assert read.baseline_m == pytest.approx(0.25, abs=1e-15)
    assert read["left"].camera == Camera(640, 512, 500.0, 500.0, 320.0, 256.0)


def test_rectified_images_obey_P_not_K():
    read = calibration_from_pair(info(), right_info(), rectified=True)
    assert read.rectified
    assert read["left"].camera.fx == 500.0
    assert not read["left"].camera.has_distortion


def test_rotation_without_distortion_is_not_rectified():
    """R differs from identity though D is zero: skipping rectification would be wrong."""
    r = tuple(exp_so3([0.0, 0.02, 0.0]).ravel())
    k = (500.0, 0.0, 320.0, 0.0, 500.0, 256.0, 0.0, 0.0, 1.0)
    read = calibration_from_pair(info(d=(), k=k, r=r), right_info(d=(), k=k, r=r))
    assert not read.rectified


def test_rectified_pair_survives_camera_info():
    k = (500.0, 0.0, 320.0, 0.0, 500.0, 256.0, 0.0, 0.0, 1.0)
    original = calibration_from_pair(info(d=(), k=k), right_info(d=(), k=k))
    infos = infos_from_calibration(original)
    assert infos["right"].p[3] == pytest.approx(-500.0 * 0.25)
    assert_same(calibration_from_pair(infos["left"], infos["right"]), original, atol=1e-15)


def test_short_lens_is_padded_to_the_five_of_plumb_bob():
    lens = LENS[:4]
    fields = infos_from_calibration(stereo_rectified(extrinsic_pair(lens=lens)))["left"]
    assert fields.distortion_model == "plumb_bob"
    assert fields.d == (*lens, 0.0)


@pytest.mark.parametrize(
    ("lens", "model", "name"),
    [
        (LENS, DistortionModel.RADIAL_TANGENTIAL, "plumb_bob"),
        ((*LENS, 0.1, 0.02, 0.003), DistortionModel.RADIAL_TANGENTIAL, "rational_polynomial"),
        ((0.01, -0.02, 0.003, -0.004), DistortionModel.EQUIDISTANT, "equidistant"),
    ],
)
def test_lens_models_keep_their_ros_names(lens, model, name):
    rig = RigCalibration(
        {"thermal": RigCamera(Camera(640, 512, 500.0, 501.0, 320.0, 256.0, model, lens))}
    )
    fields = infos_from_calibration(rig)["thermal"]
    assert fields.distortion_model == name
    assert camera_from_info(fields) == rig["thermal"].camera


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"k": (0.0,) * 9}, r"'left_camera' says that the camera is not calibrated \(K\[0\] = 0\)"),
        ({"p": (1.0,) * 11}, "P has 11 numbers instead of 12"),
        ({"p": (0.0,) * 12}, "has no projection matrix P: calibrate the two cameras as a stereo"),
        ({"distortion_model": "kannala"}, "distortion model 'kannala': known are plumb_bob"),
        ({"d": (0.1, 0.2, 0.3)}, "has 3 coefficients for 'plumb_bob'"),
        ({"distortion_model": "equidistant"}, "equidistant model has 4 coefficients, got 5"),
        ({"r": (1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0)}, "is no rotation"),
    ],
)
def test_a_broken_camera_info_is_refused(changes, text):
    with pytest.raises(CalibrationError, match=text):
        calibration_from_pair(info(**changes), right_info())


def test_unrectified_pair_without_R_and_P_has_no_camera_info():
    with pytest.raises(CalibrationError, match="no rectification for the left camera"):
        infos_from_calibration(extrinsic_pair())


# --- files of our own ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "rig.yaml"])
def test_saved_rig_comes_back_exactly(tmp_path, name):
    original = replace(stereo_rectified(extrinsic_pair()), T_base_rig=default_T_base_rig())
    save_calibration(original, tmp_path)
    assert_same(load_calibration(tmp_path / name), original)


@pytest.mark.parametrize("name", ["left.yaml", "right.yaml"])
def test_either_file_of_the_pair_finds_the_other(tmp_path, name):
    original = stereo_rectified(extrinsic_pair())
    save_calibration(original, tmp_path)
    read = load_calibration(tmp_path / name)
    assert np.allclose(
        read.T_a_b("left", "right"), original.T_a_b("left", "right"), rtol=0, atol=1e-12
    )
    assert np.array_equal(read["right"].projection, original["right"].projection)


def test_folder_of_the_ros_calibrator_is_read(tmp_path):
    """Only left.yaml and right.yaml, as camera_calibration leaves them."""
    save_calibration(stereo_rectified(extrinsic_pair()), tmp_path)
    (tmp_path / "rig.yaml").unlink()
    assert find_calibration(tmp_path) == tmp_path / "left.yaml"
    document = yaml.safe_load((tmp_path / "left.yaml").read_text())
    assert document["camera_matrix"]["rows"] == 3
    assert document["projection_matrix"]["cols"] == 4
    assert load_calibration(tmp_path).baseline_m == pytest.approx(0.2681, abs=1e-4)


def test_visible_thermal_rig_needs_no_stereo_pair(tmp_path):
    visible = Camera(1280, 960, 900.0, 900.0, 640.0, 480.0)
    thermal = Camera(640, 512, 520.0, 520.0, 320.0, 256.0, DistortionModel.EQUIDISTANT, (0.1,) * 4)
    original = RigCalibration(
        {
            "visible": RigCamera(visible),
            "thermal": RigCamera(thermal, make_transform(exp_so3([0.1, 0, 0]), [0.02, 0.05, 0])),
        }
    )
    save_calibration(original, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml"]
    assert_same(load_calibration(tmp_path), original)


@given(
    fx=st.floats(1.0, 5000.0),
    x=st.floats(1e-3, 2.0),
    phi=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
)
def test_every_number_survives_the_rig_file(tmp_path_factory, fx, x, phi):
    folder = tmp_path_factory.mktemp("rig")
    camera = Camera(640, 512, fx, fx * 1.0001, 320.1, 255.9)
    original = RigCalibration(
        {
            "left": RigCamera(camera),
            "right": RigCamera(camera, make_transform(exp_so3(phi), [x, 0.1 * x, 0.0])),
        }
    )
    save_calibration(original, folder)
    assert_same(load_calibration(folder), original)


def test_failed_save_leaves_nothing_half_written(tmp_path):
    original = stereo_rectified(extrinsic_pair())
    (tmp_path / "right.yaml").mkdir()
    (tmp_path / "right.yaml" / "in_the_way").touch()
    with pytest.raises(OSError, match="right"):
        save_calibration(original, tmp_path)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda d: d.update(camera={}), "unknown key 'camera': did you mean 'cameras'"),
        (lambda d: d["cameras"]["left"].update(fov=3), "unknown key 'cameras.left.fov'"),
        (lambda d: d["cameras"]["left"].pop("fx"), "camera 'left' is incomplete: KeyError"),
        (lambda d: d["cameras"]["left"].update(model="brown"), "distortion model 'brown'"),
        (lambda d: d["cameras"]["left"].update(fx=-1.0), "camera 'left': focal lengths"),
        (lambda d: d["cameras"].update(left=3), "camera 'left' must hold keys and values"),
        (lambda d: d.update(cameras={}), "names no cameras"),
        (
            lambda d: d["cameras"]["right"]["T_rig_camera"][0].__setitem__(0, 2.0),
            "cameras.right.T_rig_camera is no rigid motion",
        ),
        (lambda d: d["cameras"]["right"].update(T_rig_camera=[1]), "must be 4 rows of 4 numbers"),
        (lambda d: d["cameras"]["right"].update(projection="x"), "must be 3 rows of 4 numbers"),
    ],
)
def test_a_broken_rig_file_says_where(tmp_path, edit, text):
    save_calibration(extrinsic_pair(), tmp_path)
    path = tmp_path / "rig.yaml"
    document = yaml.safe_load(path.read_text())
    edit(document)
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(CalibrationError, match=text) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"there is no calibration file .*nowhere\.yaml"):
        load_calibration(tmp_path / "nowhere.yaml")
    with pytest.raises(
        CalibrationError, match=r"no calibration in .*: looked for rig\.yaml, left\.yaml, calib_cam"
    ):
        load_calibration(tmp_path)


def test_a_lonely_eye_is_refused(tmp_path):
    save_calibration(stereo_rectified(extrinsic_pair()), tmp_path)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"right camera of .* looked for right\.yaml beside"):
        load_calibration(tmp_path / "left.yaml")
    (tmp_path / "left.yaml").rename(tmp_path / "ost.yaml")
    with pytest.raises(CalibrationError, match=r"name the pair left\.yaml and right\.yaml"):
        load_calibration(tmp_path / "ost.yaml")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: [", "is not valid YAML"),
        ("- 1\n- 2\n", "must hold keys and values"),
        ("a: 1\n", "neither 'cameras' .* nor 'camera_matrix'"),
        ("camera_matrix: 3\n", "is no complete camera_info file"),
    ],
)
def test_other_yaml_is_no_calibration(tmp_path, text, complaint):
    for eye in ("left", "right"):
        (tmp_path / f"{eye}.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=complaint):
        load_calibration(tmp_path / "left.yaml")


@pytest.mark.parametrize(
    ("x_m", "text"),
    [(0.0, "baseline of .* is 0.000 mm"), (-0.2, "are swapped: the right camera lies 0.200 m")],
)
def test_impossible_pairs_are_refused_on_loading(tmp_path, x_m, text):
    camera = Camera(640, 512, 500.0, 500.0, 320.0, 256.0)
    rig = RigCalibration(
        {
            "left": RigCamera(camera),
            "right": RigCamera(camera, make_transform(np.eye(3), [x_m, 0, 0])),
        },
        rectified=True,
    )
    save_calibration(rig, tmp_path)
    for name in ("rig.yaml", "left.yaml"):
        with pytest.raises(CalibrationError, match=text):
            load_calibration(tmp_path / name)


# --- KITTI and EuRoC ------------------------------------------------------------------------------

P_LEFT = "707.0 0 601.0 0 0 707.0 183.0 0 0 0 1 0"
P_RIGHT = "707.0 0 601.0 -379.659 0 707.0 183.0 0 0 0 1 0"
P_COLOUR_LEFT = "707.0 0 601.0 46.8 0 707.0 183.0 0.11 0 0 1 0.003"
P_COLOUR_RIGHT = "707.0 0 601.0 -333.2 0 707.0 183.0 2.2 0 0 1 0.004"


@pytest.mark.parametrize(
    "text",
    [
        f"{P_LEFT}\n{P_RIGHT}",
        f"P0: {P_LEFT}\nP1: {P_RIGHT}\nP2: {P_COLOUR_LEFT}\nP3: {P_COLOUR_RIGHT}\nTr: 1 2 3\n",
    ],
)
def test_kitti_odometry_grey_pair(tmp_path, text):
    (tmp_path / "calib.txt").write_text(text)
    read = load_calibration(tmp_path, (1226, 370))
    assert read.rectified
    assert read.baseline_m == pytest.approx(0.537, abs=1e-12)
    assert read["right"].camera == Camera(1226, 370, 707.0, 707.0, 601.0, 183.0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (P_LEFT, "has 1 rows of 12 numbers instead of 2"),
        (f"P0: {P_LEFT}\n", "no projection matrix 'P1' of 12 numbers .it has: P0."),
        ("", "no projection matrix 'P0' .*nothing that looks like one"),
        (f"{P_RIGHT}\n{P_LEFT}", "swapped"),
    ],
)
def test_broken_kitti_files(tmp_path, text, complaint):
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(CalibrationError, match=complaint):
        load_calibration(tmp_path, (1226, 370))


def test_kitti_odometry_needs_the_size_of_the_images(tmp_path):
    (tmp_path / "calib.txt").write_text(f"{P_LEFT}\n{P_RIGHT}")
    with pytest.raises(CalibrationError, match="does not say how large the images are"):
        load_calibration(tmp_path)


def test_kitti_raw_takes_rectified_matrices_and_sizes(tmp_path):
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        "S_00: 1392 512\nK_00: 984 0 690 0 980 233 0 0 1\n"
        f"S_rect_00: 1.242000e+03 3.750000e+02\nP_rect_00: {P_LEFT}\n"
        f"S_rect_01: 1.242000e+03 3.750000e+02\nP_rect_01: {P_RIGHT}\n"
    )
    read = load_calibration(tmp_path)
    assert read.rectified
    assert read["left"].camera.size == (1242, 375)
    assert read["left"].camera.fx == 707.0
    path.write_text(path.read_text().replace("S_rect_01", "S_rest_01"))
    with pytest.raises(CalibrationError, match="no image size 'S_rect_01'"):
        load_calibration(path)


def write_euroc(folder: Path, eye: str, T_body_camera: np.ndarray, **changes) -> None:
    document = {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": T_body_camera.ravel().tolist()},
        "resolution": [752, 480],
        "intrinsics": [458.0, 457.0, 367.0, 248.0],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [-0.28, 0.07, 0.0002, 0.00002],
    } | changes
    (folder / eye).mkdir(parents=True)
    (folder / eye / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(document))


def test_euroc_extrinsics_chain_through_the_body(tmp_path):
    T_body_left = make_transform(exp_so3([0.1, -1.5, 0.3]), [0.02, -0.06, 0.01])
    T_left_right = make_transform(exp_so3([0.001, 0.002, -0.014]), [0.11, -0.0002, 0.0009])
    write_euroc(tmp_path / "mav0", "cam0", T_body_left)
    write_euroc(
        tmp_path / "mav0",
        "cam1",
        T_body_left @ T_left_right,
        distortion_model="equidistant",
    )
    read = load_calibration(tmp_path)
    assert not read.rectified
    assert np.allclose(read.T_a_b("left", "right"), T_left_right, atol=1e-12)
    assert np.array_equal(read["left"].T_rig_camera, np.eye(4))
    assert read["left"].camera.distortion == (-0.28, 0.07, 0.0002, 0.00002)
    assert read["right"].camera.model is DistortionModel.EQUIDISTANT


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"distortion_model": "fov"}, "distortion model 'fov': known are radial-tangential"),
        ({"resolution": "big"}, "no EuRoC camera file: .*malformed"),
        ({"T_BS": {"data": [1, 2, 3]}}, "no EuRoC camera file"),
    ],
)
def test_broken_euroc_files(tmp_path, changes, text):
    write_euroc(tmp_path, "cam0", np.eye(4), **changes)
    write_euroc(tmp_path, "cam1", np.eye(4))
    with pytest.raises(CalibrationError, match=text):
        load_calibration(tmp_path)


def test_real_recordings(recording):
    kitti = load_calibration(recording("kitti_residential"), (1226, 370))
    assert kitti.baseline_m == pytest.approx(0.5372, abs=1e-4)
    raw = load_calibration(recording("kitti_raw_0001"))
    assert raw.baseline_m == pytest.approx(0.5372, abs=1e-4)
    euroc = load_calibration(recording("euroc_standing_still"))
    assert euroc.baseline_m == pytest.approx(0.1101, abs=1e-4)
    assert euroc["left"].camera.size == (752, 480)
