"""One picture of a flight by several methods: the ways from above, and the travelled errors.

After Mouats et al. 2015, Figs. 10-18.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermal_stereo_vo.evaluation.flight_cell import METHODS, Cell
from thermal_stereo_vo.outputs.plots import DPI, START_COLOUR, TRUTH_COLOUR
from thermal_stereo_vo.outputs.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito again; blue, red and green as in the paper, and two more.
COLOURS = dict(zip(METHODS, ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"), strict=True))
# The solvers lie upon each other: the lower ones show at the sides of the upper ones.
WIDTHS = dict(zip(METHODS, (4.0, 2.5, 1.2, 2.0, 1.2), strict=True))


def plot_flight(path: Path, flight: str, cells: Sequence[Cell]) -> None:
    """Write the picture of ``flight`` as PNG: all seeds, each method in a colour of its own."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mine = [cell for cell in cells if cell.flight == flight]
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    above, errors = figure.subplots(1, 2)
    _draw_ways(above, mine)
    _draw_errors(errors, mine)
    length_m = max(cell.path_length_m for cell in mine)
    seeds = len({cell.seed for cell in mine})
    figure.suptitle(f"{flight}: {length_m:.0f} m, {seeds} seed{'s' if seeds > 1 else ''}")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def _draw_ways(axes: Axes, cells: Sequence[Cell]) -> None:
    for cell in cells:
        way = np.array([[np.nan if v is None else v for v in p] for p in cell.positions_m], float)
        axes.plot(way[:, 0], way[:, 2], **_style(cell, cells))
    truth = np.array(cells[0].true_positions_m)
    axes.plot(truth[:, 0], truth[:, 2], color=TRUTH_COLOUR, lw=1.3, label="ground truth")
    axes.plot(truth[0, 0], truth[0, 2], "o", color=START_COLOUR, ms=9, mec="white", label="start")
    # The world is the left camera at the start: x to the right, z ahead.
    axes.set(title="from above", xlabel="x (m)", ylabel="z (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", framealpha=0.9)
    _grid(axes)


def _draw_errors(axes: Axes, cells: Sequence[Cell]) -> None:
    for cell in cells:
        axes.plot(cell.curve_distance_m, cell.curve_percent, **_style(cell, cells))
    axes.set_ylim(bottom=0)
    axes.set(title="travelled error", xlabel="distance (m)", ylabel="% of the distance")
    axes.legend(loc="best", framealpha=0.9)
    _grid(axes)


def _style(cell: Cell, cells: Sequence[Cell]) -> dict[str, Any]:
    first = next(other for other in cells if other.method == cell.method)
    return {
        "color": COLOURS[cell.method],
        "lw": WIDTHS[cell.method],
        "alpha": 1.0 if cell is first else 0.45,
        "label": cell.method if cell is first else None,
    }


def _grid(axes: Axes) -> None:
    axes.grid(color="#dddddd", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
