"""One simulated flight by one method with one set of sensors: its figures, on disk when wanted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory, start_index
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.evaluation.alignment import Alignment, aligned
from thermal_stereo_vo.evaluation.association import compare
from thermal_stereo_vo.evaluation.consistency import nees
from thermal_stereo_vo.evaluation.metrics import measure
from thermal_stereo_vo.outputs.replacing import write_text
from thermal_stereo_vo.outputs.run_folder import to_json

GAUSS_NEWTON, LEVENBERG_MARQUARDT, DOUBLE_DOGLEG = "GN", "LM", "DDL"
WINDOWED = "windowed"
DIRECT = "direct"
METHODS = {
    GAUSS_NEWTON: ("odometry.window=0", "odometry.solver=gauss_newton"),
    LEVENBERG_MARQUARDT: ("odometry.window=0", "odometry.solver=levenberg_marquardt"),
    DOUBLE_DOGLEG: ("odometry.window=0", "odometry.solver=double_dogleg"),
    WINDOWED: (),
    DIRECT: ("odometry.method=direct",),
}
"""Method -> the settings that make it."""

MOST_POINTS = 400


@dataclass(frozen=True)
class Cell:
    """One flight with one sensor seed by one method.

    Errors in % and m as in ``evaluation.metrics``.  ``nees_mean`` is over all frames and
    ``nees_final`` that of the last pose (6 in expectation); None where no covariance was given.
    Positions (K, 3) m in the world of the first rectified left camera and the error curve (K,) are
    thinned out for pictures.
    """

    flight: str
    method: str
    seed: int
    frames: int
    coverage_percent: float
    path_length_m: float
    average_percent: float | None
    final_percent: float | None
    final_m: float
    ate_m: float
    nees_mean: float | None
    nees_final: float | None
    statuses: dict[str, int]
    positions_m: list[list[float]]
    true_positions_m: list[list[float]]
    curve_distance_m: list[float]
    curve_percent: list[float]

    @property
    def name(self) -> str:
        """Unique within a sweep; fit for a file name."""
        return cell_name(self.flight, self.method, self.seed)


def cell_name(flight: str, method: str, seed: int) -> str:
    """Name of the cell of this flight, method and seed."""
    return f"{flight}_{method}_{seed}"


def make_cell(
    flight: str, method: str, seed: int, results: Sequence[OdometryResult], truth: Trajectory
) -> Cell:
    """Figures of one run against the true poses of the rectified left camera.

    Raises EvaluationError for a run without any pose.
    """
    estimate = estimated_trajectory(results)
    if len(estimate) == 0:
        raise EvaluationError(f"{flight} by {method}, seed {seed}: no frame got a pose")
    frame_stamps = np.array([result.stamp_ns for result in results], np.int64)
    comparison = compare(estimate, truth, frame_stamps_ns=frame_stamps)
    metrics = measure(comparison)
    values = pose_nees(results, truth)
    laid_over = aligned(comparison, Alignment.ORIGIN)
    T_first_world = inverse(comparison.T_world_true[0])
    known = values[np.isfinite(values)]
    return Cell(
        flight,
        method,
        seed,
        frames=metrics.frames,
        coverage_percent=metrics.coverage_percent,
        path_length_m=metrics.path_length_m,
        average_percent=metrics.avg_translation_error_percent,
        final_percent=metrics.final_error_percent,
        final_m=metrics.final_error_m,
        ate_m=metrics.ate_rmse_m,
        nees_mean=float(np.mean(known)) if len(known) else None,
        nees_final=float(known[-1]) if len(known) else None,
        statuses={s.value: sum(r.status is s for r in results) for s in TrackingStatus},
        positions_m=thinned((T_first_world @ laid_over.T_world_est)[:, :3, 3]),
        true_positions_m=thinned((T_first_world @ laid_over.T_world_true)[:, :3, 3]),
        curve_distance_m=thinned(metrics.curve.distance_m),
        curve_percent=thinned(metrics.curve.error_percent),
    )


def pose_nees(results: Sequence[OdometryResult], truth: Trajectory) -> NDArray[np.float64]:
    """(N,) normalised error squared of each pose with a covariance whose true pose is known.

    The worlds are made equal at the last frame of the start, whose pose is certain by definition.
    Poses whose lengths are no metres are left out.
    """
    at = {int(stamp): T for stamp, T in zip(truth.stamps_ns, truth.T_world_rig, strict=True)}
    known = [
        (at[result.stamp_ns], result.T_world_rig, result.covariance, result.is_metric)
        for result in results[start_index(results) :]
        if result.T_world_rig is not None
        and result.covariance is not None
        and result.stamp_ns in at
    ]
    if not known:
        return np.zeros(0)
    true, estimated, covariance, metric = (np.array(col) for col in zip(*known, strict=True))
    true = estimated[0] @ inverse(true[0]) @ true
    return nees(true[metric], estimated[metric], covariance[metric])


def save_cell(folder: Path, cell: Any) -> Path:
    """Write the cell (a dataclass with a ``name``) to ``folder``, whole or not at all."""
    path = folder / f"{cell.name}.json"
    write_text(path, to_json(asdict(cell)))
    return path


def load_cells(folder: Path) -> list[Cell]:
    """All cells in ``folder``, by flight, method and seed.

    Raises EvaluationError for a file that is none.
    """
    cells = []
    for path in sorted(folder.glob("*.json")):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            cells.append(Cell(**content))
        except (ValueError, TypeError):
            raise EvaluationError(
                f"{path} is no cell of a sweep: remove it, and it will be flown again"
            ) from None
    order = {method: i for i, method in enumerate(METHODS)}
    return sorted(cells, key=lambda cell: (cell.flight, order.get(cell.method, 99), cell.seed))


def thinned(values: NDArray[np.float64]) -> list[Any]:
    """Every n-th of the values, the last one always, rounded to what a picture shows."""
    step = max(1, -(-len(values) // MOST_POINTS))
    kept = values[::step]
    if len(values) and (len(values) - 1) % step:
        kept = np.concatenate([kept, values[-1:]])
    rounded: list[Any] = np.round(kept, 4).tolist()
    return rounded
