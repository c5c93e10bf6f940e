"""What a flight without shutter costs: simulated cores that warm up, corrected in several ways."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from thermal_stereo_vo.benchmarks.flown import fly
from thermal_stereo_vo.calibration.radiometric import FlatFrame, fit_flat_field
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.radiometry.flat_field_file import save_flat_field
from thermal_stereo_vo.simulation.settings import FfcConfig
from thermal_stereo_vo.simulation.simulation import Simulation
from thermal_stereo_vo.simulation.thermal_camera import SIGNAL_STEP, ThermalCamera
from thermal_stereo_vo.simulation.thermal_field import Responsivity

PATTERN_FREE = tuple(
    f"thermal.{name}=0"
    for name in (
        "drift_pixel_mk",
        "drift_column_mk",
        "drift_row_mk",
        "drift_shading_mk",
        "fixed_pixel",
        "fixed_column",
        "fixed_row",
        "creep_pixel",
        "dome_kelvin",
        "gain_percent",
    )
)
"""Settings of a core whose pixels are all alike."""

WAYS: Mapping[str, tuple[bool, bool, bool]] = {
    "perfect": (True, False, False),
    "uncorrected": (False, False, False),
    "refinement": (False, False, True),
    "flat field": (False, True, False),
    "flat field + refinement": (False, True, True),
}
"""Name -> (core without pattern, stored flat field, scene-based refinement)."""

TEMPERATURES = 12
FRAMES_PER_VIEW = 16
SOURCES_KELVIN = (-15.0, 15.0)
"""Uniform sources of the calibration, relative to the air."""


WARMING_KELVIN = 10.0
SPEED_M_S = 4.5


def warming_settings(length_m: float) -> tuple[str, ...]:
    """Settings of cores that start cold and warm up by some 10 K over a flight of this length."""
    duration_s = length_m / SPEED_M_S
    # Over its time constant a core gets 63 % of the way.
    return (
        f"thermal.warm_up_kelvin={WARMING_KELVIN / (1.0 - np.exp(-1.0)):.3f}",
        f"thermal.warm_up_s={max(duration_s, 1.0):.3f}",
        "thermal.running_s=0",
        f"flight.speed_m_s={SPEED_M_S}",
    )


@dataclass(frozen=True)
class ShutterlessCell:
    """One flight under one way of correction with one seed."""

    way: str
    seed: int
    warmed_kelvin: float
    translation_percent: float | None
    final_error_m: float
    mean_inliers: float
    zero_flow_percent: float
    lost_frames: int


def simulated_flat_fields(simulation: Simulation, camera: int) -> list[FlatFrame]:
    """Views of a cold and a warm source by the very core of a run, as it warms up as in the run.

    What creeps with time, and not with temperature, no calibration knows; it is left out.
    """
    plan, config = simulation.plan, simulation.config
    lens = plan.rig[plan.roles[camera]].camera
    shape = (lens.height, lens.width)
    responsivity = Responsivity(config.thermal.counts_per_kelvin)
    core = ThermalCamera(
        replace(config.thermal, creep_pixel=0.0),
        FfcConfig(),
        shape,
        simulation.fpa(camera),
        (),
        (simulation.seed, 20, camera),
    )
    frames = []
    # Other noise than that of any frame of the run.
    indices = itertools.count(1_000_000)
    for time_s in np.linspace(0.0, simulation.duration_s, TEMPERATURES):
        for source in SOURCES_KELVIN:
            kelvin = plan.weather.air_kelvin + source
            level = round(float(responsivity.counts(kelvin)) / SIGNAL_STEP)
            signal = np.full(shape, level, np.uint16)
            readings = [
                core.expose(signal, float(time_s), index)
                for index in itertools.islice(indices, FRAMES_PER_VIEW)
            ]
            counts = np.mean([reading.counts for reading in readings if reading], axis=0)
            fpa_kelvin = simulation.fpa(camera).kelvin(float(time_s))
            frames.append(FlatFrame(counts, fpa_kelvin, kelvin, f"{time_s:.0f} s"))
    return frames


def measure_way(
    way: str, seed: int, preset: str, overrides: Sequence[str], config: Config, cache: Path
) -> ShutterlessCell:
    """Fly once; the noise-free pictures are kept below ``cache`` for the other ways."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated

    pattern_free, flat_field, refinement = WAYS[way]
    settings = ("ffc.mode=none", f"render.cache={cache}", *overrides)
    settings += PATTERN_FREE if pattern_free else ()
    dataset = open_simulated(preset, SourceOptions(seed=seed, overrides=settings))
    front_end = config.front_end
    with TemporaryDirectory() as folder:
        if flat_field:
            for camera, role in enumerate(dataset.cameras):
                frames = simulated_flat_fields(dataset.simulation, camera)
                save_flat_field(Path(folder) / f"{role}.npz", fit_flat_field(frames, camera=role))
            stored = replace(front_end.flat_field, file=f"{folder}/{{camera}}.npz")
            front_end = replace(front_end, flat_field=stored)
        scene_based = replace(front_end.scene_based, enabled=refinement)
        front_end = replace(front_end, scene_based=scene_based)
        flown = fly(dataset, replace(config, front_end=front_end))
    fpa = dataset.simulation.fpa(0)
    return ShutterlessCell(
        way,
        seed,
        fpa.kelvin(dataset.simulation.duration_s) - fpa.kelvin(0.0),
        flown.metrics.avg_translation_error_percent,
        flown.metrics.final_error_m,
        flown.mean_inliers,
        flown.zero_flow_percent,
        flown.lost_frames,
    )


def measure_ways(
    seeds: Sequence[int],
    preset: str,
    overrides: Sequence[str],
    config: Config,
    cache: Path,
    ways: Sequence[str] = tuple(WAYS),
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[ShutterlessCell]:
    """Each of the ``ways`` with every seed."""
    for seed in seeds:
        for way in ways:
            yield measure_way(way, seed, preset, overrides, config, cache)
            on_progress()


def shutterless_report(cells: Sequence[ShutterlessCell]) -> str:
    """A row for each way; means over the seeds."""
    rows = []
    for way in dict.fromkeys(cell.way for cell in cells):
        mine = [cell for cell in cells if cell.way == way]
        percents = [c.translation_percent for c in mine if c.translation_percent is not None]
        rows.append(
            [
                way,
                str(len(mine)),
                f"{np.mean([cell.warmed_kelvin for cell in mine]):.1f}",
                f"{np.mean(percents):.3f}" if percents else "-",
                f"{np.mean([cell.final_error_m for cell in mine]):.3f}",
                f"{np.mean([cell.mean_inliers for cell in mine]):.0f}",
                f"{np.mean([cell.zero_flow_percent for cell in mine]):.2f}",
                str(sum(cell.lost_frames for cell in mine)),
            ]
        )
    header = [
        "way",
        "seeds",
        "warmed (K)",
        "error (%)",
        "final (m)",
        "inliers",
        "zero flow (%)",
        "LOST frames",
    ]
    return format_table(header, rows)
