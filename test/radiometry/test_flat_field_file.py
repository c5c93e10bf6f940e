from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field import FlatFieldCalibration
from thermal_stereo_vo.radiometry.flat_field_file import load_flat_field, save_flat_field


@pytest.fixture
def calibration(rng: np.random.Generator) -> FlatFieldCalibration:
    return FlatFieldCalibration(
        serial="42",
        camera="left",
        minimum_kelvin=280.0,
        maximum_kelvin=320.0,
        centre_kelvin=300.0,
        scale_kelvin=20.0,
        level=np.array([8000.0, -60.0]),
        offset=rng.normal(0, 30, (3, 12, 16)).astype(np.float32),
        gain=rng.normal(1, 0.03, (1, 12, 16)).astype(np.float32),
        bad=rng.random((12, 16)) > 0.9,
        fpa_kelvin=np.array([280.0, 320.0]),
        uncorrected_counts=np.array([40.0, 50.0]),
        residual_counts=np.array([0.4, 0.5]),
    )


@pytest.fixture
def file(tmp_path, calibration) -> Path:
    path = tmp_path / "left.npz"
    save_flat_field(path, calibration)
    return path


def test_what_is_written_is_read(file, calibration):
    assert [path.name for path in file.parent.iterdir()] == ["left.npz"]
    found = load_flat_field(file)
    for name, value in vars(calibration).items():
        np.testing.assert_array_equal(getattr(found, name), value)
    assert found.level_at(310.0) == pytest.approx(7970.0)


def rewrite(file: Path, **changes: object) -> None:
    with np.load(file) as archive:
        fields = {name: archive[name] for name in archive.files}
    fields.update(changes)
    np.savez(file, **{name: value for name, value in fields.items() if value is not None})


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda p: p.unlink(), "there is no flat field .* leave flat_field.file empty"),
        (lambda p: p.write_bytes(b""), "left.npz is damaged or no .npz file"),
        (lambda p: p.write_bytes(p.read_bytes()[:-700]), "left.npz is damaged"),
        (lambda p: p.write_bytes(b"hello, I am text"), "left.npz is damaged"),
        (lambda p: np.save(p.open("wb"), np.ones(3)), "left.npz is damaged"),
        (lambda p: np.savez(p, frames=np.ones(3)), "is no flat field: give a file made by"),
        (lambda p: rewrite(p, version=7), "version 7, this program reads version 1"),
        (lambda p: rewrite(p, gain=None, bad=None), "lacks gain, bad: calibrate again"),
        (lambda p: rewrite(p, gain=np.ones((1, 2, 2))), "left.npz: offset .* do not fit together"),
        (lambda p: rewrite(p, level=np.array([np.inf])), "left.npz: .* not finite"),
        (lambda p: rewrite(p, centre_kelvin="warm"), "fields of the wrong kind"),
    ],
)
def test_unusable_files_say_why(file, spoil, match):
    spoil(file)
    with pytest.raises(CalibrationError, match=match):
        load_flat_field(file)


def test_one_flipped_byte_in_a_map_is_seen(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0xFF
    file.write_bytes(bytes(data))
    with pytest.raises(CalibrationError, match="damaged"):
        load_flat_field(file)


def test_a_failed_write_leaves_the_old_file(file, calibration, tmp_path):
    before = file.read_bytes()
    (tmp_path / "left.npz.part").mkdir()
    with pytest.raises(CalibrationError, match="cannot write the flat field"):
        save_flat_field(file, calibration)
    assert file.read_bytes() == before


def test_no_pickle_is_ever_loaded(tmp_path):
    np.savez(tmp_path / "evil.npz", format=np.array([{"a": 1}], dtype=object))
    with pytest.raises(CalibrationError, match="damaged"):
        load_flat_field(tmp_path / "evil.npz")
