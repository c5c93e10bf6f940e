"""What the 8-bit view is worth to the odometry (Mouats et al. 2015, Fig. 9)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.flown import fly
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.outputs.plots import plot_ways
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.radiometry.agc import AgcConfig

BELOW_THE_SKY = (0.0, 0.4, 1.0, 1.0)

VIEWS: Mapping[str, AgcConfig] = {
    "14 bits cut to 8": AgcConfig(mode="linear", tail_percent=0.0, max_gain=255 / 16383),
    "linear": AgcConfig(mode="linear"),
    "linear, sky left out": AgcConfig(mode="linear", roi=BELOW_THE_SKY),
    "plateau": AgcConfig(mode="plateau"),
    "plateau, sky left out": AgcConfig(mode="plateau", roi=BELOW_THE_SKY),
}
"""Name -> mapping; the first keeps the whole range of the sensor, as an unprocessed image does."""


@dataclass(frozen=True)
class EnhancementCell:
    """One flight seen through one mapping with one seed.

    ``positions_m`` and ``true_positions_m`` (N, 3) in the world of the first pose.
    """

    view: str
    seed: int
    translation_percent: float | None
    final_error_m: float
    mean_inliers: float
    coverage_percent: float
    positions_m: NDArray[np.float64]
    true_positions_m: NDArray[np.float64]

    @property
    def is_followed(self) -> bool:
        """Whether at least half of the frames got a pose."""
        return self.coverage_percent >= 50.0


def measure_views(
    seeds: Sequence[int],
    preset: str,
    overrides: Sequence[str],
    config: Config,
    cache: Path,
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[EnhancementCell]:
    """Fly every seed through every mapping; the rendered pictures are kept below ``cache``."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated

    for seed in seeds:
        settings = (f"render.cache={cache}", *overrides)
        dataset = open_simulated(preset, SourceOptions(seed=seed, overrides=settings))
        for view, agc in VIEWS.items():
            flown = fly(dataset, replace(config, agc=agc))
            yield EnhancementCell(
                view,
                seed,
                flown.metrics.avg_translation_error_percent,
                flown.metrics.final_error_m,
                flown.mean_inliers,
                flown.metrics.coverage_percent,
                flown.positions_m,
                flown.true_positions_m,
            )
            on_progress()


def enhancement_report(cells: Sequence[EnhancementCell]) -> str:
    """A row for each mapping; means over the seeds."""
    rows = []
    for view in dict.fromkeys(cell.view for cell in cells):
        mine = [cell for cell in cells if cell.view == view]
        percents = [c.translation_percent for c in mine if c.translation_percent is not None]
        finals_m = [c.final_error_m for c in mine if c.is_followed]
        rows.append(
            [
                view,
                str(len(mine)),
                f"{np.mean(percents):.3f}" if percents else "-",
                f"{np.mean(finals_m):.3f}" if finals_m else "-",
                f"{np.mean([cell.mean_inliers for cell in mine]):.0f}",
                f"{np.mean([cell.coverage_percent for cell in mine]):.0f}",
            ]
        )
    header = ["view", "seeds", "error (%)", "final (m)", "inliers", "coverage (%)"]
    return format_table(header, rows)


def plot_views(path: Path, cells: Sequence[EnhancementCell]) -> None:
    """Write the ways of the first seed from above, as the paper's Fig. 9, as PNG."""
    mine = [cell for cell in cells if cell.seed == cells[0].seed]
    ways = {
        cell.view if cell.is_followed else f"{cell.view}: nothing to follow": cell.positions_m
        for cell in mine
    }
    truth_m = max((cell.true_positions_m for cell in mine), key=len)
    plot_ways(path, truth_m, ways, "P1 Fig. 9: the same flight through several 8-bit views")
