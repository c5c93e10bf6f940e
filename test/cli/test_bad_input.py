"""Bad input ends with exit code 2, one line that says what to do, and nothing half-written."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.cli.main import DONE, WRONG_USE, main
from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.cameras import RigCamera
from thermal_stereo_vo.core.transforms import make_transform

from ..datasets.bags import bag_path, scribe

PAIRS = 4
FAST = ("--set", "odometry.window=0", "--no-plot", "--quiet")


@pytest.fixture(scope="session")
def good_folder(room, tmp_path_factory) -> Path:
    """``left`` and ``right`` named by stamp, with ``rig.yaml`` beside them."""
    folder = tmp_path_factory.mktemp("recordings") / "flight"
    save_calibration(room.calibration(), folder)
    stamps = 1_700_000_000_000_000_000 + np.arange(PAIRS) * 100_000_000
    for raw in room.raw_frames(stamps, room.path(PAIRS), np.random.default_rng(1)):
        (folder / raw.camera).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / raw.camera / f"{raw.stamp_ns}.png"), raw.image)
    return folder


@pytest.fixture
def folder(good_folder, tmp_path) -> Path:
    """A copy to be spoilt."""
    return Path(shutil.copytree(good_folder, tmp_path / "flight"))


@pytest.fixture(scope="session")
def good_bag(good_folder, tmp_path_factory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "flight_bag"
    assert main(["import-dataset", str(good_folder), "--output", str(bag), "--quiet"]) == DONE
    return bag


@pytest.fixture
def refused(tmp_path, capsys):
    """``refused("replay", SOURCE, words=[...])``: exit code 2, one line with all the words."""

    def run(verb, *arguments, words):
        output = tmp_path / "out"
        before = sorted(tmp_path.rglob("*"))
        capsys.readouterr()
        code = main([verb, *map(str, arguments), "--output", str(output)])
        out, err = capsys.readouterr()
        assert code == WRONG_USE, err
        assert out == ""
        lines = err.splitlines()
        assert len(lines) == 1, err
        assert lines[0].startswith("error: ")
        assert "Traceback" not in err
        for word in words:
            assert word in err, f"'{word}' is not in: {err}"
        assert sorted(tmp_path.rglob("*")) == before, "something was left behind"
        return err

    return run


def replay_is_refused(refused, source, *more, words):
    return refused("replay", source, *FAST, *more, words=words)


def images(folder: Path, eye: str) -> list[Path]:
    return sorted((folder / eye).iterdir())


def with_rig(folder: Path, room, **changes) -> None:
    """Write another calibration beside the images."""
    for name in ("rig.yaml", "left.yaml", "right.yaml"):
        (folder / name).unlink(missing_ok=True)
    calibration = room.calibration()
    right = replace(calibration["right"], **changes)
    save_calibration(
        replace(calibration, cameras={"left": calibration["left"], "right": right}), folder
    )


def at_x(x_m):
    return make_transform(np.eye(3), [x_m, 0.0, 0.0])


# ------------------------------------------------------------------------------------ the recording


def test_the_good_recording_is_not_refused(good_folder, tmp_path, capsys):
    """Or all of the tests below would pass for another reason."""
    assert main(["replay", str(good_folder), *FAST, "--output", str(tmp_path / "out")]) == DONE
    assert capsys.readouterr().err == ""


def test_no_such_recording(refused, tmp_path):
    replay_is_refused(
        refused, tmp_path / "nowhere", words=["there is no recording", "nowhere", "sim:PRESET"]
    )


def test_empty_folder(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    replay_is_refused(
        refused, tmp_path / "empty", words=["empty is empty", "give the folder of a recording"]
    )


def test_folder_without_anything_known(refused, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("nothing")
    replay_is_refused(
        refused, tmp_path / "other", words=["is no recording known here", "left + right"]
    )


def test_file_that_is_no_bag(refused, tmp_path):
    (tmp_path / "video.avi").write_bytes(b"RIFF")
    replay_is_refused(refused, tmp_path / "video.avi", words=["video.avi", ".bag, .db3, .mcap"])


def test_image_folder_without_images(refused, folder):
    for path in images(folder, "right"):
        path.unlink()
    replay_is_refused(refused, folder, words=["right holds no images", ".png"])


def test_left_and_right_of_different_size(refused, folder):
    for path in images(folder, "right"):
        cv2.imwrite(str(path), np.zeros((120, 160), np.uint8))
    replay_is_refused(
        refused, folder, words=["left is 320x240", "right is 160x120", "both eyes must be alike"]
    )


def test_size_that_changes_in_the_middle(refused, folder):
    cv2.imwrite(str(images(folder, "left")[2]), np.zeros((120, 160), np.uint8))
    replay_is_refused(refused, folder, words=["is 160x120", "320x240", "one size"])


def test_three_channels_of_16_bit(refused, folder):
    for eye in ("left", "right"):
        for path in images(folder, eye):
            cv2.imwrite(str(path), np.zeros((240, 320, 3), np.uint16))
    replay_is_refused(
        refused, folder, words=["3 channels of 16 bit", "single-channel", "linear counts"]
    )


def test_damaged_image_in_the_middle(refused, folder):
    path = images(folder, "right")[2]
    path.write_bytes(path.read_bytes()[:40])
    replay_is_refused(refused, folder, words=[path.name, "damaged or cut short"])


def test_names_that_are_no_stamps(refused, folder):
    for eye in ("left", "right"):
        for i, path in enumerate(images(folder, eye)):
            path.rename(path.with_name(f"frame{i:03d}.png"))
    replay_is_refused(refused, folder, words=["is not named by a stamp", "--rate"])


def test_stamps_that_do_not_increase(refused, folder, room):
    """A EuRoC list out of order."""
    root = folder / "mav0"
    for eye, camera in (("left", "cam0"), ("right", "cam1")):
        (root / camera).mkdir(parents=True)
        (folder / eye).rename(root / camera / "data")
        names = [p.name for p in sorted((root / camera / "data").iterdir())]
        names[1], names[2] = names[2], names[1]
        lines = [f"{Path(name).stem},{name}" for name in names]
        (root / camera / "data.csv").write_text("#timestamp,filename\n" + "\n".join(lines))
    replay_is_refused(
        refused, folder, "--calibration", folder / "rig.yaml", words=["left", "stamp", "ns"]
    )


# ---------------------------------------------------------------------------------- the calibration


def test_missing_calibration(refused, folder):
    for name in ("rig.yaml", "left.yaml", "right.yaml"):
        (folder / name).unlink()
    replay_is_refused(refused, folder, words=["brings no calibration", "--calibration", "rig.yaml"])


def test_calibration_file_that_is_not_there(refused, folder):
    replay_is_refused(refused, folder, "--calibration", folder / "no.yaml", words=["no.yaml"])


def test_zero_baseline(refused, folder, room):
    with_rig(folder, room, T_rig_camera=np.eye(4))
    replay_is_refused(refused, folder, words=["baseline", "0.000 mm", "check the translation"])


def test_swapped_eyes(refused, folder, room):
    with_rig(folder, room, T_rig_camera=at_x(-0.25))
    replay_is_refused(
        refused, folder, words=["swapped", "exchange the left and right images or calibrations"]
    )


def test_calibration_of_another_video_mode(refused, folder, room):
    """Both eyes agree with each other, but not with the images."""
    for name in ("rig.yaml", "left.yaml", "right.yaml"):
        (folder / name).unlink()
    calibration = room.calibration()
    cameras = {
        role: RigCamera(replace(m.camera, width=640, height=512), m.T_rig_camera)
        for role, m in calibration.cameras.items()
    }
    save_calibration(replace(calibration, cameras=cameras), folder)
    replay_is_refused(refused, folder, words=["320x240", "640x512", "calibration"])


# --------------------------------------------------------------------------------------------- bags


def test_wrong_topic_lists_those_that_are_there(refused, good_bag):
    replay_is_refused(
        refused, good_bag, "--left-topic", "/cam/left",
        words=["no image topic '/cam/left'", "/left/image_raw", "/right/image_raw", "--left-topic"],
    )  # fmt: skip


@pytest.mark.parametrize("part", [0.3, 0.9])
def test_truncated_bag(refused, good_bag, tmp_path, part):
    bag = Path(shutil.copytree(good_bag, tmp_path / "cut"))
    (data,) = bag.glob("*.mcap")
    content = data.read_bytes()
    data.write_bytes(content[: int(part * len(content))])
    replay_is_refused(refused, bag, words=["cannot be read", "cut short"])


def test_file_that_only_claims_to_be_a_bag(refused, tmp_path):
    path = tmp_path / "rubbish.mcap"
    path.write_bytes(b"\x00" * 1000)
    replay_is_refused(refused, path, words=["rubbish.mcap", "cannot be read"])


def test_stamps_that_go_back_in_a_bag(refused, folder, tmp_path, room):
    """Recorded in this order, but the driver's clock jumped."""
    images_of_both = dict(zip(("left", "right"), room.pair(np.eye(4)), strict=True))
    bag = bag_path("mcap", tmp_path / "backwards")
    with scribe("mcap", bag) as out:
        for i, stamp_ns in enumerate((1_000_000_000, 1_100_000_000, 1_050_000_000, 1_200_000_000)):
            for eye, image in images_of_both.items():
                out.image(f"/{eye}/image_raw", stamp_ns, image, log_ns=2_000_000_000 + i * 10**8)
    replay_is_refused(
        refused, bag, "--calibration", folder / "rig.yaml",
        words=["stamps of /left/image_raw do not increase", "image 2"],
    )  # fmt: skip


