"""One run of a visible + thermal rig, or of one of its cameras: its figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.evaluation.alignment import Alignment, aligned
from thermal_stereo_vo.evaluation.association import compare
from thermal_stereo_vo.evaluation.flight_cell import pose_nees, thinned
from thermal_stereo_vo.evaluation.metrics import measure, position_errors
from thermal_stereo_vo.evaluation.scale import ScaleReport, scale_report


@dataclass(frozen=True)
class BandCell:
    """One flight with one seed by one contender.

    ``path_length_m`` is that of the whole truth.  The figures from ``converged_after_s`` to
    ``worst_step_m`` are those of ``ScaleReport``, for a method in metres with a time of zero.
    ``average_percent`` and ``final_percent`` (KITTI average, error at the end; first poses made
    equal) are those of the metric poses, or of all, fitted with scale, where the scale was never
    known.  Positions (K, 3) m, fitted with scale, in the world of the first true pose, their errors
    (K,) m and times (K,) s are thinned out for pictures.
    """

    flight: str
    contender: str
    seed: int
    frames: int
    coverage_percent: float
    path_length_m: float
    converged_after_s: float | None
    scale_error_percent: float | None
    sim3_ate_m: float | None
    se3_ate_m: float | None
    worst_step_m: float | None
    average_percent: float | None
    final_percent: float | None
    frame_ms: float
    statuses: dict[str, int]
    times_s: list[float]
    positions_m: list[list[float | None]]
    true_positions_m: list[list[float]]
    errors_m: list[float | None]
    nees_mean: float | None = None
    """Over all metric poses, 6 in expectation; None where there were none."""

    @property
    def name(self) -> str:
        """Unique within a sweep; fit for a file name."""
        return band_cell_name(self.flight, self.contender, self.seed)


def band_cell_name(flight: str, contender: str, seed: int) -> str:
    """Name of the cell of this flight, contender and seed."""
    return f"{flight}_{contender}_{seed}"


def make_band_cell(
    flight: str,
    contender: str,
    seed: int,
    results: Sequence[OdometryResult],
    truth: Trajectory,
    frame_ms: float,
) -> BandCell:
    """Figures of one run against the true poses of the rig; those of a run without poses are None.

    ``frame_ms`` is the median time of a frame.
    """
    statuses = {s.value: sum(r.status is s for r in results) for s in TrackingStatus}
    path_m = float(truth.path_lengths_m[-1])
    estimate = estimated_trajectory(results)
    if len(estimate) == 0:
        return BandCell(
            flight, contender, seed, len(results), 0.0, path_m, None, None, None, None, None,
            None, None, frame_ms, statuses, [], [], [], [],
        )  # fmt: skip
    stamps_ns = np.array([result.stamp_ns for result in results], np.int64)
    comparison = compare(estimate, truth, frame_stamps_ns=stamps_ns)
    metrics = measure(comparison)
    report = scale_report(results, truth)
    if report is None:
        scale = None if metrics.scale is None else 100.0 * (1.0 / metrics.scale - 1.0)
        report = ScaleReport(0.0, scale, metrics.ate_sim3_rmse_m, metrics.ate_rmse_m, None)
    metric = report.converged_after_s is not None
    fitted = aligned(comparison, Alignment.SIM3)
    drift = metrics if metric else measure(fitted)
    T_first_world = inverse(truth.T_world_rig[0])
    values = pose_nees(results, truth)
    values = values[np.isfinite(values)]
    return BandCell(
        flight,
        contender,
        seed,
        frames=metrics.frames,
        coverage_percent=metrics.coverage_percent,
        path_length_m=path_m,
        converged_after_s=report.converged_after_s,
        scale_error_percent=report.scale_error_percent,
        sim3_ate_m=report.sim3_ate_m,
        se3_ate_m=report.se3_ate_m,
        worst_step_m=report.worst_step_m,
        average_percent=drift.avg_translation_error_percent,
        final_percent=drift.final_error_percent,
        frame_ms=frame_ms,
        statuses=statuses,
        times_s=thinned((comparison.stamps_ns - stamps_ns[0]) * 1e-9),
        positions_m=_holes(thinned((T_first_world @ fitted.T_world_est)[:, :3, 3])),
        true_positions_m=thinned((T_first_world @ fitted.T_world_true)[:, :3, 3]),
        errors_m=_holes(thinned(position_errors(fitted))),
        nees_mean=float(np.mean(values)) if len(values) else None,
    )


def load_band_cells(folder: Path) -> list[BandCell]:
    """All cells in ``folder``, by flight, contender and seed.

    Raises EvaluationError for a file that is none.
    """
    cells = []
    for path in sorted(folder.glob("*.json")):
        try:
            cells.append(BandCell(**json.loads(path.read_text(encoding="utf-8"))))
        except (ValueError, TypeError):
            raise EvaluationError(
                f"{path} is no cell of a sweep: remove it, and it will be flown again"
            ) from None
    return sorted(cells, key=lambda cell: (cell.flight, cell.contender, cell.seed))


def array(values: Sequence[Any]) -> NDArray[np.float64]:
    """The numbers of a cell, NaN where there is none."""
    return np.array(values, dtype=np.float64)


def _holes(values: list[Any]) -> list[Any]:
    """None in place of NaN, which JSON does not know."""
    if values and isinstance(values[0], list):
        return [_holes(value) for value in values]
    return [None if np.isnan(value) else value for value in values]
