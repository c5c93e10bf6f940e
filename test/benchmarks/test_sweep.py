"""A sweep of simulated flights: small ones, but flown."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

from thermal_stereo_vo.benchmarks import sweep as sweeps
from thermal_stereo_vo.benchmarks.sweep import (
    FlightJob,
    Sweep,
    claim_folder,
    open_jobs,
    run_here,
    run_on_cluster,
)
from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import ConfigError, SimulationError
from thermal_stereo_vo.evaluation.flight_cell import load_cells
from thermal_stereo_vo.pipeline import Config

SMALL = ("render.scale=0.5", "render.lag=none", "duration_s=4")
ARGUMENTS = [
    "--flights", "corridor", "--methods", "DDL", "windowed", "--seeds", "2", "--rate", "2.5",
    "--length", "20", "--processes", "0", *(f"--set=sim.{text}" for text in SMALL),
]  # fmt: skip
SWEEP = Sweep(("corridor",), ("DDL", "windowed"), (0, 1), 2.5, 20.0, simulation=SMALL)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """(report folder, pictures) of a small sweep, flown by the command."""
    folder = tmp_path_factory.mktemp("sweep") / "report"
    assert main(["benchmark", "table5", "--output", str(folder), *ARGUMENTS, "--quiet"]) == 0
    return folder, folder / "pictures"


def copied(flown, tmp_path):
    """A folder of its own with the cells and settings of the sweep."""
    folder = tmp_path / "report"
    shutil.copytree(flown[0], folder, ignore=shutil.ignore_patterns("pictures"))
    return folder


def test_report_holds_everything(flown):
    folder, _ = flown
    assert {path.name for path in folder.iterdir()} == {
        "cells", "pictures", "sweep.json", "table5.md", "table5.csv", "table5.json", "corridor.png",
    }  # fmt: skip
    cells = load_cells(folder / "cells")
    assert [cell.name for cell in cells] == [
        "corridor_DDL_0", "corridor_DDL_1", "corridor_windowed_0", "corridor_windowed_1",
    ]  # fmt: skip
    frames = SWEEP.dataset("corridor", 0).instants()
    for cell in cells:
        assert cell.frames == frames
        assert 1.0 < cell.path_length_m < 3.0
    # Other sensors, other noise.
    assert cells[0].final_m != cells[1].final_m
    assert cells[2].final_m != cells[3].final_m
    record = json.loads((folder / "table5.json").read_text())
    assert record["settings"]["rate_hz"] == 2.5
    assert record["settings"]["simulation"] == list(SMALL)
    text = (folder / "table5.md").read_text()
    assert "Flights: 1, 20 m each, 2.5 Hz. Machine: " in text
    assert "![corridor](corridor.png)" in text


def test_what_is_finished_is_not_flown_again(flown, tmp_path, capsys, monkeypatch):
    folder = copied(flown, tmp_path)
    monkeypatch.setattr(sweeps, "fly", lambda *_: pytest.fail("nothing is left to fly"))
    assert main(["benchmark", "table5", "--output", str(folder), *ARGUMENTS]) == 0
    text = capsys.readouterr().out
    assert "0 cells flown now, 4 before" in text
    assert "corridor " in text
    assert f"are in {folder}" in text


def test_only_what_is_missing_is_flown_and_comes_out_the_same(flown, tmp_path):
    """In a process of its own, too."""
    folder = copied(flown, tmp_path)
    before = load_cells(folder / "cells")
    (folder / "cells" / "corridor_windowed_1.json").unlink()
    (folder / "cells" / "corridor_DDL_1.json").unlink()
    jobs = open_jobs(SWEEP, folder / "cells", flown[1])
    assert [job.missing for job in jobs] == [((1, ("DDL", "windowed")),)]
    frames, cells = [], []
    run_here(jobs, folder / "cells", 1, on_frame=lambda: frames.append(1), on_cell=cells.append)
    assert [cell.name for cell in cells] == ["corridor_DDL_1", "corridor_windowed_1"]
    assert len(frames) == jobs[0].frames() == before[0].frames
    assert load_cells(folder / "cells") == before


def test_pictures_are_kept_or_forgotten(flown, tmp_path):
    kept = {path.name for path in (flown[1] / "corridor").iterdir()}
    assert kept >= {"left.signal", "right.signal"}
    mine = tmp_path / "pictures"
    shutil.copytree(flown[1], mine)
    folder = copied(flown, tmp_path)
    (folder / "cells" / "corridor_windowed_1.json").unlink()
    arguments = [*ARGUMENTS, "--pictures", str(mine), "--forget-pictures", "--quiet"]
    assert main(["benchmark", "table5", "--output", str(folder), *arguments]) == 0
    assert list(mine.iterdir()) == []
    assert {path.name for path in (flown[1] / "corridor").iterdir()} == kept


def test_pictures_that_nobody_keeps_go_away(flown, tmp_path, monkeypatch):
    """As on a worker of a cluster that shares no folder."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    short = Sweep(rate_hz=4.0, simulation=("render.scale=0.25", "duration_s=0.5"))
    job = FlightJob(short, "blackbody", ((7, ("windowed",)),))
    (cell,) = sweeps.fly_whole(job)
    assert (cell.name, cell.frames) == ("blackbody_windowed_7", 3)
    assert cell.frames == job.frames()
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------ cluster


