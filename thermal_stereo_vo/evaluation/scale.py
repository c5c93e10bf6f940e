"""Runs whose unit of length has to be found on the way: when it was, and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.evaluation.alignment import Alignment, align
from thermal_stereo_vo.evaluation.association import Comparison, compare
from thermal_stereo_vo.evaluation.metrics import ate_rmse, is_stationary
from thermal_stereo_vo.evaluation.relative import relative_errors


@dataclass(frozen=True)
class ScaleReport:
    """What a run with unknown scale is worth.

    ``converged_after_s`` is the time from the first frame to the first metric pose, None when there
    was none.  ``scale_error_percent`` is by how much lengths of the metric poses are too long, by
    the Sim(3) fit; None without such poses or without motion.  ``sim3_ate_m`` and ``se3_ate_m`` are
    root mean squares of the position errors of the metric poses after the fit with and without
    scale; where the scale never converged, the first is that of all poses and the second is None.
    ``worst_step_m`` is the largest error of the motion between two successive frames with a metric
    pose: a jump.
    """

    converged_after_s: float | None
    scale_error_percent: float | None
    sim3_ate_m: float | None
    se3_ate_m: float | None
    worst_step_m: float | None

    def as_dict(self) -> dict[str, Any]:
        """What ``metrics.json`` holds of it."""
        return {
            "scale_converged_after_s": self.converged_after_s,
            "scale_error_percent": self.scale_error_percent,
            "worst_step_m": self.worst_step_m,
        }

    def __str__(self) -> str:
        if self.converged_after_s is None:
            return (
                "the scale did not converge: lengths are in an arbitrary unit, and only figures "
                "fitted with scale (Sim(3)) count"
            )
        error = self.scale_error_percent
        told = "" if error is None else f", with an error of {error:+.2f} % from there on"
        return f"the scale converged after {self.converged_after_s:.1f} s{told}"


def scale_report(results: Sequence[OdometryResult], truth: Trajectory | None) -> ScaleReport | None:
    """The report of a run against the true poses; None for a method that measures in metres.

    Without a truth only the time is known.

    Raises EvaluationError when no stamps agree with the truth.
    """
    if all(result.scale_converged is None for result in results):
        return None
    known = [r.stamp_ns for r in results if r.scale_converged and r.T_world_rig is not None]
    converged_after_s = (known[0] - results[0].stamp_ns) * 1e-9 if known else None
    estimate = estimated_trajectory(results)
    if len(estimate) == 0 or truth is None:
        return ScaleReport(converged_after_s, None, None, None, None)
    stamps_ns = np.array([result.stamp_ns for result in results], np.int64)
    comparison = compare(estimate, truth, frame_stamps_ns=stamps_ns)
    metric = converged_after_s is not None
    moved = not is_stationary(comparison)
    scale = align(comparison, Alignment.SIM3).scale if metric and moved else None
    return ScaleReport(
        converged_after_s=converged_after_s,
        scale_error_percent=100.0 * (1.0 / scale - 1.0) if scale else None,
        sim3_ate_m=ate_rmse(comparison, Alignment.SIM3),
        se3_ate_m=ate_rmse(comparison, Alignment.SE3) if metric else None,
        worst_step_m=worst_step_m(comparison) if metric else None,
    )


def worst_step_m(comparison: Comparison) -> float | None:
    """Largest error of the translation between successive frames that both have a pose."""
    first = np.arange(len(comparison) - 1)
    first = first[comparison.has_pose[:-1] & comparison.has_pose[1:]]
    if len(first) == 0:
        return None
    errors = relative_errors(comparison, first, first + 1)
    return float(np.max(np.linalg.norm(errors[:, :3, 3], axis=1)))
