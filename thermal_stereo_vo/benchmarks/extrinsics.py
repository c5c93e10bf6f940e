"""What a yaw that calibration left between the eyes costs, with and without its refinement."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermal_stereo_vo.benchmarks.flown import fly
from thermal_stereo_vo.core.cameras import RIGHT, RigCalibration
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.transforms import exp_so3
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config

REFINE = "odometry.windowed.extrinsics.refine"


@dataclass(frozen=True)
class ExtrinsicsCell:
    """One flight with one error of the calibration.

    ``found_mrad`` is the yaw by which the odometry turned the right eye at the end.
    """

    flight: str
    yaw_mrad: float
    refine: bool
    average_percent: float | None
    final_percent: float | None
    found_mrad: float


def with_yaw(calibration: RigCalibration, yaw_mrad: float) -> RigCalibration:
    """The calibration with its right camera turned about its own vertical."""
    right = calibration[RIGHT]
    T_rig_camera = right.T_rig_camera.copy()
    T_rig_camera[:3, :3] = T_rig_camera[:3, :3] @ exp_so3(np.array([0.0, 1e-3 * yaw_mrad, 0.0]))
    turned = replace(right, T_rig_camera=T_rig_camera)
    return replace(calibration, cameras={**calibration.cameras, RIGHT: turned})


def measure_extrinsics(
    flights: Sequence[str],
    yaws_mrad: Sequence[float],
    overrides: Sequence[str],
    config: Config,
    cache: Path,
    step: Callable[[], None] = lambda: None,
) -> Iterator[ExtrinsicsCell]:
    """Fly every flight with every error, both ways; pictures are kept below ``cache``."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated

    for flight in flights:
        settings = (f"render.cache={cache / flight}", *overrides)
        for yaw_mrad in yaws_mrad:
            for refine in (False, True):
                dataset = open_simulated(flight, SourceOptions(overrides=settings))
                flown = fly(
                    dataset,
                    with_overrides(config, (f"{REFINE}={str(refine).lower()}",)),
                    with_yaw(dataset.calibration(), yaw_mrad),
                )
                yield ExtrinsicsCell(
                    flight,
                    yaw_mrad,
                    refine,
                    flown.metrics.avg_translation_error_percent,
                    flown.metrics.final_error_percent,
                    flown.results[-1].stats.right_turn_mrad[1],
                )
                step()


def extrinsics_report(cells: Sequence[ExtrinsicsCell]) -> str:
    """A table with the two ways beside each other."""
    rows = []
    for stored, refined in zip(cells[::2], cells[1::2], strict=True):
        row = [stored.flight, f"{stored.yaw_mrad:+.2f}"]
        for cell in (stored, refined):
            row += [_percent(cell.average_percent), _percent(cell.final_percent)]
        rows.append([*row, f"{refined.found_mrad:+.3f}"])
    header = ["flight", "yaw put in mrad", "as calibrated avg %", "final %", "refined avg %"]
    return format_table([*header, "final %", "yaw found mrad"], rows)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
