"""Figures as plain text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.alignment import Alignment
from thermal_stereo_vo.evaluation.metrics import Metrics
from thermal_stereo_vo.evaluation.timing import Timing

Figure = tuple[str, float | None, int, str, str]
"""Name, value, decimals, unit, note."""

ALIGNMENT_TEXT = {
    Alignment.ORIGIN: "first poses made equal",
    Alignment.YAW: "heading and position fitted (4 DoF)",
    Alignment.SE3: "rotation and position fitted (SE(3))",
    Alignment.SIM3: "rotation, position and scale fitted (Sim(3))",
}


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns under a header and a rule: the first one left-aligned, the others right-aligned.

    >>> print(format_table(["stage", "ms"], [["detect", "12.5"], ["match", "3.1"]]))
    stage     ms
    ------  ----
    detect  12.5
    match    3.1
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ["-" * width for width in widths]
    lines = []
    for cells in (header, rule, *rows):
        padded = [
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def metrics_report(metrics: Metrics) -> str:
    """All figures of a run, one a line, then the error for each segment length."""
    fit = ALIGNMENT_TEXT[metrics.alignment]
    segments = sum(error.segments for error in metrics.per_length)
    over = ""
    if metrics.segment_lengths_m:
        shortest, longest = metrics.segment_lengths_m[0], metrics.segment_lengths_m[-1]
        over = f"{segments} segments of {shortest:g} to {longest:g} m"
    se3, origin, sim3 = (
        ALIGNMENT_TEXT[fitted] for fitted in (Alignment.SE3, Alignment.ORIGIN, Alignment.SIM3)
    )
    lines: list[Figure] = [
        ("coverage", metrics.coverage_percent, 1, "%", f"of {metrics.frames} frames"),
        ("compared with the truth", metrics.frames_compared, 0, "", "frames"),
        ("path length", metrics.path_length_m, 2, "m", ""),
        ("average error", metrics.avg_translation_error_percent, 3, "%", over),
        ("average rotation error", metrics.avg_rotation_error_deg_per_m, 5, "deg/m", over),
        ("position-only average", metrics.avg_position_error_percent, 3, "%", fit),
        ("final error", metrics.final_error_percent, 3, "%", fit),
        ("final error", metrics.final_error_m, 4, "m", fit),
        ("largest error", metrics.max_error_m, 4, "m", fit),
        ("ATE rmse", metrics.ate_rmse_m, 4, "m", se3),
        ("ATE rmse", metrics.ate_origin_rmse_m, 4, "m", origin),
        ("ATE rmse", metrics.ate_sim3_rmse_m, 4, "m", sim3),
        ("scale to the truth", metrics.scale, 4, "", ""),
        ("RPE rmse, translation", metrics.rpe_translation_rmse_m, 5, "m", "frame to frame"),
        ("RPE rmse, rotation", metrics.rpe_rotation_rmse_deg, 5, "deg", "frame to frame"),
    ]
    text = _format_figures(lines)
    if not metrics.per_length:
        return f"{text}\n(no figures per distance: the rig stood still or hardly moved)"
    rows = [
        [
            f"{error.length_m:g} m",
            str(error.segments),
            f"{error.translation_percent:.3f}",
            f"{error.rotation_deg_per_m:.5f}",
        ]
        for error in metrics.per_length
    ]
    table = format_table(["length", "segments", "translation (%)", "rotation (deg/m)"], rows)
    return f"{text}\n\n{table}"


def trajectory_report(trajectory: Trajectory, frames: int) -> str:
    """What can be said of the poses of ``frames`` frames without knowing the truth."""
    lines: list[Figure] = [
        (
            "coverage",
            100.0 * len(trajectory) / frames if frames else None,
            1,
            "%",
            f"of {frames} frames",
        )
    ]
    if len(trajectory):
        away_m = np.linalg.norm(trajectory.positions_m - trajectory.positions_m[0], axis=1)
        lines += [
            ("path length", float(trajectory.path_lengths_m[-1]), 3, "m", "of the estimate"),
            ("end from start", float(away_m[-1]), 4, "m", ""),
            ("farthest from start", float(np.max(away_m)), 4, "m", ""),
        ]
    return _format_figures(lines)


def timing_report(timing: Timing) -> str:
    """Time a frame and of each stage, in milliseconds."""
    rows = [
        ["frame, wall: median", _number(timing.wall_median_ms, 2)],
        ["frame, wall: 95 of 100 under", _number(timing.wall_p95_ms, 2)],
        ["frame, wall: longest", _number(timing.wall_max_ms, 2)],
        ["frame, CPU: mean", _number(timing.cpu_ms, 2)],
        *([f"stage {name}: median", f"{ms:.2f}"] for name, ms in timing.stages_ms.items()),
    ]
    return format_table([f"time of {timing.frames} frames", "ms"], rows)


def _format_figures(figures: Sequence[Figure]) -> str:
    cells = [
        (name, _number(value, decimals), unit, note)
        for name, value, decimals, unit, note in figures
    ]
    names, numbers, units = (max(len(line[i]) for line in cells) for i in range(3))
    return "\n".join(
        f"{name.ljust(names)}  {number.rjust(numbers)} {unit.ljust(units)}  {note}".rstrip()
        for name, number, unit, note in cells
    )


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"
