from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.datasets.simulated import open_simulated

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = ["--set", "render.scale=0.125", "--workers", "0", "--set", "world.density=0.1"]


def test_a_bag_holds_what_the_run_holds(tmp_path, capsys) -> None:
    bag = tmp_path / "flight"
    arguments = ["simulate", "corridor", "--output", str(bag), "--set", "duration_s=0.9", *SMALL]
    arguments += ["--set", "ffc.mode=periodic", "--set", "ffc.first_s=0.3"]
    assert main(arguments) == 0
    assert "20 images of left, right over" in capsys.readouterr().out
    recorded, _ = open_dataset(bag)
    overrides = ("render.scale=0.125", "render.workers=0", "world.density=0.1", "duration_s=0.9",
                 "ffc.mode=periodic", "ffc.first_s=0.3")  # fmt: skip
    simulated = open_simulated("corridor", SourceOptions(overrides=overrides))
    for a, b in zip(recorded.frames(), simulated.frames(), strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        assert (a.camera, a.stamp_ns) == (b.camera, b.stamp_ns)
        assert a.telemetry.ffc_state is b.telemetry.ffc_state
    truth, expected = recorded.ground_truth(), simulated.ground_truth()
    np.testing.assert_allclose(truth.T_world_rig, expected.T_world_rig, atol=1e-9)
    rig, original = recorded.calibration(), simulated.calibration()
    np.testing.assert_allclose(rig.T_a_b(RIGHT, LEFT), original.T_a_b(RIGHT, LEFT), atol=1e-9)
    assert rig[LEFT].camera == original[LEFT].camera
    rates = [s.rate_rad_s for s in recorded.imu()]
    np.testing.assert_allclose(rates, [s.rate_rad_s for s in simulated.imu()], atol=1e-12)


def test_the_topics_of_a_bag(tmp_path, capsys) -> None:
    bag = tmp_path / "flight"
    main(["simulate", "blackbody", "--output", str(bag), "--set", "duration_s=0.5", "--quiet",
          "--set", "ffc.mode=periodic", "--set", "ffc.first_s=0.1", *SMALL])  # fmt: skip
    assert capsys.readouterr().out == ""
    main(["inspect-bag", str(bag)])
    told = capsys.readouterr().out
    for topic in ("/left/image_raw", "/right/camera_info", "/left/status", "/ground_truth",
                  "/imu/data", "/gps/fix", "/gps/position", "/simulation/corrections"):  # fmt: skip
        assert topic in told, topic
    line = next(line for line in told.splitlines() if line.startswith("/imu/data"))
    assert "200.00" in line


def test_presets_and_settings_are_listed(capsys) -> None:
    assert main(["simulate", "--list"]) == 0
    told = capsys.readouterr().out
    assert "seq6" in told
    assert "489 m at 9 pm" in told
    assert main(["simulate", "seq6", "--settings"]) == 0
    assert "weather: clear_cold_night" in capsys.readouterr().out


def test_a_preview_is_one_picture(tmp_path) -> None:
    import cv2

    sheet = tmp_path / "sheet.png"
    assert main(["simulate", "blackbody", "--preview", str(sheet), *SMALL]) == 0
    assert cv2.imread(str(sheet), cv2.IMREAD_UNCHANGED).shape == (480, 960)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "name a preset; --list shows them all"),
        (["seq10"], "there is no preset 'seq10': choose one of seq1"),
        (["hover"], "say where the bag shall go: --output BAG"),
        (["hover", "--set", "thermal.netd=1", "--output", "x"], "did you mean 'thermal.netd_mk'"),
        (["hover", "--set", "thermal", "--output", "x"], "--set takes key=value"),
        (["seq4", "--length", "-3", "--output", "x"], "flight.length_m = -3 is out of range"),
        (["--compare-real", "/nowhere", "--output", "x"], "holds no recording to compare with"),
    ],
)
def test_wrong_use_ends_with_one_line(arguments, text, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments]) == 2
    told = capsys.readouterr()
    assert text in told.err
    assert told.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_bag_is_kept(tmp_path, capsys) -> None:
    (tmp_path / "flight").mkdir()
    assert main(["simulate", "blackbody", "--output", str(tmp_path / "flight"), *SMALL]) == 2
    assert "exists already" in capsys.readouterr().err


def test_an_interruption_leaves_nothing_behind(tmp_path) -> None:
    """Ctrl-C in the middle of a run with a process of its own: all gone, exit code 130."""
    running = subprocess.Popen(
        [sys.executable, "-m", "thermal_stereo_vo", "simulate", "blackbody", "--output",
         str(tmp_path / "flight"), "--set", "duration_s=4", "--set", "rate_hz=500",
         "--set", "render.scale=0.125", "--workers", "1"],
        cwd=REPOSITORY, stderr=subprocess.PIPE, text=True, start_new_session=True,
        # An interruption inside the tracer of coverage would leave its lock held for ever.
        env={key: value for key, value in os.environ.items() if not key.startswith("COV")},
        # A shell starts what it puts into the background deaf to SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 600.0
    while not any(p.stat().st_size > 0 for p in tmp_path.rglob("*.mcap")):
        assert time.monotonic() < deadline, "the run never started to write"
        assert running.poll() is None, "the run ended before it could be interrupted"
        time.sleep(0.2)
    os.killpg(running.pid, signal.SIGINT)
    _, told = running.communicate(timeout=600)
    assert running.returncode == 130
    assert "interrupted" in told
    assert list(tmp_path.iterdir()) == []