# ------------------------------------------------------------------------------ settings and output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "odometry.sover=x"], ["odometry.sover", "did you mean 'odometry.solver'"]),
        (["--set", "odometry.solver=newton"], ["must be one of gauss_newton", "'newton'"]),
        (["--set", "odometry.window"], ["--set takes key=value", "odometry.window"]),
        (["--set", "odometry.window=1"], ["odometry.window = 1", "2 and more"]),
        (["--set", "pairing.tolerance_ms=-1"], ["tolerance_ms = -1", "0..1000"]),
        (["--set", "odometry.seed=.inf"], ["odometry.seed", "whole number"]),
        (["--method", "orb"], ["odometry.method", "feature", "'orb'"]),
        (["--config", "nowhere.yaml"], ["cannot read the settings", "nowhere.yaml"]),
        (["--set", "agc.roi=[0.9, 0, 0.1, 1]"], ["roi", "left < right"]),
        (["--ground-truth", "nowhere.tum"], ["nowhere.tum"]),
    ],
    ids=lambda value: value[-1] if value[0].startswith("--") else "",
)
def test_wrong_settings(refused, good_folder, arguments, words):
    replay_is_refused(refused, good_folder, *arguments, words=words)


def test_all_mistakes_of_a_settings_file_at_once(refused, good_folder, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("odometry:\n  solvr: gauss_newton\n  seed: -5\npairing: 3\n")
    replay_is_refused(
        refused, good_folder, "--config", path,
        words=["mine.yaml", "'odometry.solver'", "odometry.seed = -5", "pairing is a group"],
    )  # fmt: skip


def test_output_that_is_a_file(good_folder, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert main(["replay", str(good_folder), *FAST, "--output", str(tmp_path / "out")]) == WRONG_USE
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "is a file: give a folder" in err
    assert (tmp_path / "out").read_text() == "mine"


def test_output_that_holds_something_else(good_folder, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("mine")
    assert main(["replay", str(good_folder), *FAST, "--output", str(tmp_path / "out")]) == WRONG_USE
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "thesis.tex" in err
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_a_failure_leaves_the_earlier_run_as_it_was(good_folder, folder, tmp_path, capsys):
    output = tmp_path / "out"
    assert main(["replay", str(good_folder), *FAST, "--output", str(output)]) == DONE
    earlier = {p: p.read_bytes() for p in output.rglob("*") if p.is_file()}
    images(folder, "right")[2].write_bytes(b"")
    assert main(["replay", str(folder), *FAST, "--output", str(output)]) == WRONG_USE
    assert {p: p.read_bytes() for p in output.rglob("*") if p.is_file()} == earlier
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("verb", ["replay", "import-dataset"])
def test_a_missing_output_is_wrong_use(verb, good_folder, capsys):
    with pytest.raises(SystemExit) as end:
        main([verb, str(good_folder)])
    assert end.value.code == WRONG_USE
    assert "--output" in capsys.readouterr().err
