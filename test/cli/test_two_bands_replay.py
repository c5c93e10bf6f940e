"""A visible + thermal run from the simulator through bag and replay, and what does not fit."""

from __future__ import annotations

import json

import numpy as np
import pytest

from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.calibration_files import load_calibration, save_calibration
from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.odometry.factory import METHODS

needs_the_method = pytest.mark.skipif(
    "multispectral" not in METHODS, reason="there is no method of two bands"
)
TINY = ("render.scale=0.25", "render.lag=none", "duration_s=0.5")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bands") / "bag"
    settings = [text for setting in TINY for text in ("--set", setting)]
    arguments = ["simulate", "ms-07", "--output", str(folder), "--workers", "0", "--quiet"]
    assert main([*arguments, *settings]) == 0
    return folder


def replay(*arguments, capsys, code=0) -> str:
    assert main(["replay", *map(str, arguments)]) == code
    said = capsys.readouterr()
    return said.err if code else said.out


def test_the_bag_knows_its_rig(bag):
    rig = load_calibration(bag)
    assert set(rig.cameras) == {VISIBLE, THERMAL}
    assert 0.08 < np.linalg.norm(rig.T_a_b(VISIBLE, THERMAL)[:3, 3]) < 0.1


def test_a_method_of_eyes_says_what_it_needs(bag, tmp_path, capsys):
    said = replay(bag, "--output", tmp_path / "run", capsys=capsys, code=2)
    assert "the method 'feature' needs the cameras left and right, but" in said
    assert "has visible, thermal" in said
    assert not (tmp_path / "run").exists()


@needs_the_method
def test_the_run_is_replayed_and_says_that_its_scale_is_unknown(bag, tmp_path, capsys):
    """Half a second tells no scale."""
    run = tmp_path / "run"
    said = replay(bag, "--method", "multispectral", "--output", run, capsys=capsys)
    assert "the scale did not converge" in said
    assert {path.name for path in run.iterdir()} >= {"trajectory.tum", "frames.csv", "run.json"}
    column = [line.split(",")[7] for line in (run / "frames.csv").read_text().splitlines()]
    assert set(column[1:]) == {"false"}
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["scale_converged_after_s"] is None
    assert metrics["alignment"] == "sim3"


@needs_the_method
def test_a_stereo_rig_is_no_rig_of_two_bands(tmp_path, capsys):
    said = replay(
        "sim:blackbody", "--method", "multispectral", "--output", tmp_path / "run",
        "--set", "sim.render.scale=0.125", capsys=capsys, code=2,
    )  # fmt: skip
    assert "'multispectral' needs the cameras visible and thermal, but" in said
    assert "choose --method feature or direct" in said


@needs_the_method
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("size", "camera 'visible' gives 160x120 pixels, but the calibration"),
        ("apart", "share 0 % of their views"),
        ("one", "but {rig} has visible: give another calibration"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(bag, tmp_path, capsys, change, complaint):
    from dataclasses import replace

    from thermal_stereo_vo.core.transforms import exp_so3, make_transform

    rig = load_calibration(bag)
    cameras = dict(rig.cameras)
    if change == "size":
        larger = replace(cameras[VISIBLE].camera, width=320, height=240)
        cameras[VISIBLE] = replace(cameras[VISIBLE], camera=larger)
    elif change == "apart":
        turned = make_transform(exp_so3([0.0, np.pi, 0.0]), [0.1, 0.0, 0.0])
        cameras[THERMAL] = replace(cameras[THERMAL], T_rig_camera=turned)
    else:
        del cameras[THERMAL]
    save_calibration(replace(rig, cameras=cameras), tmp_path)
    path = tmp_path / "rig.yaml"
    said = replay(
        bag, "--method", "multispectral", "--calibration", path, "--output", tmp_path / "run",
        capsys=capsys, code=2,
    )  # fmt: skip
    assert complaint.format(rig=path) in said
