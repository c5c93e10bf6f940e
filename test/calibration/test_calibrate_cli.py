"""``calibrate`` from pictures to files, as a person calls it."""

import json
import shutil

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.calibration_files import load_calibration, save_calibration
from thermal_stereo_vo.core.calibration_yaml import parse_camera_info, read_text
from thermal_stereo_vo.core.cameras import RigCalibration, RigCamera
from thermal_stereo_vo.core.frames import RadiometricFrame
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform
from thermal_stereo_vo.nodes.calibration_urls import read_calibrations
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier
from thermal_stereo_vo.stereo_capture import StereoCaptureConfig

BOARD = "chessboard:7x5:0.04"
T_RIGHT_LEFT = make_transform(exp_so3([-0.014, -0.012, 0.004]), [-0.06, 0.0004, 0.0006])


@pytest.fixture(scope="module")
def pictures(stage, poses_over_the_picture, tmp_path_factory):
    """Ten pairs of pictures; both eyes have the same lens."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(3)
    target = parse_target(BOARD)
    for eye in ("left", "right"):
        (folder / eye).mkdir()
    for k, T in enumerate(poses_over_the_picture(target, 10, 0.55, rng)):
        for eye, T_eye_board in (("left", T), ("right", T_RIGHT_LEFT @ T)):
            image = stage.picture(target, T_eye_board, rng)
            cv2.imwrite(str(folder / eye / f"{k:02d}.png"), image)
    return folder


@pytest.fixture(scope="module")
def calibrated(pictures, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "rig"
    code = main(
        ["calibrate", "stereo", str(pictures), "--board", BOARD, "--output", str(output),
         "--baseline", "0.06", "--quiet"]
    )  # fmt: skip
    assert code == 0
    return output


def test_the_rig_comes_out_as_it_was(calibrated, stage):
    calibration = load_calibration(calibrated)
    assert calibration["left"].camera.fx == pytest.approx(stage.camera.fx, rel=3e-3)
    T = inverse(calibration.T_a_b("left", "right"))
    np.testing.assert_allclose(T, T_RIGHT_LEFT, atol=1.5e-3)
    report = json.loads((calibrated / "report.json").read_text())
    assert report["pair"]["baseline_m"] == pytest.approx(0.06, abs=2e-4)
    assert 0.005 < report["cameras"]["left"]["training"]["mean_px"] < 0.15
    assert report["pair"]["held_out"]["epipolar_12_px"] < 0.2
    assert len(report["views"]) == 10


def test_files_are_what_ros_and_the_rectifier_read(calibrated, pictures):
    info = parse_camera_info(read_text(calibrated / "right.yaml"), calibrated / "right.yaml")
    assert info.distortion_model == "plumb_bob"
    assert info.p[3] == pytest.approx(-info.p[0] * 0.06, rel=5e-3)
    urls = [f"file://{calibrated}/{eye}.yaml" for eye in ("left", "right")]
    told = read_calibrations(StereoCaptureConfig("recording", 4, *urls))
    assert told["right"].p == info.p
    by_pair = load_calibration(calibrated / "left.yaml")
    rectifier = Rectifier(by_pair, RectificationConfig())
    rows = {}
    for eye in ("left", "right"):
        image = cv2.imread(str(pictures / eye / "04.png"), cv2.IMREAD_UNCHANGED)
        view = rectifier.process(RadiometricFrame(image, 0, eye), eye)
        from thermal_stereo_vo.calibration.detection import detect

        board = detect(view.image, parse_target(BOARD)).view
        rows[eye] = dict(zip(board.ids.tolist(), board.pixels[:, 1], strict=True))
    common = sorted(set(rows["left"]) & set(rows["right"]))
    assert len(common) > 25
    difference = np.array([rows["left"][k] - rows["right"][k] for k in common])
    assert np.abs(difference).mean() < 0.15


def test_the_page_holds_everything(calibrated):
    page = (calibrated / "report.html").read_text()
    for heading in (
        "P1 Table I", "P1 Table II", "P1 Table III", "Coverage", "Residuals", "Rectified pair",
        "Views",
    ):  # fmt: skip
        assert heading in page
    assert page.count("data:image/png;base64,") == 4
    assert len(list((calibrated / "overlays").glob("*.jpg"))) == 20


def test_compare_tells_a_transposed_rotation(calibrated, pictures, tmp_path, capsys):
    """A file with R the wrong way round stands beside the right one, and is called by its name."""
    good = load_calibration(calibrated / "rig.yaml")
    T = inverse(good.T_a_b("left", "right"))
    wrong = make_transform(T[:3, :3].T, T[:3, 3])
    cameras = {
        "left": RigCamera(good["left"].camera),
        "right": RigCamera(good["right"].camera, inverse(wrong)),
    }
    save_calibration(RigCalibration(cameras), tmp_path / "wrong")
    views = [str(pictures), "--board", BOARD, "--max-images", "5"]
    assert main(["calibrate", "verify", str(calibrated), *views]) == 0
    assert "explains the views" in capsys.readouterr().out
    code = main(["calibrate", "verify", str(tmp_path / "wrong"), *views])
    assert code == 2
    assert "rotation transposed" in capsys.readouterr().err
    output = tmp_path / "again"
    code = main(
        ["calibrate", "stereo", *views, "--output", str(output),
         "--compare", str(tmp_path / "wrong")]
    )  # fmt: skip
    out = capsys.readouterr().out
    assert code == 0
    assert "rotation transposed" in out
    assert "Error 1-2 [px]" in out


def test_one_camera(pictures, stage, tmp_path, capsys):
    output = tmp_path / "mono"
    code = main(
        ["calibrate", "mono", str(pictures / "left"), "--board", BOARD, "--output", str(output)]
    )
    assert code == 0
    assert "board found in 10 of 10 images" in capsys.readouterr().out
    camera = load_calibration(output)["camera"].camera
    assert camera.fx == pytest.approx(stage.camera.fx, rel=4e-3)
    info = parse_camera_info(read_text(output / "camera.yaml"), output / "camera.yaml")
    assert info.k[0] == camera.fx


@pytest.mark.parametrize(
    ("count", "board", "more", "says"),
    [
        (3, BOARD, [], "only 3 views of the board usable"),
        (1, "chessboard:9x6:0.04", [], "0 of 1 images of the left camera show the board"),
        (1, "chess:7x5", [], "is not a board"),
        (6, BOARD, ["--baseline", "0.08"], "measure the board and correct --board"),
    ],
)
def test_bad_input_ends_in_a_sentence_and_leaves_nothing(
    pictures, tmp_path, capsys, count, board, more, says
):
    for eye in ("left", "right"):
        (tmp_path / "few" / eye).mkdir(parents=True)
        for k in range(count):
            shutil.copy(pictures / eye / f"{k:02d}.png", tmp_path / "few" / eye)
    output = tmp_path / "out"
    code = main(
        ["calibrate", "stereo", str(tmp_path / "few"), "--board", board, "--output", str(output),
         *more]
    )  # fmt: skip
    error = capsys.readouterr().err
    assert code == 2
    assert says in error
    assert error.count("\n") == 1
    assert not output.exists()


def test_exchanged_eyes(pictures, tmp_path, capsys):
    code = main(
        ["calibrate", "stereo", str(pictures / "right"), str(pictures / "left"), "--board", BOARD,
         "--output", str(tmp_path / "out"), "--quiet", "--max-images", "6"]
    )  # fmt: skip
    assert code == 2
    assert "the eyes are swapped" in capsys.readouterr().err


def test_a_loop_of_reports(calibrated, capsys):
    code = main(["calibrate", "loop", str(calibrated), str(calibrated), str(calibrated)])
    assert code == 2
    assert "and not back" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["stereo", "mono", "verify", "loop", "flat-field"])
def test_help(kind, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", kind, "--help"])
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out
