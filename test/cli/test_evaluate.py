from __future__ import annotations

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.outputs.trajectory_file import write_tum

N = 200


@pytest.fixture
def files(tmp_path, rng):
    """(estimate, truth) TUM files; the estimate is two percent long and turned about."""
    T, E = np.eye(4), exp_se3([5, 5, 5, 1, 1, 1])
    true, estimated = [], []
    for i in range(N):
        true.append(T)
        estimated.append(E)
        step = exp_se3([0, 0, 0.3, 0, 0.04 * np.sin(0.05 * i), 0])
        T = T @ step
        longer = step.copy()
        longer[:3, 3] *= 1.02
        E = E @ longer @ exp_se3(rng.normal(size=6) * 1e-3)
    stamps_ns = np.arange(N) * 50_000_000
    write_tum(tmp_path / "estimate.tum", Trajectory(stamps_ns, np.array(estimated)))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps_ns, np.array(true)))
    return str(tmp_path / "estimate.tum"), str(tmp_path / "truth.tum")


def test_table_json_and_picture(files, tmp_path, capsys):
    assert main(["evaluate", *files, "--output", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "estimate.tum (TUM file)" in text
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (
        f"average error {metrics['avg_translation_error_percent']:15.3f} %".split()
        == next(line for line in text.splitlines() if line.startswith("average error")).split()[:4]
    )
    assert 1.0 < metrics["avg_translation_error_percent"] < 3.0
    assert metrics["frames"] == N
    assert metrics["coverage_percent"] == 100.0
    assert metrics["scale"] == pytest.approx(1 / 1.02, abs=2e-3)
    picture = cv2.imread(str(tmp_path / "out" / "trajectory.png"))
    assert min(picture.shape[:2]) > 500
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "metrics.json",
        "trajectory.png",
    ]


@pytest.mark.parametrize("alignment", ["origin", "yaw", "se3", "sim3"])
def test_alignment_is_heeded_and_told(files, tmp_path, capsys, alignment):
    out = tmp_path / "out"
    assert main(["evaluate", *files, "--align", alignment, "--output", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["alignment"] == alignment
    told = {"origin": "made equal", "yaw": "4 DoF", "se3": "SE(3)", "sim3": "Sim(3)"}
    final = next(
        line for line in capsys.readouterr().out.splitlines() if line.startswith("final error")
    )
    assert told[alignment] in final
    if alignment == "sim3":
        assert metrics["avg_translation_error_percent"] < 1.0


def test_quiet_says_nothing(files, capsys):
    assert main(["evaluate", *files, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["EST", "gone.tum"], "there is no trajectory gone.tum"),
        (["EST", "GT", "--tolerance", "-1"], "--tolerance must be a positive number, not -1.0"),
        (["EST", "GT", "--rate", "nan"], "--rate must be a positive number, not nan"),
        (["EST", "GT", "--output", "EST"], "estimate.tum cannot be written: File exists"),
    ],
)
def test_wrong_use_ends_with_one_line_and_code_two(files, capsys, arguments, message):
    estimate, truth = files
    named = [{"EST": estimate, "GT": truth}.get(word, word) for word in arguments]
    assert main(["evaluate", *named]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.startswith("error: ")
    assert len(captured.err.splitlines()) == 1


def test_trajectories_of_different_clocks_leave_nothing_behind(files, tmp_path, capsys):
    late = Trajectory(np.array([10**15]), np.eye(4)[None])
    write_tum(tmp_path / "late.tum", late)
    code = main(["evaluate", files[0], str(tmp_path / "late.tum"), "--output", str(tmp_path / "o")])
    assert code == 2
    assert "no stamp of the estimate" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_help_loads_nothing_heavy():
    program = (
        "import sys; from thermal_stereo_vo.cli.main import main\n"
        "try: main(['evaluate', '--help'])\n"
        "except SystemExit as error: code = error.code\n"
        "heavy = {'cv2', 'numba', 'scipy', 'matplotlib', 'rosbags'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else code)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "--align {origin,yaw,se3,sim3}" in run.stdout
