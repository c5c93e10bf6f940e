"""What a calibration from board views is worth: simulated boards, whose rig is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.benchmarks.flown import fly
from thermal_stereo_vo.calibration.figures import PairView, triangulated
from thermal_stereo_vo.calibration.gathering import gather
from thermal_stereo_vo.calibration.geometric import calibrate
from thermal_stereo_vo.calibration.image_sources import Source, image_shots, simulated_truth
from thermal_stereo_vo.calibration.result import CalibrationResult
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.transforms import inverse, log_so3, transform_points
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config

BOARDS: Mapping[str, str] = {
    "board_aluminium": "chessboard:8x6:0.06",
    "board_mask": "mask:6x4:0.04",
}
"""Simulated board -> its description."""

ROLES = (LEFT, RIGHT)
TRUTH = "truth"


@dataclass(frozen=True)
class CalibrationCell:
    """One calibration against the truth; of two eyes the worse one counts.

    ``surprise`` is the largest error of a focal length, centre or baseline in units of its claimed
    standard deviation.  ``range_percent`` is the root mean square error of distances of 20 m over
    the picture, to which focal lengths, centres and rotation all contribute.  ``seconds`` goes from
    the pictures to the calibration.
    """

    board: str
    seed: int
    found: int
    views: int
    focal_percent: float
    centre_px: float
    baseline_mm: float
    rotation_mrad: float
    mre_px: float
    epipolar_px: float
    range_percent: float
    surprise: float
    seconds: float


@dataclass(frozen=True)
class FlightCell:
    """One flight under the true calibration or one obtained from a board with some seed."""

    calibration: str
    flight_seed: int
    ate_m: float
    final_m: float
    translation_percent: float | None


def calibrate_simulated(
    board: str, seed: int, views: int, settings: Sequence[str] = ()
) -> tuple[CalibrationCell, RigCalibration]:
    """Calibrate from ``views`` simulated views; the seed changes poses and noise.

    Raises CalibrationError and DatasetError as the calibration itself does.
    """
    world = (f"world.seed={seed}", *settings)
    source = Source((f"sim:{board}",), limit=views, seed=seed, settings=world)
    target = parse_target(BOARDS[board])
    shots = image_shots(source, ROLES)
    truth = simulated_truth(source)
    assert truth is not None
    started = time.perf_counter()
    gathered = gather(shots, target, ROLES)
    result = calibrate(gathered.shots, target, gathered.sizes)
    seconds = time.perf_counter() - started
    found = min(gathered.found(role) for role in ROLES)
    cell = compared(board, seed, result, truth, found, len(shots), seconds)
    return cell, result.rig_calibration(f"{board}, seed {seed}")


def compared(
    board: str,
    seed: int,
    result: CalibrationResult,
    truth: RigCalibration,
    found: int,
    views: int,
    seconds: float,
) -> CalibrationCell:
    """The figures of one calibration of a pair."""
    pair = result.pair
    assert pair is not None
    focal, centre, surprise = [], [], []
    for role in ROLES:
        camera, true, sigma = (
            result.cameras[role].camera,
            truth[role].camera,
            result.cameras[role].sigma,
        )
        ours = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        theirs = np.array([true.fx, true.fy, true.cx, true.cy])
        focal += (100.0 * np.abs(ours / theirs - 1.0))[:2].tolist()
        centre.append(float(np.linalg.norm(ours[2:] - theirs[2:])))
        surprise += (np.abs(ours - theirs) / sigma[:4]).tolist()
    T_true = inverse(truth.T_a_b(*ROLES))
    baseline_m = pair.baseline_m - float(np.linalg.norm(T_true[:3, 3]))
    turn = log_so3(pair.T_second_first[:3, :3] @ T_true[:3, :3].T)
    errors = pair.held_out or pair.training
    return CalibrationCell(
        board,
        seed,
        found,
        views,
        focal_percent=max(focal),
        centre_px=max(centre),
        baseline_mm=1e3 * baseline_m,
        rotation_mrad=1e3 * float(np.linalg.norm(turn)),
        mre_px=max(camera.training.mean_px for camera in result.cameras.values()),
        epipolar_px=max(errors.epipolar_12_px, errors.epipolar_21_px),
        range_percent=range_error_percent(result.rig_calibration(), truth),
        surprise=max(*surprise, abs(baseline_m) / pair.baseline_sigma_m),
        seconds=seconds,
    )


def range_error_percent(
    calibration: RigCalibration, truth: RigCalibration, range_m: float = 20.0
) -> float:
    """Root mean square error of distances measured with a calibration where another one is true.

    Over a grid of points ``range_m`` before the left eye that both eyes see.
    """
    left, right = (truth[role].camera for role in ROLES)
    x, y = np.meshgrid(
        np.linspace(0.1, 0.9, 5) * left.width, np.linspace(0.1, 0.9, 5) * left.height
    )
    points = range_m * left.unproject(np.column_stack([x.ravel(), y.ravel()]))
    seen = PairView(
        "grid",
        np.arange(len(points)),
        left.project(points),
        right.project(transform_points(inverse(truth.T_a_b(*ROLES)), points)),
    )
    first, second = (calibration[role].camera for role in ROLES)
    ours = triangulated(first, second, inverse(calibration.T_a_b(*ROLES)), seen)
    return float(100.0 * np.sqrt(np.mean((ours[:, 2] / points[:, 2] - 1.0) ** 2)))


def measure_flights(
    calibrations: Mapping[str, RigCalibration],
    preset: str,
    settings: Sequence[str],
    seeds: Sequence[int],
    config: Config,
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[FlightCell]:
    """The same flights under the true and under each obtained calibration."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated

    for seed in seeds:
        for name in (TRUTH, *calibrations):
            dataset = open_simulated(preset, SourceOptions(seed=seed, overrides=tuple(settings)))
            metrics = fly(dataset, config, calibrations.get(name)).metrics
            yield FlightCell(
                name,
                seed,
                metrics.ate_rmse_m,
                metrics.final_error_m,
                metrics.avg_translation_error_percent,
            )
            on_progress()


