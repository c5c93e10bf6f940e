from __future__ import annotations

import argparse
import re

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.cli.benchmark_radiometry import add_radiometry_arguments, run_radiometry
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.evaluation.radiometry_report import (
    clips,
    cost_figures,
    flat_field_figures,
    gate_figures,
    radiometry_report,
    roughness,
)


def run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    add_radiometry_arguments(parser)
    return run_radiometry(parser.parse_args(words))


def test_absent_recordings_are_named_and_the_cost_is_told(tmp_path, capsys):
    assert run("--data", str(tmp_path)) == 0
    lines = capsys.readouterr().out.splitlines()
    left_out = [line for line in lines if line.startswith("left out: there is no ")]
    assert [line.rsplit("/", 1)[1] for line in left_out] == [
        "flat_fields_fpa",
        "lepton_cptv",
        "optris_sweep",
        "euroc_standing_still",
        "lwir_drive",
        "lwir_drive",
    ]
    assert re.fullmatch(
        r"[\d.]+ ms \(median\), [\d.]+ ms \(95 %\), of which gate [\d.]+, flat field [\d.]+, "
        r"gain control [\d.]+",
        lines[-1],
    )


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(DatasetError, match=r"there is no folder .*nowhere"):
        run("--data", str(tmp_path / "nowhere"))


def test_every_stage_costs_something():
    (line,) = cost_figures(pairs=5)
    numbers = [float(number) for number in re.findall(r"[\d.]+(?= ms|,|$)", line)]
    assert all(0.0 < number < 1000.0 for number in numbers)


def test_clips_of_every_kind_are_found(tmp_path, rng):
    frames = rng.integers(0, 255, (6, 32, 48)).astype(np.uint8)
    np.savez(tmp_path / "array.npz", frames=frames.astype(np.uint16) * 50)
    (tmp_path / "cam0").mkdir()
    for k, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / "cam0" / f"{k}.png"), frame)
    writer = cv2.VideoWriter(
        str(tmp_path / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (48, 32)
    )
    for frame in frames:
        writer.write(cv2.merge([frame] * 3))
    writer.release()
    found = {name: list(images) for name, images in clips(tmp_path)}
    assert list(found) == ["array", "film", f"{tmp_path.name}/cam0"]
    assert [len(images) for images in found.values()] == [6, 6, 6]
    np.testing.assert_array_equal(found[f"{tmp_path.name}/cam0"], frames)
    lines = list(gate_figures(tmp_path))
    assert len(lines) == 3
    assert lines[0].startswith("array: 6 frames, 0 events, 0 held back, 0 repeats")


def test_the_figures_of_the_flat_field_follow_from_the_frames(tmp_path, rng):
    """Offsets that are a line in temperature leave rounding alone."""
    base, slope = 50 * rng.standard_normal((2, 24, 32))
    for fpa in np.linspace(280, 320, 12):
        image = 8000 + base + slope * (fpa - 300) / 20
        np.savez(tmp_path / f"{fpa:.1f}.npz", frames=image, fpa_kelvin=fpa)
    lines = list(flat_field_figures(tmp_path))
    assert len(lines) == 1 + 6 + 2 + 2
    mean = re.search(
        r"uncorrected ([\d.]+), offset .* degC ([\d.]+), polynomial ([\d.]+)", lines[7]
    )
    assert mean is not None
    uncorrected, single, polynomial = map(float, mean.groups())
    assert 45 < uncorrected < 75
    assert 15 < single < 50
    assert 0.1 < polynomial < 0.5
    assert "outside a fit of" in lines[9]


def test_roughness_is_the_share_of_gradients():
    image = np.array([[1.0, 2.0], [1.0, 2.0]])
    assert roughness(image) == pytest.approx(2.0 / 6.0)
    assert roughness(np.ones((5, 5))) == 0.0


def test_the_report_on_real_recordings(recording):
    """The promises: 10 times below uncorrected, 3 below one temperature, one event in all."""
    folder = recording("flat_fields_fpa").parent
    text = "\n".join(radiometry_report(folder))
    below, single = re.search(
        r"the polynomial is (\d+) times below uncorrected and (\d+) times below the offset", text
    ).groups()
    assert int(below) > 10
    assert int(single) > 3
    assert text.count("1 events") == 1
    assert "hedgehog: 119 frames, 1 events" in text
