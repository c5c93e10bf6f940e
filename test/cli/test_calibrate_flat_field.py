from __future__ import annotations

import argparse

import numpy as np
import pytest

from thermal_stereo_vo.cli.calibrate_flat_field import add_flat_field_arguments, run_flat_field
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field_file import load_flat_field

SHAPE = (40, 60)


def run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    add_flat_field_arguments(parser)
    return run_flat_field(parser.parse_args(words))


@pytest.fixture
def folders(tmp_path, rng):
    """Cold and warm views at several FPA temperatures."""
    offset, response = 30 * rng.standard_normal(SHAPE), 0.02 * rng.standard_normal(SHAPE)
    for name, level in (("cold", 7500.0), ("warm", 8500.0)):
        (tmp_path / name).mkdir()
        for fpa in np.linspace(285, 315, 7):
            image = level + offset * (1 + 0.01 * (fpa - 300)) + response * (level - 8000)
            np.savez(tmp_path / name / f"{fpa:.0f}.npz", frames=image, fpa_kelvin=fpa, serial="123")
    return tmp_path


def test_cold_and_warm_folders_give_gain_and_offset(folders, capsys):
    output = folders / "left.npz"
    code = run(
        f"{folders}/cold=5", f"{folders}/warm=40", "--output", str(output), "--camera", "left"
    )
    assert code == 0
    calibration = load_flat_field(output)
    assert (calibration.serial, calibration.camera) == ("123", "left")
    assert calibration.residual_counts.max() < 0.5
    assert np.ptp(calibration.gain) > 0.01
    text = capsys.readouterr().out
    assert "every second temperature held out: residual 0." in text
    assert f"{output}: flat field of camera 'left', serial 123, 60x40, FPA 11.9 to 41.9" in text
    assert len(text.splitlines()) == 1 + 14 + 2


def test_without_source_temperatures_the_gain_stays_one(folders, capsys):
    output = folders / "flat.npz"
    assert run(f"{folders}/cold", "--output", str(output), "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert (load_flat_field(output).gain == 1).all()


def test_degrees_can_be_chosen(folders):
    output = folders / "flat.npz"
    words = (f"{folders}/cold=5", f"{folders}/warm=40", "--output", str(output), "--quiet")
    run(*words, "--offset-degree", "2", "--gain-degree", "1")
    assert load_flat_field(output).offset.shape == (3, *SHAPE)
    assert load_flat_field(output).gain.shape == (2, *SHAPE)
    run(*words, "--gain-degree", "none")
    assert (load_flat_field(output).gain == 1).all()


def test_another_serial_than_the_frames_carry_is_refused(folders):
    with pytest.raises(CalibrationError, match=r"several cameras \(serial 123, 124\)"):
        run(f"{folders}/cold", "--output", str(folders / "x.npz"), "--serial", "124")
    assert not (folders / "x.npz").exists()


def test_a_path_with_an_equals_sign_is_a_path(tmp_path):
    with pytest.raises(CalibrationError, match=r"there is no recording .*a=b"):
        run(f"{tmp_path}/a=b", "--output", str(tmp_path / "x.npz"))
