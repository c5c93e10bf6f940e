"""What flat-field corrections in flight cost: simulated flights with and without them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.metrics import evaluate
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config

FLIGHTS: Mapping[str, tuple[str, float | None, float]] = {
    "straight": ("corridor", 60.0, 8.0),
    "turn": ("turn", None, 4.0),
    "hover": ("hover", None, 3.0),
}
"""Name -> (preset, length in m, time of the first correction in s)."""

SCHEDULES: Mapping[str, tuple[str, ...]] = {
    "none": ("ffc.mode=none",),
    "staggered, 0.5 s": ("ffc.mode=periodic", "ffc.arrangement=staggered", "ffc.duration_s=0.5"),
    "staggered, 1 s": ("ffc.mode=periodic", "ffc.arrangement=staggered", "ffc.duration_s=1.0"),
    "together, 0.5 s": ("ffc.mode=periodic", "ffc.arrangement=together", "ffc.duration_s=0.5"),
    "together, 1 s": ("ffc.mode=periodic", "ffc.arrangement=together", "ffc.duration_s=1.0"),
}
PERIOD_S = 20.0


@dataclass(frozen=True)
class FfcCell:
    """One flight under one schedule with one seed.

    ``silence_ms`` is the longest time between two poses; ``jump_sigmas`` the largest correction at
    the end of a gap in units of the standard deviation that the prediction claimed.
    """

    flight: str
    schedule: str
    seed: int
    final_error_m: float
    final_error_percent: float | None
    silence_ms: float
    jump_sigmas: float
    gap_frames: int
    lost_frames: int


def measure_cell(
    flight: str, schedule: str, seed: int, config: Config, rate_hz: float, cache: Path
) -> FfcCell:
    """Fly once; the noise-free pictures are kept below ``cache`` for the other cells."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated
    from thermal_stereo_vo.replay import replay
    from thermal_stereo_vo.stereo.rectification import Rectifier

    preset, length_m, first_s = FLIGHTS[flight]
    overrides = (
        *SCHEDULES[schedule],
        f"ffc.first_s={first_s}",
        f"ffc.period_s={PERIOD_S}",
        f"render.cache={cache / flight}",
    )
    dataset = open_simulated(
        preset,
        SourceOptions(rate_hz=rate_hz, length_m=length_m, seed=seed, overrides=overrides),
    )
    calibration = dataset.calibration()
    results = replay(dataset, calibration, config).results
    truth = dataset.ground_truth()
    rectifier = Rectifier(calibration, config.rectification)
    truth = Trajectory(truth.stamps_ns, truth.T_world_rig @ rectifier.T_rig_rectified)
    posed = [result for result in results if result.T_world_rig is not None]
    stamps_ns = np.array([result.stamp_ns for result in posed], np.int64)
    estimate = Trajectory(stamps_ns, np.array([result.T_world_rig for result in posed]))
    metrics = evaluate(estimate, truth)
    statuses = [result.status for result in results]
    return FfcCell(
        flight,
        schedule,
        seed,
        metrics.final_error_m,
        metrics.final_error_percent,
        float(np.max(np.diff(stamps_ns))) * 1e-6,
        largest_jump_sigmas(results),
        statuses.count(TrackingStatus.GAP),
        statuses.count(TrackingStatus.LOST),
    )


def largest_jump_sigmas(results: Sequence[OdometryResult]) -> float:
    """The largest correction of a prediction, in units of its own standard deviation.

    At the first measurement after a gap: how far it lies from where the last predicted pose and
    twist would have led.
    """
    largest = 0.0
    for before, after in itertools.pairwise(results):
        if before.status is not TrackingStatus.GAP or after.status is TrackingStatus.GAP:
            continue
        if before.T_world_rig is None or after.T_world_rig is None or before.twist is None:
            continue
        assert before.covariance is not None
        step_s = (after.stamp_ns - before.stamp_ns) * 1e-9
        expected = before.T_world_rig[:3, 3] + before.T_world_rig[:3, :3] @ (
            before.twist[:3] * step_s
        )
        jump = after.T_world_rig[:3, 3] - expected
        sigmas2 = jump @ np.linalg.solve(before.covariance[:3, :3], jump)
        largest = max(largest, float(np.sqrt(sigmas2)))
    return largest


def measure_all(
    seeds: Sequence[int],
    config: Config,
    rate_hz: float,
    cache: Path,
    flights: Sequence[str] = tuple(FLIGHTS),
) -> Iterator[FfcCell]:
    """Every flight under every schedule with every seed."""
    for flight in flights:
        for schedule in SCHEDULES:
            for seed in seeds:
                yield measure_cell(flight, schedule, seed, config, rate_hz, cache)


def ffc_report(cells: Sequence[FfcCell]) -> str:
    """A row for each flight and schedule; errors are means over the seeds."""
    rows = []
    for flight in dict.fromkeys(cell.flight for cell in cells):
        mine = [cell for cell in cells if cell.flight == flight]
        reference = np.mean([c.final_error_m for c in mine if c.schedule == "none"])
        for schedule in dict.fromkeys(cell.schedule for cell in mine):
            some = [cell for cell in mine if cell.schedule == schedule]
            errors_m = np.array([cell.final_error_m for cell in some])
            rows.append(
                [
                    flight,
                    schedule,
                    str(len(some)),
                    f"{errors_m.mean():.4f}",
                    f"{errors_m.max():.4f}",
                    f"{errors_m.mean() / reference:.2f}" if reference > 0.0 else "-",
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
        "final (m)",
        "worst (m)",
        "ratio",
        "silence (ms)",
        "jump (sigma)",
        "GAP frames",
        "LOST frames",
    ]
    return format_table(header, rows)
