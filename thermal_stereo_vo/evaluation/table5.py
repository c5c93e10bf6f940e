"""The counterpart of Table V: average and final errors of simulated flights by every method.

Mouats et al., Thermal stereo odometry for UAVs (2015), Table V: nine flights, three solvers.  Here
each flight is flown with several sensors, so that a spread can be told beside the mean.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.evaluation.consistency import nees_band
from thermal_stereo_vo.evaluation.flight_cell import (
    DOUBLE_DOGLEG,
    GAUSS_NEWTON,
    LEVENBERG_MARQUARDT,
    METHODS,
    WINDOWED,
    Cell,
)

PAPER = {
    "seq1": (687, (3.79, 1.78), (3.53, 2.24), (3.07, 1.19)),
    "seq2": (497, (3.06, 0.15), (2.30, 0.57), (3.04, 1.38)),
    "seq3": (701, (3.05, 2.44), (2.85, 1.04), (1.14, 1.33)),
    "seq4": (460, (2.11, 0.50), (2.39, 1.88), (2.07, 0.61)),
    "seq5": (882, (3.59, 1.29), (3.87, 1.52), (2.17, 1.53)),
    "seq6": (489, (6.28, 1.46), (5.59, 4.06), (4.28, 1.33)),
    "seq7": (399, (2.08, 2.26), (2.00, 1.99), (1.36, 0.67)),
    "seq8": (314, (1.46, 1.38), (1.44, 0.95), (1.51, 0.72)),
    "seq9": (655, (1.91, 1.65), (1.91, 2.13), (1.41, 0.45)),
}
"""Flight -> (m, then average and final error in % of GN, LM and DDL), as the paper prints them."""


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over seeds (None with one seed), of ``count`` values."""

    mean: float
    deviation: float | None
    count: int

    def __str__(self) -> str:
        if self.deviation is None:
            return f"{self.mean:.2f}"
        return f"{self.mean:.2f} ± {self.deviation:.2f}"


def spread(values: Iterable[float | None]) -> Spread | None:
    """Of all values that are known; None without any.

    >>> str(spread([1.0, None, 3.0]))
    '2.00 ± 1.41'
    """
    known = np.array([value for value in values if value is not None], np.float64)
    if not len(known):
        return None
    deviation = float(np.std(known, ddof=1)) if len(known) > 1 else None
    return Spread(float(np.mean(known)), deviation, len(known))


class Table5:
    """The cells of a sweep, summed up."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = list(cells)
        self.flights = tuple(dict.fromkeys(cell.flight for cell in cells))
        self.methods = tuple(m for m in METHODS if any(cell.method == m for cell in cells))
        self.seeds = tuple(sorted({cell.seed for cell in cells}))

    def of(self, flight: str, method: str) -> list[Cell]:
        """The cells of all seeds."""
        return [c for c in self.cells if c.flight == flight and c.method == method]

    def average(self, flight: str, method: str) -> Spread | None:
        """Average error in %."""
        return spread(cell.average_percent for cell in self.of(flight, method))

    def final(self, flight: str, method: str) -> Spread | None:
        """Final error in %."""
        return spread(cell.final_percent for cell in self.of(flight, method))

    def mean_over_flights(
        self, method: str, figure: Callable[[str, str], Spread | None]
    ) -> float | None:
        """Mean of the flights' means; None while a flight has none."""
        values = [figure(flight, method) for flight in self.flights]
        if not values or any(value is None for value in values):
            return None
        return float(np.mean([value.mean for value in values if value is not None]))

    def rows(self) -> list[list[str]]:
        """Flight, distance, average and final error of each method; the last row is the mean."""
        rows = []
        for flight in self.flights:
            length_m = max(c.path_length_m for c in self.cells if c.flight == flight)
            row = [flight, f"{length_m:.0f} m"]
            for method in self.methods:
                found = (self.average(flight, method), self.final(flight, method))
                row += ["-" if value is None else str(value) for value in found]
            rows.append(row)
        mean = ["mean", ""]
        for method in self.methods:
            means = (self.mean_over_flights(method, f) for f in (self.average, self.final))
            mean += ["-" if value is None else f"{value:.2f}" for value in means]
        return [*rows, mean]

    def header(self) -> list[str]:
        """Titles of ``rows``."""
        names = [f"{method} {figure}" for method in self.methods for figure in ("avg", "final")]
        return ["flight", "distance", *names]

    def consistency_rows(self) -> list[list[str]]:
        """Flight, then mean and last NEES of each method."""
        rows = []
        for flight in self.flights:
            row = [flight]
            for method in self.methods:
                cells = self.of(flight, method)
                for values in ([c.nees_mean for c in cells], [c.nees_final for c in cells]):
                    found = spread(values)
                    row.append("-" if found is None else f"{found.mean:.1f}")
            rows.append(row)
        return rows

    def consistency_header(self) -> list[str]:
        """Titles of ``consistency_rows``."""
        names = [f"{method} {figure}" for method in self.methods for figure in ("mean", "last")]
        return ["NEES", *names]

    def findings(self) -> list[str]:
        """What the figures say, in sentences."""
        lines = []
        for method in self.methods:
            last = spread(c.nees_final for c in self.cells if c.method == method)
            if last is not None:
                low, high = nees_band(last.count)
                inside = "inside" if low <= last.mean <= high else "outside"
                lines.append(
                    f"{method}: NEES of the last pose {last.mean:.2f} over {last.count} flights, "
                    f"{inside} the 95 % band {low:.2f} to {high:.2f} of a true covariance"
                )
        if {WINDOWED, DOUBLE_DOGLEG} <= set(self.methods):
            for name, figure in (("average", self.average), ("final", self.final)):
                ours = self.mean_over_flights(WINDOWED, figure)
                paper = self.mean_over_flights(DOUBLE_DOGLEG, figure)
                if ours and paper:
                    lines.append(
                        f"{name} error: the windowed method's mean is {paper / ours:.1f} times "
                        "below that of Double Dogleg frame to frame"
                    )
        lost = [c for c in self.cells if c.coverage_percent < 100.0]
        lines += [
            f"{c.name}: only {c.coverage_percent:.1f} % of the frames got a pose" for c in lost
        ]
        return lines

    def as_dict(self) -> dict[str, Any]:
        """All figures, without the curves."""
        return {
            "flights": self.flights,
            "methods": self.methods,
            "seeds": self.seeds,
            "mean": {
                method: {
                    "average_percent": self.mean_over_flights(method, self.average),
                    "final_percent": self.mean_over_flights(method, self.final),
                }
                for method in self.methods
            },
            "cells": [_figures(cell) for cell in self.cells],
            "findings": self.findings(),
        }


