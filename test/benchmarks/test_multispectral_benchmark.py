"""Runs of a visible + thermal rig as the benchmark opens, shares and resumes them."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.multispectral import (
    CASES,
    CONTENDERS,
    FLIGHTS,
    BandSweep,
    Run,
    as_bands,
    fly_run,
    open_band_jobs,
)
from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import ConfigError, DatasetError, SimulationError
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.odometry.factory import METHODS
from thermal_stereo_vo.pipeline import Config

needs_the_method = pytest.mark.skipif(
    "multispectral" not in METHODS, reason="there is no method of two bands"
)
TINY = ("render.scale=0.25", "render.lag=none", "world.density=0.1")


def sweep(*flights: str, **changes) -> BandSweep:
    return BandSweep(flights, duration_s=0.4, simulation=TINY, **changes)


def test_flights_that_share_pictures_are_one_job(tmp_path):
    plan = sweep("ms-01", "ms-01+nuc", "ms-02", contenders=("both", "visible", "feature"))
    jobs = open_band_jobs(plan, tmp_path, tmp_path / "pictures")
    told = [(job.rig, [(run.flight, run.seed, run.contenders) for run in job.runs]) for job in jobs]
    assert [job.pictures.rpartition("/")[2] for job in jobs] == [
        "ms-01_visible_thermal",
        "ms-01_stereo",
        "ms-02_visible_thermal",
        "ms-02_stereo",
    ]
    flown = [(flight, seed) for flight in ("ms-01", "ms-01+nuc") for seed in (0, 1, 2)]
    assert told[0] == ("visible_thermal", [(*run, ("both", "visible")) for run in flown])
    assert told[1] == ("stereo", [(*run, ("feature",)) for run in flown])
    assert jobs[0].frames() == 6 * 9


def test_what_is_finished_is_not_flown_again(tmp_path):
    plan = sweep("ms-01", seeds=(0, 1))
    for name in ("ms-01_both_0", "ms-01_visible_0", "ms-01_thermal_0", "ms-01_both_1"):
        (tmp_path / f"{name}.json").touch()
    (job,) = open_band_jobs(plan, tmp_path, None)
    assert job.runs == (Run("ms-01", 1, ("visible", "thermal")),)


def test_cases_change_the_sensors_and_not_the_pictures():
    plan = sweep("ms-01")
    calm = plan.simulated("ms-01+calm", "visible_thermal", 0).simulation
    keys = set()
    for case in CASES:
        simulation = plan.simulated(f"ms-01+{case}", "visible_thermal", 0).simulation
        keys.add(simulation.plan.picture_key())
        assert len(simulation.corrections_s(1)) == 0  # in 0.4 s
    assert keys == {calm.plan.picture_key()}
    long = BandSweep().simulated("ms-01+nuc", "visible_thermal", 0).simulation
    np.testing.assert_allclose(long.corrections_s(1), 10.0 * np.arange(1, 12))
    dark = BandSweep().simulated("ms-01+dark", "visible_thermal", 0).simulation.config.visible
    assert [dark.sees_light(t) for t in (29.9, 30.1, 39.9, 40.1)] == [True, False, False, True]


def test_every_flight_can_be_flown():
    for flight in FLIGHTS:
        assert BandSweep().simulated(flight, "visible_thermal", 0).instants() > 200


@pytest.mark.parametrize(
    ("plan", "error", "message"),
    [
        (sweep("ms-09"), SimulationError, "no preset 'ms-09'"),
        (sweep("ms-01+rain"), ConfigError, "no case 'rain': choose from calm, nuc, dark"),
        (sweep("ms-01", contenders=("dso",)), ConfigError, "no contender 'dso': choose from both"),
    ],
)
def test_what_cannot_be_flown_is_refused_before_anything_is(plan, error, message, tmp_path):
    with pytest.raises(error, match=message):
        open_band_jobs(plan, tmp_path, None)


def test_the_first_eye_of_a_stereo_recording_is_a_visible_camera():
    options = SourceOptions(overrides=(*TINY, "duration_s=0.3", "render.workers=0"))
    stereo = open_simulated("blackbody", options)
    alone = as_bands(stereo)
    assert (alone.name, alone.cameras) == ("blackbody-left", ("visible", "thermal"))
    lefts = [raw for raw in stereo.frames() if raw.camera == "left"]
    for found, raw in zip(alone.frames(), lefts, strict=True):
        assert found.camera == "visible"
        np.testing.assert_array_equal(found.image, raw.image)
    assert alone.calibration()["visible"] == stereo.calibration()["left"]
    two_bands = open_simulated("ms-01", options)
    assert as_bands(two_bands) is two_bands


def test_a_recording_without_a_truth_measures_nothing():
    options = SourceOptions(overrides=(*TINY, "duration_s=0.3", "render.workers=0"))
    dataset = open_simulated("hover", options)
    dataset.ground_truth = lambda: None
    with pytest.raises(DatasetError, match="'hover' knows no true path"):
        list(fly_run(Config(), dataset, Run("hover", 0, ("feature",))))


def test_the_stereo_rig_flies_the_same_path_by_features():
    plan = sweep("ms-01")
    dataset = plan.simulated("ms-01", "stereo", 0, ("render.workers=0",))
    config = with_overrides(Config(), ["odometry.window=0"])
    ticks = []
    (cell,) = fly_run(config, dataset, Run("ms-01", 0, ("feature",)), lambda: ticks.append(1))
    assert (cell.name, cell.frames) == ("ms-01_feature_0", 9)
    assert cell.converged_after_s == 0.0
    assert len(ticks) == 9


@needs_the_method
def test_one_camera_alone_is_compared_with_its_own_path():
    calibration = sweep("ms-01").simulated("ms-01", "visible_thermal", 0).calibration()
    arm = calibration["thermal"].T_rig_camera[:3, 3]
    assert np.linalg.norm(arm) > 0.05
    told = {}
    for name in ("both", "visible", "thermal"):
        config = with_overrides(Config(), CONTENDERS[name].settings)
        told[name] = CONTENDERS[name].told_pose(calibration, config)
        np.testing.assert_array_equal(told[name][:3, :3], np.eye(3))
    np.testing.assert_array_equal(told["both"][:3, 3], 0.0)
    np.testing.assert_array_equal(told["visible"][:3, 3], 0.0)
    np.testing.assert_array_equal(told["thermal"][:3, 3], arm)


@needs_the_method
def test_the_report_of_a_short_run_is_written_and_goes_on(tmp_path, capsys):
    folder = tmp_path / "report"
    arguments = [
        *("benchmark", "multispectral", "--output", str(folder), "--flights", "ms-still"),
        *("--seeds", "1", "--duration", "0.4", "--processes", "0", "--contenders", "both"),
        *(text for setting in TINY for text in ("--set", f"sim.{setting}")),
    ]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "1 runs now, 0 before" in said
    assert "ms-still by both: the scale was never taken for known." in said
    assert {path.name for path in folder.iterdir()} >= {
        "multispectral.md",
        "multispectral.json",
        "ms-still.png",
    }
    assert main([*arguments, "--quiet"]) == 0
    assert main(arguments) == 0
    assert "0 runs now, 1 before" in capsys.readouterr().out
