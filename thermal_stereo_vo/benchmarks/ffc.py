"""What flat-field corrections in flight cost: simulated flights with and without them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.flown import Flown, fly
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.transforms import log_so3
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config


@dataclass(frozen=True)
class Leg:
    """A short flight, and when the first and the second camera correct themselves in it."""

    preset: str
    length_m: float | None
    first_s: float
    stagger_s: float


FLIGHTS: Mapping[str, Leg] = {
    "straight": Leg("corridor", 60.0, 8.0, 3.0),
    "turn": Leg("quick_turn", None, 6.25, 1.5),
    "hover": Leg("hover", None, 3.0, 2.0),
}
"""At 4.5 m/s; at 51 to 61 deg/s; in gusts."""

NONE = "none"
SCHEDULES: Mapping[str, tuple[str, ...]] = {
    NONE: ("ffc.mode=none",),
    "staggered, 0.5 s": ("ffc.mode=periodic", "ffc.arrangement=staggered", "ffc.duration_s=0.5"),
    "staggered, 1 s": ("ffc.mode=periodic", "ffc.arrangement=staggered", "ffc.duration_s=1.0"),
    "together, 0.5 s": ("ffc.mode=periodic", "ffc.arrangement=together", "ffc.duration_s=0.5"),
    "together, 1 s": ("ffc.mode=periodic", "ffc.arrangement=together", "ffc.duration_s=1.0"),
}
PERIOD_S = 20.0
ACCELERATION_M_S2, ANGULAR_RAD_S2 = 3.0, 2.0
"""What a quadrotor may do between two messages (1 sigma)."""


@dataclass(frozen=True)
class FfcCell:
    """One flight under one schedule with one seed.

    ``scatter_m`` is the noise of a single position.  ``silence_ms`` is the longest time between two
    poses; ``jump_sigmas`` the largest jump of the pose in units of what the message before claimed.
    """

    flight: str
    schedule: str
    seed: int
    final_error_m: float
    final_error_percent: float | None
    scatter_m: float
    silence_ms: float
    jump_sigmas: float
    gap_frames: int
    lost_frames: int


def measure_cell(
    flight: str, schedule: str, seed: int, config: Config, rate_hz: float, scale: float, cache: Path
) -> FfcCell:
    """Fly once; the noise-free pictures are kept below ``cache`` for the other cells."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated

    leg = FLIGHTS[flight]
    overrides = (
        *SCHEDULES[schedule],
        f"ffc.first_s={leg.first_s}",
        f"ffc.stagger_s={leg.stagger_s}",
        f"ffc.period_s={PERIOD_S}",
        f"render.scale={scale}",
        f"render.cache={cache / f'{flight}_{rate_hz:g}hz_{scale:g}'}",
    )
    options = SourceOptions(rate_hz=rate_hz, length_m=leg.length_m, seed=seed, overrides=overrides)
    return make_cell(flight, schedule, seed, fly(open_simulated(leg.preset, options), config))


def make_cell(flight: str, schedule: str, seed: int, flown: Flown) -> FfcCell:
    """The figures of one flight."""
    results = flown.results
    stamps_ns = [result.stamp_ns for result in results if result.T_world_rig is not None]
    statuses = [result.status for result in results]
    return FfcCell(
        flight,
        schedule,
        seed,
        flown.metrics.final_error_m,
        flown.metrics.final_error_percent,
        scatter_m(flown.errors_m),
        float(np.max(np.diff(stamps_ns))) * 1e-6,
        largest_jump_sigmas(results),
        statuses.count(TrackingStatus.GAP),
        statuses.count(TrackingStatus.LOST),
    )


def scatter_m(errors_m: NDArray[np.float64]) -> float:
    """Noise of a single position from the (N, 3) errors of a flight, whose drift is slow."""
    steps_m = np.diff(errors_m, axis=0)
    return float(np.sqrt(np.mean(np.sum(steps_m**2, axis=1)) / 2.0))


def largest_jump_sigmas(results: Sequence[OdometryResult]) -> float:
    """How far a pose ever lies from where pose and twist of the message before lead.

    In units of the standard deviation that the message before claimed and that an unknown
    acceleration adds on the way, of position and of attitude.  Between INITIALISING or LOST and
    their neighbours there is nothing to compare.
    """
    largest = 0.0
    settled = (TrackingStatus.TRACKING, TrackingStatus.DEGRADED, TrackingStatus.GAP)
    for before, after in itertools.pairwise(results):
        if before.status not in settled or after.status not in settled:
            continue
        largest = max(largest, *jump_sigmas(before, after))
    return largest