def calibration_report(cells: Sequence[CalibrationCell]) -> str:
    """A row for each calibration, and the worst of each board."""
    header = [
        "board",
        "seed",
        "found",
        "focal (%)",
        "centre (px)",
        "baseline (mm)",
        "rotation (mrad)",
        "MRE (px)",
        "epipolar (px)",
        "range (%)",
        "surprise",
        "s",
    ]
    rows = []
    for board in dict.fromkeys(cell.board for cell in cells):
        mine = [cell for cell in cells if cell.board == board]
        for cell in mine:
            where = [board, str(cell.seed), f"{cell.found} of {cell.views}"]
            rows.append([*where, *_figures(cell), f"{cell.seconds:.1f}"])
        worst = [
            max(values, key=lambda v: abs(float(v)))
            for values in zip(*map(_figures, mine), strict=True)
        ]
        rows.append([board, "worst", "", *worst, f"{max(c.seconds for c in mine):.1f}"])
    notes = [
        "",
        "focal, centre, MRE: of the worse eye; epipolar: on views held out, of the worse direction",
        "range: error of distances of 20 m, over the picture",
        "surprise: largest error of focal lengths, centres and baseline over its claimed sigma",
        "s: from the pictures of both eyes to the calibration, report not included",
    ]
    return "\n".join([format_table(header, rows), *notes])


def _figures(cell: CalibrationCell) -> list[str]:
    return [
        f"{cell.focal_percent:.3f}",
        f"{cell.centre_px:.2f}",
        f"{cell.baseline_mm:+.3f}",
        f"{cell.rotation_mrad:.3f}",
        f"{cell.mre_px:.3f}",
        f"{cell.epipolar_px:.3f}",
        f"{cell.range_percent:.3f}",
        f"{cell.surprise:.1f}",
    ]


def flight_report(cells: Sequence[FlightCell]) -> str:
    """A row for each calibration: means over the flights, and the ratio to the truth."""
    true = [cell for cell in cells if cell.calibration == TRUTH]
    rows = []
    for name in dict.fromkeys(cell.calibration for cell in cells):
        mine = [cell for cell in cells if cell.calibration == name]
        row = [name, str(len(mine))]
        for figure in ("ate_m", "final_m", "translation_percent"):
            ours, theirs = _mean(mine, figure), _mean(true, figure)
            row += (
                ["-", "-"]
                if ours is None or not theirs
                else [
                    f"{ours:.4f}",
                    f"{ours / theirs:.3f}",
                ]
            )
        rows.append(row)
    header = [
        "calibration",
        "flights",
        "ATE (m)",
        "ratio",
        "final (m)",
        "ratio",
        "error (%)",
        "ratio",
    ]
    return format_table(header, rows)


def _mean(cells: Sequence[FlightCell], figure: str) -> float | None:
    values = [getattr(cell, figure) for cell in cells]
    return None if None in values else float(np.mean(values))
