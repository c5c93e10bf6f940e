"""``reconstruct`` from the command line, its files read back by others."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.outputs.point_cloud_file import read_pcd, read_ply

PAIRS = 8
trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")

SETTINGS = [
    "dense.disparities=64",
    "model.keyframe_m=0.1",
    "model.max_range_m=12",
    "thermometer.planck_r=5000",
]


@pytest.fixture(scope="module")
def drive(room, tmp_path_factory):
    """A short flight through the room as a folder in the layout of KITTI."""
    folder = tmp_path_factory.mktemp("drives") / "drive"
    poses = room.path(PAIRS, step=(0.02, 0.0, 0.08, 0.0, 0.004, 0.0))
    stamps = np.arange(PAIRS) * 100_000_000
    for raw in room.raw_frames(stamps, poses, np.random.default_rng(5)):
        path = folder / f"image_{int(raw.camera == 'right')}" / f"{raw.sequence:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), raw.image)
    camera = room.camera
    rows = []
    for eye in range(2):
        shift = -eye * camera.fx * room.baseline_m
        row = [camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        rows.append(f"P{eye}: " + " ".join(map(str, row)))
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    return folder


def reconstruct(drive, output, *more):
    settings = [text for setting in SETTINGS for text in ("--set", setting)]
    return main(["reconstruct", str(drive), "--output", str(output), *settings, *more])


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    output = tmp_path_factory.mktemp("models") / "model"
    assert reconstruct(drive, output, "--quiet") == 0
    return output


def test_everything_is_there(folder):
    names = {path.name for path in folder.iterdir()}
    assert {"model.ply", "model.pcd", "model.json", "run.json", "trajectory.tum"} <= names
    assert {"top.png", "oblique.png", "disparity.png"} <= names
    figures = json.loads((folder / "model.json").read_text())
    assert 4 <= figures["keyframes"] <= PAIRS
    assert figures["points"] > 2000
    run = json.loads((folder / "run.json").read_text())
    assert run["settings"]["model.max_range_m"] == 12.0


def test_the_points_are_on_the_walls_in_axes_of_odom(folder, room):
    cloud = read_ply(folder / "model.ply")
    world = cloud.xyz @ default_T_base_rig()[:3, :3]  # the inverse, from the right
    off_m = np.min(np.abs(np.stack([world - room.low, world - room.high])), axis=(0, 2))
    assert np.median(off_m) < 0.06
    assert cloud.xyz[:, 0].max() > 6.0  # ahead is x


def test_others_read_the_ply(folder):
    ours = read_ply(folder / "model.ply")
    theirs = trimesh.load(folder / "model.ply")
    np.testing.assert_allclose(theirs.vertices, ours.xyz, atol=1e-6)
    assert theirs.colors.shape == (len(ours.xyz), 4)
    assert len(np.unique(theirs.colors[:, 0])) > 20
    columns = theirs.metadata["_ply_raw"]["vertex"]["data"]
    assert list(columns.dtype.names)[3:8] == [
        "intensity",
        "temperature",
        "intensity_spread",
        "temperature_spread",
        "count",
    ]
    np.testing.assert_array_equal(columns["temperature"].ravel(), ours.temperature_kelvin)


def test_pcd_and_ply_agree(folder):
    ply, pcd = read_ply(folder / "model.ply"), read_pcd(folder / "model.pcd")
    np.testing.assert_array_equal(ply.xyz, pcd.xyz)
    np.testing.assert_array_equal(ply.intensity, pcd.intensity)
    np.testing.assert_array_equal(ply.temperature_kelvin, pcd.temperature_kelvin)


@pytest.mark.parametrize("name", ["top.png", "oblique.png", "disparity.png"])
def test_pictures_show_something(folder, name):
    picture = cv2.imread(str(folder / name))
    assert picture.shape[0] > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_wrong_use_is_told_in_a_line(drive, tmp_path, capsys):
    output = tmp_path / "none"
    assert reconstruct(drive, output, "--set", "model.voxel_m=0.1") == 2
    assert "model.volume" in capsys.readouterr().err
    assert reconstruct(drive, output, "--set", "model.volume.min_count=100000") == 2
    error = capsys.readouterr().err
    assert "no surface" in error
    assert "min_count" in error
    assert not output.exists()
