"""Runs of a visible + thermal rig by both cameras together and by each alone.

The pictures of a preset are rendered once for all cases and seeds; each finished cell is a file, so
that a sweep that was stopped goes on.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.sweep import kept_pictures
from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE, RigCalibration
from thermal_stereo_vo.core.config import flatten, with_overrides
from thermal_stereo_vo.core.errors import ConfigError, DatasetError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.registry import open_dataset, require_calibration
from thermal_stereo_vo.datasets.simulated import SimulatedDataset, open_simulated
from thermal_stereo_vo.evaluation.band_cell import BandCell, band_cell_name, make_band_cell
from thermal_stereo_vo.pipeline import Config, Pipeline, rig_rectifier

BANDS = (VISIBLE, THERMAL)


@dataclass(frozen=True)
class Contender:
    """A method and the cameras it is given; ``rig`` is a setting of the simulation."""

    settings: tuple[str, ...]
    cameras: tuple[str, ...]
    rig: str = "visible_thermal"

    def told_pose(self, calibration: RigCalibration, config: Config) -> NDArray[np.float64]:
        """``T_rig_told`` (4, 4): whose poses it tells, in the rig.

        One camera alone tells its own, in axes of the rig: it knows no size, so no lever arm.
        """
        T_rig_told = rig_rectifier(config, calibration).T_rig_rectified.copy()
        if len(self.cameras) == 1:
            T_rig_told[:3, 3] = calibration[self.cameras[0]].T_rig_camera[:3, 3]
        return T_rig_told


BOTH = "both"
CONTENDERS = {
    BOTH: Contender(("odometry.method=multispectral",), BANDS),
    VISIBLE: Contender(("odometry.method=multispectral",), (VISIBLE,)),
    THERMAL: Contender(("odometry.method=multispectral",), (THERMAL,)),
    "feature": Contender(("odometry.method=feature",), ("left", "right"), "stereo"),
}
"""Name -> contender.  ``feature`` is carried along the same path by the thermal stereo rig."""

CASES = {
    "calm": ("ffc.mode=none",),
    "nuc": ("ffc.mode=periodic", "ffc.first_s=10", "ffc.period_s=10", "ffc.duration_s=0.5"),
    "dark": ("ffc.mode=none", "visible.dark_first_s=30", "visible.dark_s=10"),
}
"""What may follow a preset after ``+``: no corrections, one each 10 s, 10 s without light."""

FLIGHTS = (
    *(f"ms-{n:02d}" for n in range(1, 8)),
    *(f"ms-07+{case}" for case in CASES),
    "ms-forward",
    "ms-still",
    "ms-dusk",
)


@dataclass(frozen=True)
class BandSweep:
    """What is flown.  ``rate_hz``, ``length_m`` and ``duration_s`` None keep those of the presets.

    ``source`` takes a recording in place of the ``flights``.
    """

    flights: tuple[str, ...] = FLIGHTS
    contenders: tuple[str, ...] = (BOTH, VISIBLE, THERMAL)
    seeds: tuple[int, ...] = (0, 1, 2)
    rate_hz: float | None = None
    length_m: float | None = None
    duration_s: float | None = None
    config: Config = field(default_factory=Config)
    simulation: tuple[str, ...] = ()
    source: str | None = None

    def settings(self) -> dict[str, Any]:
        """Everything that changes a cell."""
        digest = hashlib.sha256(repr(sorted(flatten(self.config).items())).encode())
        return {
            "source": self.source,
            "rate_hz": self.rate_hz,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
            "simulation": list(self.simulation),
            "settings": digest.hexdigest()[:16],
        }

    def simulated(
        self, flight: str, rig: str, seed: int, more: Sequence[str] = ()
    ) -> SimulatedDataset:
        """The run of this flight with this rig and the sensors of this seed.

        Raises ConfigError for an unknown case.
        """
        preset, plus, case = flight.partition("+")
        if plus and case not in CASES:
            raise ConfigError(f"there is no case '{case}': choose from {', '.join(CASES)}")
        # ms presets bring their rig, and pictures that others may have kept.
        rigged = () if rig == "visible_thermal" else (f"rig={rig}",)
        duration = () if self.duration_s is None else (f"duration_s={self.duration_s}",)
        overrides = (*CASES.get(case, ()), *rigged, *duration, *self.simulation, *more)
        return open_simulated(
            preset,
            SourceOptions(
                rate_hz=self.rate_hz, length_m=self.length_m, seed=seed, overrides=overrides
            ),
        )

    def recorded(self) -> Dataset:
        """The recording, as a rig of two bands (see ``as_bands``)."""
        assert self.source is not None
        options = SourceOptions(rate_hz=self.rate_hz, length_m=self.length_m)
        return as_bands(open_dataset(self.source, options)[0])


@dataclass(frozen=True)
class Run:
    """One flight with one seed, and the contenders whose cells are missing."""

    flight: str
    seed: int
    contenders: tuple[str, ...]


@dataclass(frozen=True)
class BandJob:
    """Runs that share the pictures in ``pictures`` (None: a folder that goes away)."""

    sweep: BandSweep
    rig: str
    runs: tuple[Run, ...]
    pictures: str | None = None
    forget: bool = False
    render_workers: int = 0

    def frames(self) -> int:
        """How many instants it will take in."""
        return sum((self._dataset(run).instants() or 0) for run in self.runs)

    def in_parallel(self, processes: int) -> BandJob:
        """The same, with so many processes that render for it."""
        return replace(self, render_workers=processes)

    def fly(self, on_frame: Callable[[], None] = lambda: None) -> Iterator[BandCell]:
        """Fly all runs; yields each cell when it is done."""
        before = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            with kept_pictures(self.pictures, self.forget) as pictures:
                more = (f"render.cache={pictures}", f"render.workers={self.render_workers}")
                for run in self.runs:
                    yield from fly_run(self.sweep.config, self._dataset(run, more), run, on_frame)
        finally:
            cv2.setNumThreads(before)

    def _dataset(self, run: Run, more: Sequence[str] = ()) -> Dataset:
        if self.sweep.source is not None:
            return self.sweep.recorded()
        return self.sweep.simulated(run.flight, self.rig, run.seed, more)


def open_band_jobs(
    sweep: BandSweep, cells: Path, pictures: Path | None, *, forget: bool = False
) -> list[BandJob]:
    """A job for each preset and rig that has cells missing in ``cells``.

    Raises SimulationError for an unknown flight, ConfigError for an unknown contender or case.
    """
    unknown = [name for name in sweep.contenders if name not in CONTENDERS]
    if unknown:
        known = ", ".join(CONTENDERS)
        raise ConfigError(f"there is no contender '{unknown[0]}': choose from {known}")
    runs: dict[tuple[str, str], list[Run]] = {}
    flights = sweep.flights if sweep.source is None else (sweep.recorded().name,)
    for flight in flights:
        for rig in dict.fromkeys(CONTENDERS[name].rig for name in sweep.contenders):
            if sweep.source is None:
                sweep.simulated(flight, rig, 0)  # refuses what cannot be flown
            mine = [name for name in sweep.contenders if CONTENDERS[name].rig == rig]
            for seed in sweep.seeds:
                missing = tuple(
                    name
                    for name in mine
                    if not (cells / f"{band_cell_name(flight, name, seed)}.json").is_file()
                )
                if missing:
                    preset = flight.partition("+")[0]
                    runs.setdefault((preset, rig), []).append(Run(flight, seed, missing))
    return [
        BandJob(
            sweep,
            rig,
            tuple(mine),
            None if pictures is None else str(pictures / f"{preset}_{rig}"),
            forget,
        )
        for (preset, rig), mine in runs.items()
    ]


def fly_run(
    config: Config, dataset: Dataset, run: Run, on_frame: Callable[[], None] = lambda: None
) -> Iterator[BandCell]:
    """Give the frames of one recording to all contenders of a run."""
    calibration = require_calibration(dataset)
    truth = dataset.ground_truth()
    if truth is None:
        raise DatasetError(f"'{dataset.name}' knows no true path: nothing could be measured")
    settings = {
        name: with_overrides(
            config,
            (*CONTENDERS[name].settings, f"odometry.seed={run.seed}", "odometry.threads=1"),
        )
        for name in run.contenders
    }
    pipelines = {name: Pipeline(settings[name], calibration) for name in run.contenders}
    results: dict[str, list[OdometryResult]] = {name: [] for name in run.contenders}
    spent_ms: dict[str, list[float]] = {name: [] for name in run.contenders}
    for pipeline in pipelines.values():
        pipeline.warm_up()
    for raw in dataset.frames():
        for name, pipeline in pipelines.items():
            if raw.camera in CONTENDERS[name].cameras:
                start = time.perf_counter()
                found = list(pipeline.push(raw))
                if found:
                    spent_ms[name].append((time.perf_counter() - start) * 1e3 / len(found))
                results[name] += found
        if raw.camera == dataset.cameras[0]:
            on_frame()
    for name, pipeline in pipelines.items():
        results[name] += pipeline.flush()
        pipeline.close()
        T_rig_told = CONTENDERS[name].told_pose(calibration, settings[name])
        seen = Trajectory(truth.stamps_ns, truth.T_world_rig @ T_rig_told)
        frame_ms = float(np.median(spent_ms[name])) if spent_ms[name] else 0.0
        yield make_band_cell(run.flight, name, run.seed, results[name], seen, frame_ms)


def as_bands(dataset: Dataset) -> Dataset:
    """A rig of two bands as it is; the first eye of a stereo recording as a visible camera.

    The other eye becomes a thermal camera that never delivers a picture.
    """
    return dataset if set(BANDS) <= set(dataset.cameras) else _FirstEye(dataset)


class _FirstEye:
    """The first camera of a recording under the name of a visible one."""

    cameras: tuple[str, ...] = BANDS

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.name = f"{dataset.name}-{dataset.cameras[0]}"

    def calibration(self) -> RigCalibration:
        """The rig under the other names."""
        given = require_calibration(self._dataset)
        first, second = self._dataset.cameras[:2]
        named = {VISIBLE: given[first], THERMAL: given[second]}
        return replace(given, cameras=named, rectified=False)

    def frames(self) -> Iterator[RawFrame]:
        """Those of the first camera."""
        for raw in self._dataset.frames():
            if raw.camera == self._dataset.cameras[0]:
                yield replace(raw, camera=VISIBLE)

    def ground_truth(self) -> Trajectory | None:
        """As recorded."""
        return self._dataset.ground_truth()

    def instants(self) -> int | None:
        """As recorded."""
        return self._dataset.instants()
