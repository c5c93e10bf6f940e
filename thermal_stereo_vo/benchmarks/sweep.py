"""Many simulated flights by many methods: on the cores of this machine, or on a Dask cluster.

The pictures of a flight are rendered once and seen by the sensors of every seed; every method takes
the same frames.  Each finished cell is a file, so that a sweep that was stopped goes on.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import multiprocessing
import queue
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2

from thermal_stereo_vo.benchmarks.recorded import rectified_truth
from thermal_stereo_vo.core.config import flatten, with_overrides
from thermal_stereo_vo.core.errors import ConfigError, SimulationError
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import SimulatedDataset, open_simulated
from thermal_stereo_vo.evaluation.flight_cell import METHODS, Cell, cell_name, make_cell, save_cell
from thermal_stereo_vo.outputs.replacing import write_text
from thermal_stereo_vo.outputs.run_folder import to_json
from thermal_stereo_vo.pipeline import Config, Pipeline
from thermal_stereo_vo.stereo.rectification import Rectifier

FLIGHTS = tuple(f"seq{i}" for i in range(1, 10))
SETTINGS_FILE = "sweep.json"
CELLS_FOLDER = "cells"
CONNECT_S = 10.0
POLL_S = 0.2


@dataclass(frozen=True)
class Sweep:
    """What is flown.  ``rate_hz`` and ``length_m`` None keep those of the presets."""

    flights: tuple[str, ...] = FLIGHTS
    methods: tuple[str, ...] = tuple(METHODS)
    seeds: tuple[int, ...] = (0, 1, 2)
    rate_hz: float | None = None
    length_m: float | None = None
    config: Config = field(default_factory=Config)
    simulation: tuple[str, ...] = ()

    def settings(self) -> dict[str, Any]:
        """Everything that changes a cell."""
        digest = hashlib.sha256(repr(sorted(flatten(self.config).items())).encode())
        return {
            "rate_hz": self.rate_hz,
            "length_m": self.length_m,
            "simulation": list(self.simulation),
            "settings": digest.hexdigest()[:16],
        }

    def dataset(self, flight: str, seed: int, more: Sequence[str] = ()) -> SimulatedDataset:
        """The run of this flight with the sensors of this seed."""
        return open_simulated(
            flight,
            SourceOptions(
                rate_hz=self.rate_hz,
                length_m=self.length_m,
                seed=seed,
                overrides=(*self.simulation, *more),
            ),
        )


class CellFile(Protocol):
    """Figures of one run, a dataclass; ``name`` is fit for a file name."""

    @property
    def name(self) -> str:
        """Unique within a sweep."""


class Job(Protocol):
    """Runs that share their pictures."""

    def in_parallel(self, processes: int) -> Job:
        """The same, with so many processes that render for it."""

    def fly(self, on_frame: Callable[[], None]) -> Iterator[Any]:
        """Fly what is missing; yields each cell (a ``CellFile``) when it is done."""


@dataclass(frozen=True)
class FlightJob:
    """One flight: for each seed the methods whose cells are missing.

    ``pictures`` is where the noise-free pictures are kept; None uses a folder that goes away.  With
    ``forget`` they are removed once all seeds have flown.
    """

    sweep: Sweep
    flight: str
    missing: tuple[tuple[int, tuple[str, ...]], ...]
    pictures: str | None = None
    forget: bool = False
    render_workers: int = 0

    @property
    def cells(self) -> int:
        """How many cells it will give."""
        return sum(len(methods) for _, methods in self.missing)

    def frames(self) -> int:
        """How many pairs it will take in."""
        seeds = len(self.missing)
        return seeds * self.sweep.dataset(self.flight, 0).instants() if seeds else 0

    def in_parallel(self, processes: int) -> FlightJob:
        """The same, with so many processes that render for it."""
        return dataclasses.replace(self, render_workers=processes)

    def fly(self, on_frame: Callable[[], None]) -> Iterator[Cell]:
        """As the function ``fly``."""
        return fly(self, on_frame)


def claim_folder(folder: Path, settings: Mapping[str, Any]) -> Path:
    """Make ``folder`` the one of a sweep with these settings; returns where its cells go.

    Raises ConfigError when it holds a sweep with other settings, or something else.
    """
    note = folder / SETTINGS_FILE
    try:
        if note.is_file():
            theirs = json.loads(note.read_text(encoding="utf-8"))
            ours = json.loads(to_json(settings))
            if theirs != ours:
                names = [name for name in ours if theirs.get(name) != ours[name]]
                raise ConfigError(
                    f"{folder} holds a sweep with another {', '.join(names)}: give another "
                    "--output, or remove it"
                )
        elif folder.exists() and any(folder.iterdir()):
            raise ConfigError(
                f"the output folder {folder} is not empty and holds no sweep: give a new folder"
            )
        (folder / CELLS_FOLDER).mkdir(parents=True, exist_ok=True)
        write_text(note, to_json(settings))
    except OSError as error:
        raise ConfigError(
            f"the output folder {folder} cannot be written: {error.strerror}"
        ) from None
    return folder / CELLS_FOLDER


def open_jobs(
    sweep: Sweep, cells: Path, pictures: Path | None, *, forget: bool = False
) -> list[FlightJob]:
    """A job for each flight that has cells missing in ``cells``.

    Raises SimulationError for an unknown flight and ConfigError for an unknown method.
    """
    unknown = [method for method in sweep.methods if method not in METHODS]
    if unknown:
        raise ConfigError(f"there is no method '{unknown[0]}': choose from {', '.join(METHODS)}")
    jobs = []
    for flight in sweep.flights:
        sweep.dataset(flight, 0)  # refuses what cannot be flown, before hours are spent
        missing = []
        for seed in sweep.seeds:
            methods = tuple(
                method
                for method in sweep.methods
                if not (cells / f"{cell_name(flight, method, seed)}.json").is_file()
            )
            if methods:
                missing.append((seed, methods))
        if missing:
            place = None if pictures is None else str(pictures / flight)
            jobs.append(FlightJob(sweep, flight, tuple(missing), place, forget))
    return jobs


def fly(job: FlightJob, on_frame: Callable[[], None] = lambda: None) -> Iterator[Cell]:
    """Fly one flight with every seed; yields each cell when it is done."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with kept_pictures(job.pictures, job.forget) as pictures:
            more = (f"render.cache={pictures}", f"render.workers={job.render_workers}")
            for seed, methods in job.missing:
                dataset = job.sweep.dataset(job.flight, seed, more)
                yield from _fly_once(job, dataset, seed, methods, on_frame)
    finally:
        cv2.setNumThreads(before)