def to_csv(table: Table5) -> str:
    """One line for each cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [*_figure_names(), *(s.value for s in TrackingStatus)])
    writer.writeheader()
    for cell in table.cells:
        figures = _figures(cell)
        writer.writerow({**figures.pop("statuses"), **figures})
    return text.getvalue()


def to_markdown(table: Table5, about: Sequence[str], pictures: Sequence[str] = ()) -> str:
    """The report: table, the paper's own, consistency, findings, pictures."""
    lines = ["# Simulated flights by every method", "", *about, ""]
    lines += [
        "Average (over segments of fixed length) and final error in % of the distance; mean and "
        f"standard deviation over the sensor seeds {', '.join(map(str, table.seeds))}.",
        "",
        *_markdown_table(table.header(), table.rows()),
        "",
        "## The same in the paper",
        "",
        "Mouats et al. 2015, Table V: real flights, other places and cameras.",
        "",
        *_markdown_table(*_paper_rows(table.flights)),
        "",
        "## Do the covariances tell the truth?",
        "",
        "Normalised estimation error squared of the pose, 6 in expectation: mean over all frames, "
        "and of the last frame.",
        "",
        *_markdown_table(table.consistency_header(), table.consistency_rows()),
        "",
        *(f"* {finding}" for finding in table.findings()),
    ]
    if pictures:
        lines += ["", "## Trajectories and travelled errors", ""]
        lines += [f"![{Path(picture).stem}]({picture})" for picture in pictures]
    return "\n".join(lines) + "\n"


def _paper_rows(flights: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    solvers = (GAUSS_NEWTON, LEVENBERG_MARQUARDT, DOUBLE_DOGLEG)
    header = ["flight", "distance", *(f"{s} {f}" for s in solvers for f in ("avg", "final"))]
    shown = [PAPER[flight] for flight in flights if flight in PAPER]
    rows = [
        [flight, f"{PAPER[flight][0]} m", *(f"{v:.2f}" for pair in PAPER[flight][1:] for v in pair)]
        for flight in flights
        if flight in PAPER
    ]
    if shown:
        means = np.mean([[v for pair in row[1:] for v in pair] for row in shown], axis=0)
        rows.append(["mean", "", *(f"{value:.2f}" for value in means)])
    return header, rows


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---"] + ["---:"] * (len(header) - 1)
    return [f"| {' | '.join(cells)} |" for cells in (header, rule, *rows)]


def _figure_names() -> list[str]:
    left_out = ("statuses", "positions_m", "true_positions_m", "curve_distance_m", "curve_percent")
    return [field.name for field in fields(Cell) if field.name not in left_out]


def _figures(cell: Cell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in [*_figure_names(), "statuses"]}
