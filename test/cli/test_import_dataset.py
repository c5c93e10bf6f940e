"""``import-dataset`` and ``inspect-bag``: the bag replays to the same numbers as its source."""

from __future__ import annotations

import argparse
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml

from thermal_stereo_vo.cli import import_dataset, inspect_bag
from thermal_stereo_vo.core.cameras import (
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.errors import CalibrationError, DatasetError
from thermal_stereo_vo.core.frames import FfcState, RadiometricFrame, RawFrame, Telemetry
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, make_transform
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset
from thermal_stereo_vo.outputs.dataset_bag import write_dataset
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier

MODULES = {"import-dataset": import_dataset, "inspect-bag": inspect_bag}


def command(verb: str, *arguments: object) -> int:
    parser = argparse.ArgumentParser(prog=verb)
    MODULES[verb].add_arguments(parser)
    return MODULES[verb].run(parser.parse_args([str(argument) for argument in arguments]))


def rectified(dataset) -> list[tuple[int, str, np.ndarray]]:
    """What the pipeline makes of a dataset up to rectified images."""
    rectifier = Rectifier(dataset.calibration(), RectificationConfig())
    views = []
    for frame in dataset.frames():
        view = rectifier.process(
            RadiometricFrame(frame.image, frame.stamp_ns, frame.camera), frame.camera
        )
        views.append((frame.stamp_ns, frame.camera, view.image))
    return views


class MadeUpFlight:
    """An unrectified 16-bit rig with telemetry, a mount on the vehicle and a true trajectory."""

    name = "made-up"
    cameras = ("left", "right")

    def __init__(self, rng: np.random.Generator) -> None:
        lens = Camera(
            48,
            32,
            60.0,
            61.0,
            23.0,
            15.5,
            DistortionModel.RADIAL_TANGENTIAL,
            (-0.2, 0.05, 0.001, -0.001),
        )
        mount = make_transform(exp_so3([0.02, -0.01, 0.03]), [0.25, 0.002, -0.004])
        T_base_rig = make_transform(exp_so3([0.3, 0.2, -1.0]), [0.1, 0.0, -0.05])
        self._rig = RigCalibration(
            {"left": RigCamera(lens), "right": RigCamera(lens, mount)}, T_base_rig=T_base_rig
        )
        self._images = rng.integers(0, 16384, (8, 32, 48), dtype=np.uint16)
        poses = np.array([exp_se3(rng.normal(size=6)) for _ in range(5)])
        self._truth = Trajectory(np.arange(5) * 10**8 - 10**7 + 10**9, poses)

    def calibration(self):
        return self._rig

    def ground_truth(self):
        return self._truth

    def instants(self):
        return 4

    def frames(self):
        for i, image in enumerate(self._images):
            yield RawFrame(
                image,
                10**9 + (i // 2) * 10**8,
                self.cameras[i % 2],
                i // 2,
                Telemetry(300.0 + i, 299.0, FfcState.NONE, i, i * 10**7),
            )


def same_truth_in_rectified_rig(dataset, imported) -> None:
    """True poses of the rectified left camera agree, whatever rig frame each file speaks of."""
    poses = []
    for source in (dataset, imported):
        rectifier = Rectifier(source.calibration(), RectificationConfig())
        poses.append(source.ground_truth().T_world_rig @ rectifier.T_rig_rectified)
    # Each recording may have a world frame of its own: compare motion from the first pose.
    first, second = (np.linalg.inv(p[0]) @ p for p in poses)
    assert np.allclose(first, second, atol=1e-9)


@pytest.fixture
def euroc(tmp_path, rng):
    """A raw recording with lens distortion, tilted eyes and truth of the body."""
    root = tmp_path / "MH_00" / "mav0"
    T_body_left = make_transform(exp_so3([0.2, -1.4, 0.4]), [0.02, -0.06, 0.01])
    T_left_right = make_transform(exp_so3([0.02, 0.01, -0.03]), [0.11, 0.001, -0.002])
    stamps = [1403715273262142976 + i * 50_000_128 for i in range(4)]
    for eye, T in (("cam0", T_body_left), ("cam1", T_body_left @ T_left_right)):
        (root / eye / "data").mkdir(parents=True)
        for stamp in stamps:
            noise = rng.integers(0, 256, (32, 48), dtype=np.uint8)
            cv2.imwrite(str(root / eye / "data" / f"{stamp}.png"), noise)
        sensor = {
            "T_BS": {"data": T.ravel().tolist()},
            "resolution": [48, 32],
            "intrinsics": [60.0, 61.0, 23.0, 15.5],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [-0.2, 0.05, 0.001, -0.001],
        }
        (root / eye / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(sensor))
    truth = root / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = [
        f"{stamp},{0.1 * i},{-0.2 * i},1.0,{np.cos(0.1 * i)},0,{np.sin(0.1 * i)},0"
        for i, stamp in enumerate(stamps)
    ]
    (truth / "data.csv").write_text("\n".join(rows))
    return root.parent


def test_imported_recording_gives_the_same_frames_and_the_same_rig(euroc, tmp_path, capsys):
    assert command("import-dataset", euroc, "--output", tmp_path / "bag") == 0
    dataset, _ = open_dataset(euroc)
    imported, _ = open_dataset(tmp_path / "bag")
    for a, b in zip(dataset.frames(), imported.frames(), strict=True):
        assert (a.stamp_ns, a.camera, a.sequence) == (b.stamp_ns, b.camera, b.sequence)
        assert np.array_equal(a.image, b.image)
    first, second = dataset.calibration(), imported.calibration()
    assert np.allclose(first.T_a_b("left", "right"), second.T_a_b("left", "right"), atol=1e-12)
    assert all(first[eye].camera == second[eye].camera for eye in ("left", "right"))
    assert "8 images of left, right written" in capsys.readouterr().out


@pytest.mark.parametrize("forget", [(), ("rig.yaml", "left.yaml", "right.yaml")])
def test_rectified_images_and_truth_agree_bit_for_bit(euroc, tmp_path, forget):
    """Also when only ``camera_info`` is left to tell the rig."""
    command("import-dataset", euroc, "--output", tmp_path / "bag", "--quiet")
    for name in forget:
        (tmp_path / "bag" / name).unlink()
    dataset, _ = open_dataset(euroc)
    imported, _ = open_dataset(tmp_path / "bag")
    for a, b in zip(rectified(dataset), rectified(imported), strict=True):
        assert a[:2] == b[:2]
        assert np.array_equal(a[2], b[2])
    same_truth_in_rectified_rig(dataset, imported)


def test_mount_telemetry_and_counts_survive(tmp_path, rng):
    flight = MadeUpFlight(rng)
    calls = []
    assert write_dataset(flight, tmp_path / "bag", lambda: calls.append(1)) == len(calls) == 8
    imported, _ = open_dataset(tmp_path / "bag")
    for a, b in zip(flight.frames(), imported.frames(), strict=True):
        assert np.array_equal(a.image, b.image)
        assert a.telemetry == b.telemetry
    assert imported.ground_truth().stamps_ns.tolist() == flight.ground_truth().stamps_ns.tolist()
    same_truth_in_rectified_rig(flight, imported)
    # base_link must not move when the rig frame is turned into the rectified left camera.
    old, new = flight.calibration(), imported.calibration()
    assert np.allclose(
        old.T_base_rig @ old["right"].T_rig_camera,
        new.T_base_rig @ new["right"].T_rig_camera,
        atol=1e-12,
    )


def test_import_of_an_import_is_the_same(euroc, tmp_path):
    command("import-dataset", euroc, "--output", tmp_path / "a", "--quiet")
    command("import-dataset", tmp_path / "a", "--output", tmp_path / "b", "--quiet")
    a, b = (rectified(open_dataset(tmp_path / name)[0]) for name in "ab")
    assert all(np.array_equal(x[2], y[2]) for x, y in zip(a, b, strict=True))
    same_truth_in_rectified_rig(open_dataset(euroc)[0], open_dataset(tmp_path / "b")[0])


def test_images_without_calibration_are_imported_as_they_are(tmp_path, rng):
    for eye in ("left", "right"):
        (tmp_path / "pair" / eye).mkdir(parents=True)
        for i in range(3):
            noise = rng.integers(0, 65536, (32, 48), dtype=np.uint16)
            cv2.imwrite(str(tmp_path / "pair" / eye / f"{i}.png"), noise)
    command("import-dataset", tmp_path / "pair", "--rate", 20, "--output", tmp_path / "bag")
    imported, _ = open_dataset(tmp_path / "bag")
    assert imported.calibration() is None
    original, _ = open_dataset(tmp_path / "pair", SourceOptions(rate_hz=20.0))
    for a, b in zip(original.frames(), imported.frames(), strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert np.array_equal(a.image, b.image)


def test_a_source_that_breaks_on_the_way_leaves_nothing(euroc, tmp_path):
    last = sorted((euroc / "mav0" / "cam1" / "data").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:40])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(DatasetError, match="is no readable image"):
        command("import-dataset", euroc, "--output", tmp_path / "bag", "--quiet")
    assert sorted(tmp_path.iterdir()) == before


def test_impossible_rig_is_refused_before_anything_is_written(euroc, tmp_path):
    sensor = euroc / "mav0" / "cam0" / "sensor.yaml"
    (euroc / "mav0" / "cam1" / "sensor.yaml").write_text(sensor.read_text())
    with pytest.raises(CalibrationError, match=r"baseline of .* is 0\.000 mm"):
        command("import-dataset", euroc, "--output", tmp_path / "bag", "--quiet")
    assert not (tmp_path / "bag").exists()


def test_inspection_of_an_import(euroc, tmp_path, capsys):
    command("import-dataset", euroc, "--output", tmp_path / "bag", "--quiet")
    assert capsys.readouterr().out == ""
    assert command("inspect-bag", tmp_path / "bag") == 0
    report = capsys.readouterr().out
    assert "/left/image_raw" in report
    assert "48x32 mono8" in report
    assert "4 pairs, 0 images alone" in report
    assert "baseline 0.1100 m, to be rectified" in report


def test_real_recordings_survive(recording, tmp_path):
    for name in ("kitti_residential", "euroc_standing_still"):
        source = recording(name)
        command("import-dataset", source, "--output", tmp_path / name, "--quiet")
        dataset, _ = open_dataset(source)
        imported, _ = open_dataset(tmp_path / name)
        for a, b in zip(rectified(dataset), rectified(imported), strict=True):
            assert a[:2] == b[:2]
            assert np.array_equal(a[2], b[2])


@pytest.mark.parametrize("verb", MODULES)
def test_help_loads_nothing_heavy(verb):
    """The names of the arguments must not cost an import of OpenCV or rosbags."""
    program = (
        "import argparse, sys\n"
        f"from thermal_stereo_vo.cli import {MODULES[verb].__name__.rpartition('.')[2]} as verb\n"
        "verb.add_arguments(argparse.ArgumentParser())\n"
        "print([m for m in ('cv2', 'numpy', 'rosbags', 'numba', 'tqdm') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
