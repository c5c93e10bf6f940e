"""The ready settings and the files made from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermal_stereo_vo.capture.grabber_rig import GrabberConfig, GrabberRig
from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.config import from_mapping, load_yaml
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.stereo_capture import StereoCaptureConfig
from thermal_stereo_vo.stereo_capture_presets import PRESETS, preset, preset_text

CONFIG = Path(__file__).resolve().parents[2] / "config"


@pytest.mark.parametrize("name", PRESETS)
def test_the_files_say_what_the_code_says(name):
    path = CONFIG / f"stereo_capture_{name}.yaml"
    text = path.read_text()
    assert text == preset_text(name), (
        f"write it anew: python3 -m thermal_stereo_vo dump-config --capture {name} > {path}"
    )
    assert load_yaml(StereoCaptureConfig, text, origin=path.name) == preset(name)


@pytest.mark.parametrize("name", PRESETS)
def test_the_command_line_prints_them(name, capsys):
    assert main(["dump-config", "--capture", name]) == 0
    assert capsys.readouterr().out == preset_text(name)


@pytest.mark.parametrize("name", PRESETS)
def test_a_rig_can_be_made_of_them(name):
    config = preset(name)
    rig = GrabberRig(config.grabbers)
    assert rig.cameras == ("left", "right")
    assert config.grabbers.left.device == "/dev/thermal_left"
    assert config.grabbers.right.device == "/dev/thermal_right"
    assert config != StereoCaptureConfig()


def test_every_preset_has_a_file_and_every_file_a_preset():
    files = {path.stem.removeprefix("stereo_capture_") for path in CONFIG.glob("stereo_capture_*")}
    assert files == set(PRESETS)


def test_an_unknown_preset(capsys):
    assert main(["dump-config", "--capture", "lepton"]) == 2
    assert "choose sensoray, boson, analog" in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"no preset 'lepton' .* choose sensoray, boson, analog"):
        preset("lepton")


@pytest.mark.parametrize(
    ("settings", "answer"),
    [
        ({}, "left.device is not set; right.device is not set"),
        ({"left": {"device": "/a"}, "right": {"device": "/a"}}, "both '/a'"),
        (
            {"control": {"left_port": "/p", "right_port": "/p"}, "camera": {"agc_filter": "x"}},
            "both '/p'; camera.agc_filter = 'x'",
        ),
    ],
)
def test_contradictions_are_told_all_at_once(settings, answer):
    config = from_mapping(GrabberConfig, settings)
    with pytest.raises(ConfigError, match=answer):
        GrabberRig(config)