def fly_whole(job: FlightJob) -> list[Cell]:
    """All cells of a job: what a worker of a cluster does."""
    return list(fly(job))


def run_here(
    jobs: Sequence[Job],
    cells: Path,
    processes: int,
    *,
    on_frame: Callable[[], None] = lambda: None,
    on_cell: Callable[[Any], None] = lambda cell: None,
) -> None:
    """Fly all jobs with so many processes of this machine; 0 flies in this one.

    Raises SimulationError when a process dies, as it does where memory ends; finished cells stay.
    """
    if processes == 0:
        for job in jobs:
            for cell in job.fly(on_frame):
                save_cell(cells, cell)
                on_cell(cell)
        return
    if len(jobs) == 1:  # one flight at a time: the others may render for it
        jobs = [jobs[0].in_parallel(processes)]
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        news: queue.Queue[Any] = manager.Queue()
        pool = ProcessPoolExecutor(processes, mp_context=context)
        try:
            futures = [pool.submit(_fly_and_save, job, cells, news) for job in jobs]
            while not all(future.done() for future in futures):
                _pass_on(news, on_frame, on_cell, POLL_S)
            _pass_on(news, on_frame, on_cell, 0.0)
            _check(futures)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def run_on_cluster(
    jobs: Sequence[FlightJob],
    cells: Path,
    scheduler: str,
    *,
    on_cell: Callable[[Cell], None] = lambda cell: None,
) -> None:
    """Fly all jobs, one flight a task, on the Dask cluster whose scheduler listens there.

    The package must be installed on its workers.  Raises ConfigError when Dask is not installed or
    no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise ConfigError(
            "--scheduler needs Dask, which is not installed: pip install distributed"
        ) from None
    try:
        client = Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no Dask scheduler answers at {scheduler}: start one with 'dask scheduler' and give "
            f"the address it prints, such as tcp://host:8786 ({' '.join(str(error).split())})"
        ) from None
    with client:
        futures = [client.submit(fly_whole, job, pure=False) for job in jobs]
        for _, found in as_completed(futures, with_results=True):
            for cell in found:
                save_cell(cells, cell)
                on_cell(cell)


def _fly_once(
    job: FlightJob,
    dataset: SimulatedDataset,
    seed: int,
    methods: Sequence[str],
    on_frame: Callable[[], None],
) -> Iterator[Cell]:
    calibration = dataset.calibration()
    pipelines = {}
    for method in methods:
        settings = (*METHODS[method], f"odometry.seed={seed}", "odometry.threads=1")
        pipelines[method] = Pipeline(with_overrides(job.sweep.config, settings), calibration)
    results: dict[str, list[OdometryResult]] = {method: [] for method in methods}
    for raw in dataset.frames():
        for method, pipeline in pipelines.items():
            results[method] += pipeline.push(raw)
        if raw.camera == dataset.cameras[0]:
            on_frame()
    for method, pipeline in pipelines.items():
        results[method] += pipeline.flush()
        pipeline.close()
    rectifier = Rectifier(calibration, job.sweep.config.rectification)
    truth = rectified_truth(dataset.ground_truth(), rectifier)
    for method in methods:
        yield make_cell(job.flight, method, seed, results[method], truth)


@contextmanager
def kept_pictures(folder: str | None, forget: bool) -> Iterator[str]:
    """A folder for pictures: the given one, removed at last with ``forget``, or a passing one."""
    if folder is not None:
        yield folder
        if forget:
            shutil.rmtree(folder, ignore_errors=True)
        return
    with tempfile.TemporaryDirectory(prefix="pictures_") as temporary:
        yield temporary


def _fly_and_save(job: Job, cells: Path, news: queue.Queue[Any]) -> None:
    for cell in job.fly(lambda: news.put(None)):
        save_cell(cells, cell)
        news.put(cell)


def _pass_on(
    news: queue.Queue[Any],
    on_frame: Callable[[], None],
    on_cell: Callable[[Any], None],
    wait_s: float,
) -> None:
    """Tell all that came in; waits so long for the first piece."""
    try:
        item = news.get(timeout=wait_s) if wait_s > 0.0 else news.get_nowait()
        while True:
            if item is None:
                on_frame()
            else:
                on_cell(item)
            item = news.get_nowait()
    except queue.Empty:
        return


def _check(futures: Sequence[Future[None]]) -> None:
    for future in futures:
        try:
            future.result()
        except BrokenProcessPool:
            raise SimulationError(
                "a process of the sweep has died, perhaps for want of memory: start the sweep "
                "again to go on where it stopped, with fewer --processes"
            ) from None
