"""Exit codes, the verbs about settings, progress bars, and one whole replay."""

from __future__ import annotations

import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from thermal_stereo_vo import __version__
from thermal_stereo_vo.cli.main import DONE, FAULT, INTERRUPTED, VERBS, WRONG_USE, main
from thermal_stereo_vo.cli.progress import progress
from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.config import flatten, load_yaml
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.transforms import quat_xyzw_from_rotation
from thermal_stereo_vo.pipeline import Config

PAIRS = 12
START_NS = 1_700_000_000_000_000_000


# --------------------------------------------------------------------------------------- exit codes


@pytest.fixture
def dump_raises(monkeypatch):
    """Make ``dump-config`` fail with an error."""

    def prepare(error: BaseException) -> None:
        def fail(_):
            raise error

        monkeypatch.setattr("thermal_stereo_vo.core.config.dump_yaml", fail)

    return prepare


def test_a_fault_of_ours_is_told_apart_and_shown_in_full(dump_raises, capsys):
    dump_raises(ZeroDivisionError("of all things"))
    assert main(["dump-config"]) == FAULT == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "ZeroDivisionError: of all things" in err
    assert err.splitlines()[-1] == "error: this is a fault of the program, please report it"


def test_wrong_use_is_one_line_without_a_trace(dump_raises, capsys):
    dump_raises(ConfigError("first line\n   and   a second"))
    assert main(["dump-config"]) == WRONG_USE == 2
    assert capsys.readouterr() == ("", "error: first line and a second\n")


def test_interruption_is_no_fault(dump_raises, capsys):
    dump_raises(KeyboardInterrupt())
    assert main(["dump-config"]) == INTERRUPTED == 130
    assert capsys.readouterr() == ("", "interrupted\n")


def test_a_reader_that_has_enough_is_no_fault(dump_raises, capsys):
    """``... dump-config | head -1``."""
    dump_raises(BrokenPipeError())
    assert main(["dump-config"]) == DONE == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("arguments", [[], ["fly"], ["replay"], ["check-config"]])
