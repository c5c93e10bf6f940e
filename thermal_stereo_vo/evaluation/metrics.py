"""How far an estimate strays from the truth, in the figures the field compares.

* KITTI average error: relative motion over segments of fixed length, as in the development kit of
  the KITTI odometry benchmark (Geiger et al., Are we ready for autonomous driving?, CVPR 2012).
* Travelled error: Mouats et al., Thermal stereo odometry for UAVs (2015), eq. (6).  As printed, the
  formula divides by the last step between two frames; the distance travelled so far is meant.
* ATE and RPE: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.alignment import Alignment, align, aligned
from thermal_stereo_vo.evaluation.association import DEFAULT_TOLERANCE_NS, Comparison, compare
from thermal_stereo_vo.evaluation.relative import (
    LengthError,
    relative_pose_rmse,
    rms,
    segment_errors,
    segment_lengths,
    start_stride,
)

Array = NDArray[np.float64]

CURVE_START_M = 20.0
STATIONARY_PATH_M = 1.0
STATIONARY_EXTENT_M = 0.1


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """Position error per distance travelled: ``distance_m`` (K,), ``error_percent`` (K,).

    Starts at ``start_m``: before, the quotient of two small numbers says nothing.
    """

    start_m: float
    distance_m: Array
    error_percent: Array


@dataclass(frozen=True)
class Metrics:
    """All figures of one run.  None where a figure does not exist (a rig that stands still).

    ``final_error_*``, ``max_error_m``, ``avg_position_error_percent`` and ``curve`` are measured in
    the alignment named here (for ORIGIN: drift).  ``ate_rmse_m`` is after an SE(3) fit,
    ``ate_origin_rmse_m`` after making the first poses equal, ``ate_sim3_rmse_m`` after a fit with
    scale, and ``scale`` is what the estimate must be multiplied with to fit.  With the alignment
    SIM3 all figures are those of the scaled estimate, relative ones included.

    ``avg_position_error_percent`` is the position-only sibling of the KITTI average, for truth
    without orientation (GPS): error over distance at each of the segment lengths, measured from the
    start.  ``rpe_*`` are root mean squares of the relative motion between successive frames.
    """

    frames: int
    coverage_percent: float
    path_length_m: float
    avg_translation_error_percent: float | None
    avg_rotation_error_deg_per_m: float | None
    final_error_m: float
    final_error_percent: float | None
    ate_rmse_m: float
    segment_lengths_m: tuple[float, ...]
    frames_compared: int
    alignment: Alignment
    per_length: tuple[LengthError, ...]
    avg_position_error_percent: float | None
    max_error_m: float
    ate_origin_rmse_m: float
    ate_sim3_rmse_m: float
    scale: float | None
    rpe_translation_rmse_m: float | None
    rpe_rotation_rmse_deg: float | None
    curve: ErrorCurve

    def as_dict(self) -> dict[str, Any]:
        """What ``metrics.json`` holds; the curve thinned to at most 200 points."""
        thin = max(1, -(-len(self.curve.distance_m) // 200))
        return {
            "frames": self.frames,
            "frames_compared": self.frames_compared,
            "coverage_percent": self.coverage_percent,
            "path_length_m": self.path_length_m,
            "avg_translation_error_percent": self.avg_translation_error_percent,
            "avg_rotation_error_deg_per_m": self.avg_rotation_error_deg_per_m,
            "avg_position_error_percent": self.avg_position_error_percent,
            "final_error_m": self.final_error_m,
            "final_error_percent": self.final_error_percent,
            "max_error_m": self.max_error_m,
            "alignment": self.alignment.value,
            "ate_rmse_m": self.ate_rmse_m,
            "ate_origin_rmse_m": self.ate_origin_rmse_m,
            "ate_sim3_rmse_m": self.ate_sim3_rmse_m,
            "scale": self.scale,
            "rpe_translation_rmse_m": self.rpe_translation_rmse_m,
            "rpe_rotation_rmse_deg": self.rpe_rotation_rmse_deg,
            "segment_lengths_m": list(self.segment_lengths_m),
            "per_length": [
                {
                    "length_m": error.length_m,
                    "segments": error.segments,
                    "translation_percent": error.translation_percent,
                    "rotation_deg_per_m": error.rotation_deg_per_m,
                }
                for error in self.per_length
            ],
            "error_curve": {
                "start_m": self.curve.start_m,
                "distance_m": self.curve.distance_m[::thin].tolist(),
                "error_percent": self.curve.error_percent[::thin].tolist(),
            },
        }


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    frame_stamps_ns: NDArray[np.int64] | None = None,
    tolerance_ns: int = DEFAULT_TOLERANCE_NS,
    alignment: Alignment = Alignment.ORIGIN,
) -> Metrics:
    """Every figure of an estimate.

    Both trajectories must be of the same body, each in a world of its own.  ``frame_stamps_ns``
    (M,) are the stamps of all frames that went in, for the coverage; without them they are
    reconstructed from the estimate.  Raises EvaluationError when there is nothing to compare.
    """
    comparison = compare(
        estimate, truth, frame_stamps_ns=frame_stamps_ns, tolerance_ns=tolerance_ns
    )
    return measure(comparison, alignment)


def measure(comparison: Comparison, alignment: Alignment = Alignment.ORIGIN) -> Metrics:
    """Every figure of frames laid side by side."""
    laid_over = aligned(comparison, alignment)
    if alignment is Alignment.SIM3:
        comparison = laid_over
    distances_m = comparison.distances_m
    path_m = float(distances_m[-1])
    moved = not is_stationary(comparison)
    lengths_m = segment_lengths(path_m, path_m / max(len(comparison) - 1, 1)) if moved else ()
    segments = segment_errors(comparison, lengths_m, start_stride(comparison))
    errors_m = position_errors(laid_over)
    posed = comparison.has_pose
    rpe_m, rpe_deg = relative_pose_rmse(comparison)
    return Metrics(
        frames=comparison.frames,
        coverage_percent=comparison.coverage_percent,
        path_length_m=path_m,
        avg_translation_error_percent=_mean(segments.translation_percent),
        avg_rotation_error_deg_per_m=_mean(segments.rotation_deg_per_m),
        final_error_m=float(errors_m[-1]),
        final_error_percent=100.0 * float(errors_m[-1]) / path_m if moved else None,
        ate_rmse_m=ate_rmse(comparison, Alignment.SE3),
        segment_lengths_m=lengths_m,
        frames_compared=int(np.count_nonzero(posed)),
        alignment=alignment,
        per_length=segments.per_length(),
        avg_position_error_percent=position_only_error(distances_m, errors_m, lengths_m),
        max_error_m=float(np.max(errors_m[posed])),
        ate_origin_rmse_m=ate_rmse(comparison, Alignment.ORIGIN),
        ate_sim3_rmse_m=ate_rmse(comparison, Alignment.SIM3),
        scale=align(comparison, Alignment.SIM3).scale if moved else None,
        rpe_translation_rmse_m=rpe_m,
        rpe_rotation_rmse_deg=rpe_deg,
        curve=error_curve(distances_m, errors_m, moved),
    )


def is_stationary(comparison: Comparison) -> bool:
    """Whether the rig stood still: errors per distance then mean nothing.

    The extent counts as well as the path, since the jitter of a recorded truth adds up to a path.
    """
    positions_m = comparison.true_positions_m
    extent_m = float(np.max(np.linalg.norm(positions_m - positions_m[0], axis=1)))
    path_m = float(comparison.distances_m[-1])
    return path_m < STATIONARY_PATH_M or extent_m < STATIONARY_EXTENT_M


def position_errors(comparison: Comparison) -> Array:
    """(N,) distance of each estimated from its true position, NaN where there is no pose."""
    return np.asarray(
        np.linalg.norm(comparison.estimated_positions_m - comparison.true_positions_m, axis=1)
    )


def ate_rmse(comparison: Comparison, alignment: Alignment) -> float:
    """Root mean square of the position errors after alignment, in metres."""
    return rms(position_errors(aligned(comparison, alignment))[comparison.has_pose])


def error_curve(distances_m: Array, errors_m: Array, moved: bool = True) -> ErrorCurve:
    """Mouats et al. eq. (6), corrected: position error over the distance travelled so far.

    Starts at 20 m, on paths under 60 m at a third of the path.
    """
    start_m = min(CURVE_START_M, float(distances_m[-1]) / 3.0)
    shown = np.isfinite(errors_m) & (distances_m >= start_m) & (distances_m > 0.0)
    if not moved:
        shown[:] = False
    return ErrorCurve(start_m, distances_m[shown], 100.0 * errors_m[shown] / distances_m[shown])


def position_only_error(
    distances_m: Array, errors_m: Array, lengths_m: tuple[float, ...]
) -> float | None:
    """Mean of error over distance (%) at the first frame with a pose beyond each length."""
    posed = np.flatnonzero(np.isfinite(errors_m))
    at = [posed[distances_m[posed] > length] for length in lengths_m]
    first = np.array([frames[0] for frames in at if len(frames)], dtype=np.intp)
    return _mean(100.0 * errors_m[first] / distances_m[first])


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if len(values) else None
