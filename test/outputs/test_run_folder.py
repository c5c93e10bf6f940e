from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.outputs.replacing import replacing, write_text
from thermal_stereo_vo.outputs.run_folder import RunFolder, is_run_folder, run_record, to_json


@dataclasses.dataclass(frozen=True)
class Settings:
    window: int = setting(3, "Frames.")


def record(**more):
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    return run_record(
        settings=Settings(),
        calibration=RigCalibration({"left": RigCamera(camera)}, origin="test"),
        source="flight.mcap",
        source_reason="it ends in .mcap",
        command_line=["replay", "flight.mcap"],
        **more,
    )


def leave_run(directory: Path, text: str) -> None:
    with RunFolder(directory) as folder:
        (folder.path / "trajectory.tum").write_text(text)
        (folder.path / "result.mcap").mkdir()
        (folder.path / "result.mcap" / "metadata.yaml").write_text(text)
        folder.write_json("run.json", record())


def leave_half_a_run(directory: Path, error: BaseException) -> None:
    with RunFolder(directory) as folder:
        (folder.path / "trajectory.tum").write_text("half")
        raise error


def test_run_appears_complete_and_replaces_an_earlier_one(tmp_path):
    directory = tmp_path / "deep" / "run"
    leave_run(directory, "first")
    (directory / "left_over.png").write_bytes(b"old")
    leave_run(directory, "second")
    assert sorted(path.name for path in directory.iterdir()) == [
        "result.mcap",
        "run.json",
        "trajectory.tum",
    ]
    assert (directory / "result.mcap" / "metadata.yaml").read_text() == "second"
    assert is_run_folder(directory)


def test_nothing_is_left_after_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="half way"):
        leave_half_a_run(tmp_path / "run", RuntimeError("half way"))
    assert not (tmp_path / "run").exists()


def test_earlier_run_survives_an_error(tmp_path):
    leave_run(tmp_path / "run", "good")
    with pytest.raises(KeyboardInterrupt):
        leave_half_a_run(tmp_path / "run", KeyboardInterrupt())
    assert (tmp_path / "run" / "trajectory.tum").read_text() == "good"
    assert not (tmp_path / "run" / ".partial").exists()


def test_empty_folder_is_taken_and_kept_after_an_error(tmp_path):
    leave_run(tmp_path, "x")
    assert is_run_folder(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(RuntimeError):
        leave_half_a_run(empty, RuntimeError())
    assert empty.is_dir()
    assert list(empty.iterdir()) == []


def test_foreign_content_is_refused_and_untouched(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with (
        pytest.raises(ConfigError, match=r"not empty and holds no earlier run \(thesis.tex"),
        RunFolder(tmp_path),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_run_json_of_another_program_is_foreign(tmp_path):
    (tmp_path / "run.json").write_text('{"program": "something else"}')
    with pytest.raises(ConfigError, match="holds no earlier run"), RunFolder(tmp_path):
        pass
    (tmp_path / "run.json").write_text("no json")
    assert not is_run_folder(tmp_path)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(ConfigError, match="is a file: give a folder"), RunFolder(tmp_path / "run"):
        pass
    with (
        pytest.raises(ConfigError, match="cannot be written: Not a directory"),
        RunFolder(tmp_path / "run" / "below"),
    ):
        pass


def test_record_tells_what_is_needed_to_repeat_the_run(tmp_path):
    with RunFolder(tmp_path / "run") as folder:
        folder.write_json("run.json", record(seed=np.int64(4)))
    read = json.loads((tmp_path / "run" / "run.json").read_text())
    assert read["command_line"] == ["replay", "flight.mcap"]
    assert read["source_reason"] == "it ends in .mcap"
    assert read["settings"] == {"window": 3}
    assert read["calibration"]["cameras"]["left"]["fx"] == 500.0
    assert read["calibration"]["cameras"]["left"]["T_rig_camera"] == np.eye(4).tolist()
    assert read["calibration"]["cameras"]["left"]["model"] == "none"
    assert read["seed"] == 4
    assert read["versions"]["numpy"] == np.__version__
    assert set(read["versions"]) >= {"thermal_stereo_vo", "python", "opencv", "numba"}


def test_json_knows_no_nan():
    content = {"a": float("nan"), "b": [np.inf, np.float32(0.5)], "c": TrackingStatus.LOST}
    assert json.loads(to_json(content)) == {"a": None, "b": [None, 0.5], "c": "LOST"}


def write_half(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError


def test_replaced_file_is_whole_or_as_before(tmp_path):
    path = tmp_path / "file"
    write_text(path, "before")
    with pytest.raises(RuntimeError):
        write_half(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
