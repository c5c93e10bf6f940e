"""Boards seen by real cameras; bounds hold with OpenCV 4.6 and 5."""

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.calibration.gathering import gather
from thermal_stereo_vo.calibration.geometric import calibrate
from thermal_stereo_vo.calibration.image_sources import Source, image_shots
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.calibration.views import BoardShot
from thermal_stereo_vo.datasets.image_files import read_grey


def gathered(paths, roles, board, keep=None):
    shots = image_shots(Source(tuple(map(str, paths))), roles)
    if keep is not None:
        shots = [shot for shot in shots if any(key in shot.name for key in keep)]
    return gather(shots, parse_target(board), roles)


@pytest.fixture(scope="module")
def opencv_example(recording):
    folder = recording("visible_stereo_chessboard")
    roles = ("left", "right")
    found = gathered([folder / "left*.jpg", folder / "right*.jpg"], roles, "chessboard:9x6:0.025")
    return folder, found, calibrate(found.shots, parse_target("chessboard:9x6:0.025"), found.sizes)


def opencv_stereo(folder):
    """OpenCV's own way: its detector, its corners and its estimator."""
    points, corners = parse_target("chessboard:9x6:0.025").points_m.astype(np.float32), []
    for eye in ("left", "right"):
        found = []
        for path in sorted(folder.glob(f"{eye}??.jpg")):
            image = read_grey(path)
            _, rough = cv2.findChessboardCorners(image, (9, 6))
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            # Half a window of 11 px, as in OpenCV's example, runs into the next corner.
            found.append(cv2.cornerSubPix(image, rough, (5, 5), (-1, -1), criteria))
        corners.append(found)
    size, points = (640, 480), [points] * len(corners[0])
    lenses = []
    for found in corners:
        flags = cv2.CALIB_FIX_K3
        lenses += cv2.calibrateCamera(points, found, size, None, None, flags=flags)[1:3]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    rms, *_, T, _, _ = cv2.stereoCalibrate(points, *corners, *lenses, size, flags=flags)
    return rms, np.linalg.norm(T), corners


def test_opencv_example_against_its_reference(opencv_example):
    folder, found, result = opencv_example
    assert (found.found("left"), found.found("right")) == (13, 13)
    rms, baseline_m, _ = opencv_stereo(folder)
    assert 0.10 < result.stereo_rms_px < min(rms, 0.24)
    assert result.pair.baseline_m == pytest.approx(baseline_m, rel=3e-3)
    # intrinsics.yml of the recording holds one focal length for both eyes.
    storage = cv2.FileStorage(str(folder / "intrinsics.yml"), cv2.FILE_STORAGE_READ)
    reference = storage.getNode("M1").mat()[0, 0]
    storage.release()
    both = np.mean([camera.camera.fx for camera in result.cameras.values()])
    assert both == pytest.approx(reference, rel=3e-3)
    assert 0.03 < result.pair.held_out.epipolar_12_px < 0.15


def test_same_corners_same_answer_as_opencv(opencv_example):
    """Our estimator on OpenCV's corners: the same RMS and rig; the gain is in the corners."""
    folder, found, _ = opencv_example
    rms, baseline_m, corners = opencv_stereo(folder)
    shots = []
    for k, shot in enumerate(found.shots):
        views = {}
        for role, of_eye in zip(("left", "right"), corners, strict=True):
            view, pixels = shot.views[role], of_eye[k].reshape(-1, 2).astype(np.float64)
            if np.linalg.norm(pixels - view.pixels, axis=1).mean() > 5.0:
                pixels = pixels[::-1].copy()  # numbered from the other end
            views[role] = type(view)(np.arange(54), pixels, np.full(54, 0.05))
        shots.append(BoardShot(shot.name, views))
    result = calibrate(shots, parse_target("chessboard:9x6:0.025"), found.sizes)
    assert result.stereo_rms_px == pytest.approx(rms, abs=0.01)
    assert result.pair.baseline_m == pytest.approx(baseline_m, rel=1e-3)


def test_mask_board(recording):
    board = parse_target("mask:6x4:0.04")
    found = gathered([recording("mask_board")], ("camera",), "mask:6x4:0.04")
    assert found.found("camera") >= 18
    for shot in found.shots:
        # The person held it upright: the first hole is at the upper left in every view.
        view = shot.views["camera"]
        where = dict(zip(view.ids.tolist(), view.pixels, strict=True))
        if 0 in where and 11 in where:
            assert where[11][0] > where[0][0] + 100
        column = [where[k] for k in (0, 84) if k in where]
        if len(column) == 2:
            assert column[1][1] > column[0][1] + 50
    result = calibrate(found.shots, board, found.sizes)
    assert 0.1 < result.cameras["camera"].training.mean_px < 0.4


def test_lamp_heated_board_in_two_thermal_cameras(recording):
    folder = recording("thermal_stereo_chessboard")
    found = gathered(
        [folder / "thermal_b", folder / "thermal_a"], ("left", "right"), "chessboard:9x6:0.03"
    )
    assert found.found("left") >= 7
    assert found.found("right") >= 7
    result = calibrate(found.shots, parse_target("chessboard:9x6:0.03"), found.sizes)
    assert 0.1 < result.stereo_rms_px < 0.35
    assert result.pair.held_out.epipolar_12_px < 0.3
    # What plain OpenCV finds in the same counts shifted to 8 bit.
    plain = 0
    for path in sorted((folder / "thermal_a").glob("*.png")):
        shifted = (read_grey(path) >> 8).astype(np.uint8)
        plain += bool(cv2.findChessboardCorners(shifted, (9, 6))[0])
    assert plain <= 2


def test_board_in_both_bands(recording):
    """Six of the triplets, the ones that plain detectors miss among them."""
    folder = recording("visible_thermal_chessboard")
    keep = ("13_29_09", "13_29_30", "14_34_27", "14_35_45", "13_28_48", "13_55_49")
    roles = ("left", "right", "thermal")
    shots = image_shots(Source(tuple(str(folder / role) for role in roles)), roles)
    shots = [shot for shot in shots if any(key in shot.name for key in keep)]
    assert len(shots) == 6
    found = gather(shots, parse_target("chessboard:7x6:0.05"), roles)
    assert found.found("thermal") == 6
    assert sum(len(shot.views) == 3 for shot in found.shots) >= 5
