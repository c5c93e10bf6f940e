"""The comparison of the solvers: where its problems come from, and how it reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.odometry.solver_comparison import (
    Comparison,
    Step,
    StepSequence,
)


def load_steps(folder: Path, score_from: int = 0) -> StepSequence:
    """Recorded matches.

    ``matches.npz`` holds ``step_000``, ... (N, 8) px uL vL uR vR before and after; ``calib.txt`` f
    cx cy baseline_m; ``poses.txt`` a 3x4 row for each frame.  Raises DatasetError for what is
    missing or does not fit together.
    """
    try:
        with np.load(folder / "matches.npz") as archive:
            arrays = [np.asarray(archive[name], np.float64) for name in sorted(archive.files)]
        f, cx, cy, baseline_m = np.loadtxt(folder / "calib.txt", dtype=np.float64).ravel()
        rows = np.loadtxt(folder / "poses.txt", dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{folder} holds no recorded matches (matches.npz, calib.txt with f cx cy baseline_m, "
            f"poses.txt): {error}"
        ) from None
    if any(array.ndim != 2 or array.shape[1] != 8 for array in arrays) or not arrays:
        raise DatasetError(f"{folder / 'matches.npz'} must hold arrays of 8 columns, one a step")
    if rows.shape[1] != 12 or len(rows) <= len(arrays):
        raise DatasetError(
            f"{folder / 'poses.txt'} must hold a row of 12 numbers for each of the "
            f"{len(arrays) + 1} frames, not {rows.shape[0]} of {rows.shape[1]}"
        )
    if not 0 <= score_from < len(arrays):
        raise DatasetError(
            f"the first step to count must lie below {len(arrays)}, not at {score_from}"
        )
    poses = np.tile(np.eye(4), (len(arrays) + 1, 1, 1))
    poses[:, :3] = rows[: len(arrays) + 1].reshape(-1, 3, 4)
    steps = tuple(Step(array[:, :4], array[:, 4:]) for array in arrays)
    return StepSequence(folder.resolve().name, f, (cx, cy), baseline_m, steps, poses, score_from)


def comparison_report(comparison: Comparison) -> str:
    """Tables of both starts, and what holds of the claim that Double Dogleg is more accurate."""
    header = ["evaluations", "iterations", "not converged", "ms a solve"]
    parts = [
        f"{comparison.name}: {comparison.problems} problems of {comparison.points:.0f} inliers on "
        "average",
        format_table(
            ["RANSAC and", "unsolved steps", "final error (%)"],
            [
                [chain.solver, str(chain.unsolved), f"{chain.final_error_percent:.3f}"]
                for chain in comparison.chains
            ],
        ),
    ]
    for title, figures in (("from the best sample", comparison.warm), ("cold", comparison.cold)):
        rows = [
            [
                each.solver,
                f"{each.evaluations:.2f}",
                f"{each.iterations:.2f}",
                str(each.unconverged),
                f"{each.milliseconds:.3f}",
                f"{each.stopped_short_m * 1e6:.2f}",
                f"{each.stopped_short_sigmas:.4f}",
            ]
            for each in figures
        ]
        parts.append(
            format_table([f"start: {title}", *header, "short of it (um)", "at most (sigma)"], rows)
        )
    parts.append("\n".join(_verdict(comparison)))
    return "\n\n".join(parts)


def _verdict(comparison: Comparison) -> list[str]:
    gauss, levenberg, dogleg = comparison.warm
    agree = comparison.apart_m <= 1e-6 and comparison.apart_rad <= 1e-6
    saved = 100.0 * (1.0 - dogleg.evaluations / levenberg.evaluations)
    against = "fewer" if saved >= 0.0 else "more"
    return [
        f"run to the end, the three {'agree' if agree else 'do NOT agree'} to 1e-6: at most "
        f"{comparison.apart_m:.1e} m and {comparison.apart_rad:.1e} rad apart",
        f"noise leaves {comparison.sigma_m:.1e} m of the translation open: "
        f"{comparison.sigma_m / max(comparison.apart_m, 1e-15):.0e} times more than the solvers do",
        f"with the paper's stopping rules Double Dogleg needs {abs(saved):.0f} % {against} "
        f"evaluations than Levenberg-Marquardt ({dogleg.evaluations:.2f} against "
        f"{levenberg.evaluations:.2f}; Gauss-Newton {gauss.evaluations:.2f})",
    ]


def comparison_record(comparison: Comparison) -> dict[str, Any]:
    """The same figures for a file."""
    return {
        "name": comparison.name,
        "problems": comparison.problems,
        "mean_inliers": comparison.points,
        "largest_difference_m": comparison.apart_m,
        "largest_difference_rad": comparison.apart_rad,
        "sigma_m": comparison.sigma_m,
        "chains": [vars(chain) for chain in comparison.chains],
        "starts": {
            start: [vars(each) for each in figures]
            for start, figures in (("best_sample", comparison.warm), ("cold", comparison.cold))
        },
    }