def test_unknown_or_missing_arguments_are_wrong_use(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == WRONG_USE
    assert "usage: python3 -m thermal_stereo_vo" in capsys.readouterr().err


def test_version(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == DONE
    assert capsys.readouterr().out.strip() == __version__


def test_arguments_of_the_process_are_the_default(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["thermal_stereo_vo", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert capsys.readouterr().out.strip() == __version__


def test_verbs_of_the_contract_are_there():
    contracted = {"replay", "evaluate", "simulate", "calibrate", "benchmark", "import-dataset",
                  "inspect-bag", "check-config", "dump-config"}  # fmt: skip
    assert contracted <= set(VERBS)


# ------------------------------------------------------------------------------ settings on the way


def test_dumped_settings_are_the_defaults_and_load_again(capsys, tmp_path):
    assert main(["dump-config"]) == DONE
    text = capsys.readouterr().out
    assert load_yaml(Config, text, origin="dump") == Config()
    path = tmp_path / "all.yaml"
    path.write_text(text)
    assert main(["check-config", str(path)]) == DONE
    assert (
        capsys.readouterr().out == f"{path}: no mistakes, 0 settings differ from their defaults\n"
    )


def test_dump_shows_what_file_overrides_and_method_make_together(capsys, tmp_path):
    """Later ones win: file, then --set, then --method."""
    path = tmp_path / "mine.yaml"
    path.write_text("odometry: {seed: 5, window: 3}\n")
    arguments = ["--config", path, "--set", "odometry.window=0", "--set",
                 "odometry.feature.motion.solver.gradient_tolerance=1e-6",
                 "--set", "sim.rate_hz=9", "--method", "feature"]  # fmt: skip
    assert main(["dump-config", *map(str, arguments)]) == DONE
    shown = flatten(load_yaml(Config, capsys.readouterr().out, origin="dump"))
    assert shown["odometry.seed"] == 5
    assert shown["odometry.window"] == 0
    assert shown["odometry.feature.motion.solver.gradient_tolerance"] == 1e-6
    assert shown["odometry.method"] == "feature"


def test_check_lists_what_differs(capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "stereo_odometry:\n  ros__parameters:\n    odometry:\n      solver: gauss_newton\n"
        "    pairing.tolerance_ms: 4\n"
    )
    assert main(["check-config", str(path)]) == DONE
    assert capsys.readouterr().out.splitlines() == [
        f"{path}: no mistakes, 2 settings differ from their defaults",
        "  pairing.tolerance_ms: 4.0",
        "  odometry.solver: gauss_newton",
    ]


def test_check_tells_all_mistakes_at_once(capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("odometry: {seeed: 5, window: 500}\nagc: {mode: magic}\n")
    assert main(["check-config", str(path)]) == WRONG_USE
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    for words in (str(path), "did you mean 'odometry.seed'", "odometry.window = 500", "agc.mode"):
        assert words in err


# ------------------------------------------------------------------------------------ progress bars


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "quiet", "drawn"),
    [(Terminal(), False, True), (Terminal(), True, False), (io.StringIO(), False, False)],
    ids=["terminal", "quiet", "log"],
)
def test_bars_are_for_terminals_only(monkeypatch, stream, quiet, drawn):
    monkeypatch.setattr("sys.stderr", stream)
    with progress(3, "pair", quiet=quiet) as step:
        for _ in range(3):
            step()
    assert bool(stream.getvalue()) is drawn
    assert ("pair" in stream.getvalue()) is drawn


# --------------------------------------------------------------------------------- one whole replay


@pytest.fixture(scope="module")
def flight(room, tmp_path_factory) -> Path:
    """A recorded flight with its truth beside it, as folders of images."""
    folder = tmp_path_factory.mktemp("recordings") / "flight"
    save_calibration(room.calibration(), folder)
    stamps = START_NS + np.arange(PAIRS) * 100_000_000
    poses = room.path(PAIRS)
    for raw in room.raw_frames(stamps, poses, np.random.default_rng(1)):
        (folder / raw.camera).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / raw.camera / f"{raw.stamp_ns}.png"), raw.image)
    lines = [
        " ".join(map(str, [f"{t // 10**9}.{t % 10**9:09d}", *T[:3, 3],
                           *quat_xyzw_from_rotation(T[:3, :3])]))
        for t, T in zip(stamps.tolist(), poses, strict=True)
    ]  # fmt: skip
    (folder / "truth.tum").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def run_folder(flight, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "out"
    code = main([
        "replay", str(flight), "--ground-truth", str(flight / "truth.tum"), "--output",
        str(output), "--set", "odometry.window=0", "--quiet",
    ])  # fmt: skip
    assert code == DONE
    return output


def read_json(path: Path):
    return json.loads(path.read_text())


def test_replay_leaves_what_the_contract_names(run_folder):
    left = {path.name for path in run_folder.iterdir()}
    assert left >= {
        "trajectory.tum", "trajectory_kitti.txt", "result.mcap", "run.json", "timing.json",
        "metrics.json", "trajectory.png",
    }  # fmt: skip
    assert not [path for path in run_folder.rglob("*") if "partial" in path.name]
    image = cv2.imread(str(run_folder / "trajectory.png"))
    assert image.std() > 5


def test_trajectories_have_a_line_per_pair(run_folder, room):
    kitti = np.loadtxt(run_folder / "trajectory_kitti.txt")
    assert kitti.shape == (PAIRS, 12)
    np.testing.assert_array_equal(kitti[0], np.eye(4)[:3].ravel())
    error_m = np.linalg.norm(kitti[-1].reshape(3, 4)[:, 3] - room.path(PAIRS)[-1][:3, 3])
    assert 1e-5 < error_m < 0.08
    lines = (run_folder / "trajectory.tum").read_text().splitlines()
    stamps = [line.split()[0] for line in lines if not line.startswith("#")]
    assert stamps[0] == "1700000000.000000000"
    assert len(stamps) == PAIRS


def test_timing_has_the_contracted_figures(run_folder):
    timing = read_json(run_folder / "timing.json")
    assert timing["frames"] == PAIRS
    assert set(timing["wall_ms_per_frame"]) == {"median", "p95", "max"}
    assert 0 < timing["wall_ms_per_frame"]["median"] <= timing["wall_ms_per_frame"]["max"]
    assert timing["cpu_ms_per_frame"] > 0
    assert {"extract", "match", "motion"} <= set(timing["stages_ms"])


def test_metrics_have_the_contracted_figures(run_folder):
    metrics = read_json(run_folder / "metrics.json")
    assert set(metrics) >= {
        "frames", "coverage_percent", "path_length_m", "avg_translation_error_percent",
        "avg_rotation_error_deg_per_m", "final_error_m", "final_error_percent", "ate_rmse_m",
        "segment_lengths_m",
    }  # fmt: skip
    assert metrics["frames"] == PAIRS
    assert metrics["coverage_percent"] == 100.0
    assert metrics["path_length_m"] == pytest.approx(11 * 0.0633, rel=0.02)
    assert 1e-5 < metrics["final_error_m"] < 0.08


def test_the_run_can_be_repeated_from_its_record(run_folder, flight):
    record = read_json(run_folder / "run.json")
    assert record["settings"]["odometry.window"] == 0
    assert record["settings"]["odometry.solver"] == "double_dogleg"
    assert record["source"] == str(flight)
    assert "left and right" in record["source_reason"]
    assert record["versions"]["thermal_stereo_vo"] == __version__
    assert record["calibration"]["cameras"]["right"]["T_rig_camera"][0][3] == 0.25


def test_a_second_run_gives_the_same_numbers(run_folder, flight, tmp_path, capsys):
    """Same seed, same bits, whatever the threads did; and not quiet, it says what it does."""
    output = tmp_path / "again"
    assert main(["replay", str(flight), "--output", str(output), "--no-plot", "--set",
                 "odometry.window=0"]) == DONE  # fmt: skip
    said = capsys.readouterr()
    assert said.err == ""
    assert "pair of image folders" in said.out
    assert "no ground truth" in said.out
    assert f"results are in {output}" in said.out
    assert not (output / "trajectory.png").exists()
    assert not (output / "metrics.json").exists()
    for name in ("trajectory.tum", "trajectory_kitti.txt"):
        assert (output / name).read_text() == (run_folder / name).read_text()


def test_results_are_a_bag_that_can_be_read_again(run_folder, capsys):
    assert main(["evaluate", str(run_folder / "result.mcap"), str(run_folder / "trajectory.tum"),
                 "--quiet"]) == DONE  # fmt: skip
    assert capsys.readouterr().err == ""


def test_yaml_of_the_dump_is_commented(capsys):
    main(["dump-config"])
    text = capsys.readouterr().out
    assert "# Stop when no component of the gradient is larger. [0..1]" in text
    assert yaml.safe_load(text)["odometry"]["method"] == "feature"
