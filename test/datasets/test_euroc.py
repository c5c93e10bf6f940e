"""EuRoC folders: stamps by list or name, truth moved from the sensor to the left camera."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.transforms import (
    exp_so3,
    inverse,
    make_transform,
    quat_xyzw_from_rotation,
)
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset

STAMPS = (1403715273262142976, 1403715273312143104, 1403715273362142976)
T_BODY_LEFT = make_transform(exp_so3([0.2, -1.4, 0.4]), [0.02, -0.06, 0.01])
T_LEFT_RIGHT = make_transform(exp_so3([0.0, 0.01, 0.0]), [0.11, 0.0, 0.0])


@pytest.fixture
def euroc(tmp_path, save_images):
    root = tmp_path / "MH_01" / "mav0"
    mounts = {"cam0": T_BODY_LEFT, "cam1": T_BODY_LEFT @ T_LEFT_RIGHT}
    for eye, T_body_camera in mounts.items():
        save_images(root / eye / "data", [f"{stamp}.png" for stamp in STAMPS])
        rows = [f"{stamp},{stamp}.png" for stamp in STAMPS]
        (root / eye / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(rows))
        sensor = {
            "T_BS": {"cols": 4, "rows": 4, "data": T_body_camera.ravel().tolist()},
            "resolution": [48, 32],
            "intrinsics": [70.0, 70.0, 24.0, 16.0],
            "distortion_model": "radtan",
            "distortion_coefficients": [-0.28, 0.07, 0.0, 0.0],
        }
        (root / eye / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(sensor))
    return root


def write_truth(root, poses, *, T_body_sensor=None) -> None:
    folder = root / "state_groundtruth_estimate0"
    folder.mkdir()
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], ..."]
    for stamp, T in zip(STAMPS, poses, strict=True):
        x, y, z, w = quat_xyzw_from_rotation(T[:3, :3])
        numbers = [*T[:3, 3], w, x, y, z, 0.1, 0.2, 0.3]
        rows.append(",".join([str(stamp), *(f"{number:.17g}" for number in numbers)]))
    (folder / "data.csv").write_text("\n".join(rows))
    if T_body_sensor is not None:
        document = {"T_BS": {"cols": 4, "rows": 4, "data": T_body_sensor.ravel().tolist()}}
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(document))


def test_pairs_and_exact_stamps(euroc):
    dataset, reason = open_dataset(euroc.parent)
    got = list(dataset.frames())
    assert [frame.stamp_ns for frame in got] == [s for stamp in STAMPS for s in (stamp, stamp)]
    assert [frame.camera for frame in got] == ["left", "right"] * 3
    assert dataset.name == "MH_01"
    assert reason.startswith("EuRoC recording")
    assert dataset.calibration().baseline_m == pytest.approx(0.11)


def test_mav0_itself_may_be_given(euroc):
    assert open_dataset(euroc)[0].instants() == 3


def test_names_are_stamps_without_a_list(euroc):
    for eye in ("cam0", "cam1"):
        (euroc / eye / "data.csv").unlink()
    assert [f.stamp_ns for f in open_dataset(euroc)[0].frames()][::2] == list(STAMPS)


@pytest.mark.parametrize("mounted", [False, True])
def test_truth_is_that_of_the_left_camera(euroc, mounted):
    """A point fixed in the world, seen by the left camera at its known place."""
    T_body_sensor = make_transform(exp_so3([0.0, 0.0, 0.5]), [0.3, 0.0, 0.1])
    T_world_body = [
        make_transform(exp_so3([0.1 * i, 0.2, 0.3]), [float(i), 2.0, 3.0]) for i in range(3)
    ]
    if mounted:
        write_truth(euroc, [T @ T_body_sensor for T in T_world_body], T_body_sensor=T_body_sensor)
    else:
        write_truth(euroc, T_world_body)
    truth = open_dataset(euroc)[0].ground_truth()
    assert truth.stamps_ns.tolist() == list(STAMPS)
    landmark_world = np.array([3.0, -1.0, 5.0, 1.0])
    for T_world_rig, T in zip(truth.T_world_rig, T_world_body, strict=True):
        in_body = inverse(T) @ landmark_world
        in_left = inverse(T_BODY_LEFT) @ in_body
        assert np.allclose(inverse(T_world_rig) @ landmark_world, in_left, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("#head\n", "holds no poses"),
        ("1,2,3\n", "data.csv:1: '1,2,3' is not 'stamp, x, y, z"),
        ("1,0,0,0,0,0,0,0\n", "is not 'stamp"),
    ],
)
def test_broken_truth_says_where(euroc, text, complaint):
    (euroc / "state_groundtruth_estimate0").mkdir()
    (euroc / "state_groundtruth_estimate0" / "data.csv").write_text(text)
    with pytest.raises(DatasetError, match=complaint):
        open_dataset(euroc)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("#head\n", "lists no images"),
        ("soon,1.png\n", "data.csv:1: 'soon,1.png' is not 'stamp,file name'"),
        ("1,missing.png\n", "lists 1 images that are not there, the first is .*missing.png"),
    ],
)
def test_broken_lists_say_where(euroc, text, complaint):
    (euroc / "cam1" / "data.csv").write_text(text)
    with pytest.raises(DatasetError, match=complaint):
        open_dataset(euroc)


def test_stamps_out_of_order_are_refused(euroc):
    rows = [f"{stamp},{stamp}.png" for stamp in reversed(STAMPS)]
    (euroc / "cam0" / "data.csv").write_text("\n".join(rows))
    with pytest.raises(DatasetError, match="stamps of camera 'left' do not increase"):
        open_dataset(euroc)


def test_names_that_are_no_stamps_need_a_list(euroc):
    (euroc / "cam0" / "data.csv").unlink()
    (euroc / "cam0" / "data" / f"{STAMPS[0]}.png").rename(euroc / "cam0" / "data" / "first.png")
    with pytest.raises(DatasetError, match=r"not named by its stamp .* no data.csv"):
        open_dataset(euroc)


def test_given_calibration_wins(euroc, tmp_path):
    other = tmp_path / "calib.txt"
    other.write_text("70 0 24 0 0 70 16 0 0 0 1 0\n70 0 24 -14 0 70 16 0 0 0 1 0\n")
    dataset, _ = open_dataset(euroc, SourceOptions(calibration=other))
    assert dataset.calibration().baseline_m == pytest.approx(0.2)


def test_real_recording(recording):
    dataset, _ = open_dataset(recording("euroc_standing_still"))
    got = list(dataset.frames())
    assert len(got) == 40
    assert got[0].stamp_ns == 1403715273262142976
    assert got[0].image.shape == (480, 752)
