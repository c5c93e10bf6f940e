from __future__ import annotations

import argparse

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.enhancement import (
    VIEWS,
    EnhancementCell,
    enhancement_report,
    measure_views,
    plot_views,
)
from thermal_stereo_vo.benchmarks.shutterless import (
    PATTERN_FREE,
    ShutterlessCell,
    shutterless_report,
    simulated_flat_fields,
    warming_settings,
)
from thermal_stereo_vo.calibration.radiometric import fit_flat_field
from thermal_stereo_vo.cli.benchmark_enhancement import add_enhancement_arguments, run_enhancement
from thermal_stereo_vo.cli.benchmark_shutterless import add_shutterless_arguments, run_shutterless
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.radiometry.flat_field import FlatField, FlatFieldConfig

SETTINGS = (
    *warming_settings(18.0),
    "ffc.mode=none",
    "render.scale=0.2",
    "render.workers=0",
    "render.lag=none",
    "thermal.creep_pixel=0",
    "rate_hz=1.5",
)


def open_flight(*more: str):
    """Four seconds before a uniform wall: the quickest to build and render."""
    return open_simulated("blackbody", SourceOptions(seed=4, overrides=(*SETTINGS, *more)))


def test_the_flat_field_of_a_warming_core_fits_its_own_flight_only():
    """Against the same flight of a core without pattern: what is left is far below what was."""
    flight, clean = open_flight(), open_flight(*PATTERN_FREE)
    fpa = flight.simulation.fpa(0)
    duration_s = flight.simulation.duration_s
    assert 9.0 < fpa.kelvin(duration_s) - fpa.kelvin(0.0) < 14.0
    own, other = (
        FlatField(
            fit_flat_field(simulated_flat_fields(flight.simulation, camera)),
            FlatFieldConfig(temperature_smoothing_s=0.0),
        )
        for camera in (0, 1)
    )
    before, after, exchanged = [], [], []
    for raw, truth in zip(flight.frames(), clean.frames(), strict=True):
        if raw.camera != "left" or raw.stamp_ns == 0:
            continue
        assert raw.telemetry is not None
        kelvin = raw.telemetry.fpa_temperature_kelvin

        def error(image: np.ndarray) -> float:
            difference = image.astype(float) - truth.image  # noqa: B023
            return float(1.4826 * np.median(np.abs(difference - np.median(difference))))

        before.append(error(raw.image))
        after.append(error(own.process(raw.image, kelvin, raw.stamp_ns)))
        exchanged.append(error(other.process(raw.image, kelvin, raw.stamp_ns)))
    assert len(before) >= 3
    assert before[-1] > 30
    assert np.mean(after) < 0.1 * np.mean(before)
    assert max(after) < 3.0
    assert np.mean(exchanged) > 0.5 * np.mean(before)


def test_a_row_for_each_way():
    cells = [
        ShutterlessCell("perfect", 1, 10.0, 0.2, 0.3, 200.0, 0.5, 0),
        ShutterlessCell("perfect", 2, 11.0, 0.4, 0.5, 100.0, 0.3, 1),
        ShutterlessCell("uncorrected", 1, 10.0, None, 9.0, 50.0, 2.0, 3),
    ]
    lines = shutterless_report(cells).splitlines()
    assert lines[2].split() == ["perfect", "2", "10.5", "0.300", "0.400", "150", "0.40", "1"]
    assert lines[3].split() == ["uncorrected", "1", "10.0", "-", "9.000", "50", "2.00", "3"]


@pytest.mark.parametrize(
    ("add", "run"),
    [(add_shutterless_arguments, run_shutterless), (add_enhancement_arguments, run_enhancement)],
)
def test_an_unknown_flight_is_refused(add, run, tmp_path):
    parser = argparse.ArgumentParser()
    add(parser)
    words = ["--preset", "moon", "--quiet", "--cache", str(tmp_path)]
    with pytest.raises(SimulationError, match="moon"):
        run(parser.parse_args(words))


def test_every_mapping_is_flown_and_told(tmp_path):
    """Half a second in place, small pictures: that the numbers are there, not their worth."""
    settings = ("duration_s=0.5", "render.scale=0.25", "render.workers=0", "render.lag=none")
    told = []
    cells = list(measure_views([3], "hover", settings, Config(), tmp_path, lambda: told.append(1)))
    assert [cell.view for cell in cells] == list(VIEWS)
    assert len(told) == len(VIEWS)
    assert all(0.0 <= cell.final_error_m < 0.5 for cell in cells)
    assert all(cell.mean_inliers > 0 for cell in cells)
    assert any(tmp_path.iterdir())
    assert len(enhancement_report(cells).splitlines()) == 2 + len(VIEWS)
    plot_views(tmp_path / "ways.png", cells)
    assert min(cv2.imread(str(tmp_path / "ways.png")).shape[:2]) > 500


def test_a_view_that_shows_nothing_claims_no_accuracy():
    nothing = EnhancementCell("dark", 1, None, 0.0, 0.0, 2.0, np.zeros((1, 3)), np.zeros((1, 3)))
    assert enhancement_report([nothing]).splitlines()[-1].split() == [
        "dark",
        "1",
        "-",
        "-",
        "0",
        "2",
    ]
