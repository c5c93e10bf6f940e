"""One picture of a visible + thermal run: the ways from above, and the errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thermal_stereo_vo.evaluation.band_cell import BandCell, array
from thermal_stereo_vo.outputs.plots import DPI, START_COLOUR, TRUTH_COLOUR
from thermal_stereo_vo.outputs.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito: told apart by all kinds of colour vision.
COLOURS = {"both": "#009E73", "visible": "#0072B2", "thermal": "#D55E00", "feature": "#CC79A7"}


def plot_bands(path: Path, flight: str, cells: Sequence[BandCell]) -> None:
    """Write the picture of ``flight`` as PNG, each contender in a colour of its own."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mine = [cell for cell in cells if cell.flight == flight]
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    above, errors = figure.subplots(1, 2)
    seen: set[str] = set()
    for cell in mine:
        colour = COLOURS.get(cell.contender, "#999999")
        label = None if cell.contender in seen else cell.contender
        alpha = 1.0 if label else 0.4
        seen.add(cell.contender)
        way, times = array(cell.positions_m).reshape(-1, 3), array(cell.times_s)
        above.plot(way[:, 0], way[:, 2], color=colour, alpha=alpha, lw=1.2, label=label)
        errors.plot(times, array(cell.errors_m), color=colour, alpha=alpha, lw=1.2, label=label)
        if cell.converged_after_s and cell.contender == "both":
            errors.axvline(cell.converged_after_s, color=colour, alpha=alpha, lw=0.8, ls=":")
    longest = max(mine, key=lambda cell: len(cell.true_positions_m))
    truth = array(longest.true_positions_m).reshape(-1, 3)
    above.plot(truth[:, 0], truth[:, 2], color=TRUTH_COLOUR, lw=1.0, label="ground truth")
    above.plot(truth[:1, 0], truth[:1, 2], "o", color=START_COLOUR, ms=8, mec="white")
    above.set(title="from above, fitted with scale", xlabel="x (m)", ylabel="z (m)")
    above.set_aspect("equal", adjustable="datalim")
    errors.set(title="position error (dotted: scale known)", xlabel="time (s)", ylabel="m")
    errors.set_ylim(bottom=0)
    for axes in (above, errors):
        _dress(axes)
    seeds = len({cell.seed for cell in mine})
    figure.suptitle(f"{flight}: {mine[0].path_length_m:.1f} m, {seeds} seed{'s' * (seeds > 1)}")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def _dress(axes: Axes) -> None:
    axes.legend(loc="best", framealpha=0.9)
    axes.grid(color="#dddddd", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
