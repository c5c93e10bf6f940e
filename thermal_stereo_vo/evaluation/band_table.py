"""Cells of visible + thermal runs as a table and as sentences."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.evaluation.band_cell import BandCell

BOTH = "both"
TABLE_I = re.compile(r"ms-0[1-7]")
CRITICAL = ("ms-forward", "ms-still")


class BandTable:
    """Means over the seeds of each flight and contender, and what they amount to."""

    def __init__(self, cells: Sequence[BandCell]) -> None:
        self._groups: dict[tuple[str, str], list[BandCell]] = {}
        for cell in cells:
            self._groups.setdefault((cell.flight, cell.contender), []).append(cell)
        self.flights = tuple(dict.fromkeys(cell.flight for cell in cells))

    def header(self) -> list[str]:
        """Names of the columns; ATE and step in metres."""
        return [
            "flight", "cameras", "seeds", "path", "cover", "Sim(3) ATE", "worst", "SE(3) ATE",
            "worst", "scale error", "worst", "converged", "drift", "worst step", "NEES",
            "lost", "ms",
        ]  # fmt: skip

    def rows(self) -> list[list[str]]:
        """A row for each flight and contender."""
        return [self._row(*names, cells) for names, cells in self._groups.items()]

    def _row(self, flight: str, contender: str, cells: Sequence[BandCell]) -> list[str]:
        times = [cell.converged_after_s for cell in cells if cell.converged_after_s is not None]
        when = f"{np.mean(times):.1f} s" if times else "never"
        if times and len(times) < len(cells):
            when += f" ({len(times)} of {len(cells)})"
        lost = sum(cell.statuses.get(TrackingStatus.LOST.value, 0) for cell in cells)
        scale = [abs(e) for e in _known(cells, "scale_error_percent")]
        return [
            flight,
            contender,
            str(len(cells)),
            f"{cells[0].path_length_m:.1f} m",
            f"{np.mean([cell.coverage_percent for cell in cells]):.0f} %",
            _text(_known(cells, "sim3_ate_m"), np.mean),
            _text(_known(cells, "sim3_ate_m"), np.max),
            _text(_known(cells, "se3_ate_m"), np.mean),
            _text(_known(cells, "se3_ate_m"), np.max),
            _text(scale, np.mean, "{:.2f} %"),
            _text(scale, np.max, "{:.2f} %"),
            when,
            _text(_known(cells, "average_percent"), np.mean, "{:.2f} %"),
            _text(_known(cells, "worst_step_m"), np.max),
            _text(_known(cells, "nees_mean"), np.mean, "{:.1f}"),
            str(lost),
            f"{np.median([cell.frame_ms for cell in cells]):.0f}",
        ]

    def findings(self) -> list[str]:
        """What the table says, in sentences; only of what was flown."""
        return [
            *self._of_table_i(),
            *self._of_cases(),
            *self._of_critical_motions(),
            *self._of_one_camera(),
        ]

    def _of_table_i(self) -> list[str]:
        cells = [
            cell
            for (flight, contender), group in self._groups.items()
            if TABLE_I.fullmatch(flight) and contender == BOTH
            for cell in group
        ]
        errors = _known(cells, "se3_ate_m")
        if not cells:
            return []
        never = len(cells) - len(errors)
        said = [
            f"Table I by both cameras, {len(cells)} runs: the scale converged in {len(errors)}"
            + (f" and never in {never}." if never else ".")
        ]
        if errors:
            scale = [abs(e) for e in _known(cells, "scale_error_percent")]
            mean, worst = (_text(scale, of, "{:.2f}") for of in (np.mean, np.max))
            said.append(
                f"There the SE(3) ATE is {np.mean(errors):.3f} m on average and "
                f"{np.max(errors):.3f} m at worst, the scale error {mean} and {worst} %."
            )
        return said

    def _of_cases(self) -> list[str]:
        said = []
        for (flight, contender), cells in self._groups.items():
            preset, _, case = flight.partition("+")
            calm = self._groups.get((f"{preset}+calm", contender))
            if case in ("nuc", "dark") and calm:
                with_it, without = (_known(group, "se3_ate_m") for group in (cells, calm))
                if with_it and without:
                    ratio = np.mean(with_it) / np.mean(without)
                    steps = [_known(group, "worst_step_m") for group in (cells, calm)]
                    said.append(
                        f"{flight} by {contender}: the SE(3) ATE is {ratio:.2f} times that of the "
                        f"calm run; the worst step is {_text(steps[0], np.max)} m, in the calm run "
                        f"{_text(steps[1], np.max)} m."
                    )
        return said

    def _of_critical_motions(self) -> list[str]:
        return [
            f"{flight} by {contender}: the scale was "
            + (
                "never taken for known."
                if all(cell.converged_after_s is None for cell in cells)
                else "TAKEN FOR KNOWN though the motion does not tell it."
            )
            for (flight, contender), cells in self._groups.items()
            if flight in CRITICAL and contender == BOTH
        ]

    def _of_one_camera(self) -> list[str]:
        said = []
        for (flight, contender), cells in self._groups.items():
            errors = _known(cells, "sim3_ate_m")
            if contender == "visible" and not flight.startswith("ms-") and errors:
                percent = 100.0 * np.mean(errors) / cells[0].path_length_m
                said.append(
                    f"{flight} by one camera: the Sim(3) ATE is {np.mean(errors):.2f} m, "
                    f"{percent:.2f} % of {cells[0].path_length_m:.0f} m."
                )
        return said


def to_markdown(table: BandTable, about: Sequence[str], pictures: Sequence[str]) -> str:
    """The report as Markdown."""
    lines = ["# Visible + thermal odometry", "", *about, ""]
    lines.append("| " + " | ".join(table.header()) + " |")
    lines.append("|" + "---|" * len(table.header()))
    lines += ["| " + " | ".join(row) + " |" for row in table.rows()]
    lines += ["", *(f"* {sentence}" for sentence in table.findings()), ""]
    lines += [f"![{name}]({name})" for name in pictures]
    return "\n".join(lines) + "\n"


def _known(cells: Sequence[BandCell], name: str) -> list[float]:
    values = [getattr(cell, name) for cell in cells]
    return [float(value) for value in values if value is not None]


def _text(values: Sequence[float], of: Any, form: str = "{:.3f}") -> str:
    return form.format(of(values)) if len(values) else "-"