def test_a_cluster_gives_the_same(flown, tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    folder = copied(flown, tmp_path)
    before = load_cells(folder / "cells")
    for seed in (0, 1):
        (folder / "cells" / f"corridor_DDL_{seed}.json").unlink()
    jobs = open_jobs(SWEEP, folder / "cells", flown[1])
    cells = []
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        dashboard_address=":0",
    ) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tcp://")
        run_on_cluster(jobs, folder / "cells", address, on_cell=cells.append)
    assert sorted(cell.name for cell in cells) == ["corridor_DDL_0", "corridor_DDL_1"]
    assert load_cells(folder / "cells") == before


def test_a_scheduler_that_does_not_answer(tmp_path, monkeypatch, capsys):
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setattr(sweeps, "CONNECT_S", 0.3)
    arguments = [*ARGUMENTS, "--scheduler", "tcp://127.0.0.1:1"]
    assert main(["benchmark", "table5", "--output", str(tmp_path / "report"), *arguments]) == 2
    error = capsys.readouterr().err
    assert "error: no Dask scheduler answers at tcp://127.0.0.1:1: start one with" in error


def test_without_dask_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="needs Dask, which is not installed: pip install"):
        run_on_cluster([], tmp_path, "tcp://127.0.0.1:1")


# ----------------------------------------------------------------------------------------- refusals


def test_a_folder_belongs_to_one_sweep(tmp_path):
    folder = tmp_path / "report"
    assert claim_folder(folder, SWEEP.settings()) == folder / "cells"
    claim_folder(folder, SWEEP.settings())
    more = dataclasses.replace(SWEEP, flights=("seq1",), seeds=(5,))
    claim_folder(folder, more.settings())  # goes on
    other = with_overrides(Config(), ["odometry.windowed.corners.points=300"])
    for change, name in (
        ({"rate_hz": 30.0}, "rate_hz"),
        ({"length_m": None, "simulation": ()}, "length_m, simulation"),
        ({"config": other}, "settings"),
    ):
        with pytest.raises(ConfigError, match=f"holds a sweep with another {name}: give another"):
            claim_folder(folder, dataclasses.replace(SWEEP, **change).settings())


def test_foreign_folders_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(ConfigError, match="is not empty and holds no sweep: give a new folder"):
        claim_folder(tmp_path, SWEEP.settings())
    with pytest.raises(ConfigError, match=r"thesis\.tex cannot be written"):
        claim_folder(tmp_path / "thesis.tex", SWEEP.settings())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--flights", "seq10"], "there is no preset 'seq10': choose one of"),
        (["--methods", "newton"], "there is no method 'newton': choose from GN, LM, DDL, windowed"),
        (["--seeds", "0"], "--seeds must be 1 or more"),
        (["--processes", "-1"], "--processes 0 or more"),
        (["--rate", "0"], "--rate must be positive, got 0"),
        (["--set", "odometry.windw=3"], "unknown setting 'odometry.windw'"),
        (["--set", "sim.render.scal=1"], "unknown setting 'render.scal'"),
    ],
)
def test_wrong_use_is_refused_before_anything_is_flown(arguments, complaint, tmp_path, capsys):
    given = ["--flights", "corridor"] if "--flights" not in arguments else []
    out = str(tmp_path / "report")
    assert main(["benchmark", "table5", "--output", out, *given, *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_death_of_a_process_is_told():
    future: Future[None] = Future()
    future.set_exception(BrokenProcessPool("gone"))
    with pytest.raises(SimulationError, match="start the sweep again to go on where it stopped"):
        sweeps._check([future])