def jump_sigmas(before: OdometryResult, after: OdometryResult) -> tuple[float, float]:
    """Position and attitude of one message against the one before; both must have a pose."""
    assert before.T_world_rig is not None
    assert before.covariance is not None
    assert before.twist is not None
    assert after.T_world_rig is not None
    step_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    R_before = before.T_world_rig[:3, :3]
    moved_m = after.T_world_rig[:3, 3] - before.T_world_rig[:3, 3]
    turned_rad = log_so3(after.T_world_rig[:3, :3] @ R_before.T)
    surprise = np.concatenate([moved_m, turned_rad])
    surprise -= np.concatenate([R_before @ before.twist[:3], R_before @ before.twist[3:]]) * step_s
    covariance = before.covariance + unforeseen(step_s)
    sigmas = [
        float(np.sqrt(surprise[part] @ np.linalg.solve(covariance[part, part], surprise[part])))
        for part in (slice(0, 3), slice(3, 6))
    ]
    return sigmas[0], sigmas[1]


def unforeseen(step_s: float) -> NDArray[np.float64]:
    """(6, 6) of the motion that unknown accelerations add within one step."""
    position_m, angle_rad = 0.5 * ACCELERATION_M_S2 * step_s**2, 0.5 * ANGULAR_RAD_S2 * step_s**2
    return np.diag([position_m**2] * 3 + [angle_rad**2] * 3)


def measure_all(
    seeds: Sequence[int],
    config: Config,
    rate_hz: float,
    scale: float,
    cache: Path,
    flights: Sequence[str] = tuple(FLIGHTS),
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[FfcCell]:
    """Every flight under every schedule with every seed."""
    for flight in flights:
        for schedule in SCHEDULES:
            for seed in seeds:
                yield measure_cell(flight, schedule, seed, config, rate_hz, scale, cache)
                on_progress()


def error_ratio(cells: Sequence[FfcCell], reference: Sequence[FfcCell]) -> float:
    """Root mean square of the final errors against that of the same flights without corrections.

    Neither counts as less than the scatter of a single position, below which an error is no drift.
    """
    floor_m = float(np.median([cell.scatter_m for cell in reference]))
    return max(rms_error_m(cells), floor_m) / max(rms_error_m(reference), floor_m)


def rms_error_m(cells: Sequence[FfcCell]) -> float:
    """Root mean square of the final errors."""
    return float(np.sqrt(np.mean([cell.final_error_m**2 for cell in cells])))


def ffc_report(cells: Sequence[FfcCell], *, with_imu: bool) -> str:
    """A row for each flight and schedule."""
    rows = []
    for flight in dict.fromkeys(cell.flight for cell in cells):
        mine = [cell for cell in cells if cell.flight == flight]
        reference = [cell for cell in mine if cell.schedule == NONE]
        for schedule in dict.fromkeys(cell.schedule for cell in mine):
            some = [cell for cell in mine if cell.schedule == schedule]
            rows.append(
                [
                    flight,
                    schedule,
                    str(len(some)),
                    f"{1e3 * rms_error_m(some):.1f}",
                    f"{1e3 * max(cell.final_error_m for cell in some):.1f}",
                    f"{1e3 * float(np.median([cell.scatter_m for cell in some])):.1f}",
                    f"{error_ratio(some, reference):.2f}" if reference else "-",
                    f"{max(cell.silence_ms for cell in some):.0f}",
                    f"{max(cell.jump_sigmas for cell in some):.2f}",
                    f"{np.mean([cell.gap_frames for cell in some]):.1f}",
                    str(sum(cell.lost_frames for cell in some)),
                ]
            )
    header = [
        "flight",
        "corrections",
        "seeds",
        "final (mm)",
        "worst (mm)",
        "scatter (mm)",
        "ratio",
        "silence (ms)",
        "jump (sigma)",
        "GAP frames",
        "LOST frames",
    ]
    notes = [
        "",
        "coasting by images, gyro and accelerometer" if with_imu else "coasting by images alone",
        "final: root mean square over the seeds; scatter: noise of a single position",
        "ratio: of the final error to that without corrections, neither below that scatter",
        "jump: from where pose and twist of the message before lead, by its own claim",
    ]
    return "\n".join([format_table(header, rows), *notes])
