"""How the time of a pair grows with the size of its images, the features and the window."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from thermal_stereo_vo.benchmarks.contest import PipelineContender, contest
from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.config import get, with_overrides
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config

SIZES = (0.5, 0.71, 1.0, 1.41)
FEATURES = (0.5, 1.0, 2.0)
WINDOWS = (3, 5, 7, 10, 15)
POINTS, INTEREST_POINTS = "odometry.windowed.corners.points", "odometry.feature.detector.features"
FRAME_TO_FRAME, WINDOWED = "frame to frame", "windowed"


@dataclass(frozen=True)
class Trial:
    """One setting of one quantity; ``amount`` is what the time is plotted against."""

    method: str
    quantity: str
    label: str
    amount: float
    config: Config
    scale: float = 1.0

    @property
    def name(self) -> str:
        """Unique."""
        return f"{self.method}, {self.quantity} {self.label}"


@dataclass(frozen=True)
class Growth:
    """Times (ms a pair) of the trials of one quantity, and the power of it that they follow."""

    method: str
    quantity: str
    trials: tuple[Trial, ...]
    wall_median_ms: tuple[float, ...]
    wall_p95_ms: tuple[float, ...]
    cpu_ms: tuple[float, ...]

    @property
    def exponent(self) -> float:
        """Of CPU time ~ amount^exponent, by least squares over the logarithms."""
        amounts = np.log([trial.amount for trial in self.trials])
        return float(np.polyfit(amounts, np.log(self.cpu_ms), 1)[0])


def measure_scaling(
    recorded: Recorded, config: Config, *, on_progress: Callable[[], None] = lambda: None
) -> list[Growth]:
    """Every trial takes each frame in turn, on one thread."""
    config = with_overrides(config, ["odometry.threads=1"])
    trials = list(_trials(recorded, config))
    contenders = [
        PipelineContender(
            trial.name, trial.config, scaled_calibration(recorded.calibration, trial.scale)
        )
        for trial in trials
    ]
    prepare = {trial.name: _scaler(trial.scale) for trial in trials if trial.scale != 1.0}
    records = contest(
        contenders, recorded, opencv_threads=1, prepare=prepare, on_progress=on_progress
    )
    by_name = {record.name: record for record in records}
    growths = []
    for method, quantity in dict.fromkeys((trial.method, trial.quantity) for trial in trials):
        mine = [t for t in trials if (t.method, t.quantity) == (method, quantity)]
        times = [by_name[trial.name] for trial in mine]
        growths.append(
            Growth(
                method,
                quantity,
                tuple(mine),
                tuple(float(np.median(record.wall_ms)) for record in times),
                tuple(float(np.percentile(record.wall_ms, 95)) for record in times),
                tuple(float(np.mean(record.cpu_ms)) for record in times),
            )
        )
    return growths


def scaling_report(growths: Sequence[Growth]) -> str:
    """One table for each method and quantity."""
    parts = []
    for growth in growths:
        header = [f"{growth.method}: {growth.quantity}", "median (ms)", "p95 (ms)", "CPU (ms)"]
        rows = [
            [trial.label, f"{median:.1f}", f"{p95:.1f}", f"{cpu:.1f}"]
            for trial, median, p95, cpu in zip(
                growth.trials,
                growth.wall_median_ms,
                growth.wall_p95_ms,
                growth.cpu_ms,
                strict=True,
            )
        ]
        power = f"CPU time grows with the power {growth.exponent:.2f} of the {growth.quantity}"
        parts.append(f"{format_table(header, rows)}\n{power}")
    return "\n\n".join(parts)


def scaling_record(growths: Sequence[Growth]) -> list[dict[str, Any]]:
    """The same figures for a file."""
    return [
        {
            "method": growth.method,
            "quantity": growth.quantity,
            "amount": [trial.amount for trial in growth.trials],
            "wall_median_ms": growth.wall_median_ms,
            "wall_p95_ms": growth.wall_p95_ms,
            "cpu_ms": growth.cpu_ms,
            "exponent": growth.exponent,
        }
        for growth in growths
    ]


def scaled_calibration(calibration: RigCalibration, scale: float) -> RigCalibration:
    """The rig as if its images had been resized by ``scale``."""
    if scale == 1.0:
        return calibration
    cameras = {role: _scaled(mounted, scale) for role, mounted in calibration.cameras.items()}
    return replace(calibration, cameras=cameras)


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """(width, height) after resizing."""
    return round(size[0] * scale), round(size[1] * scale)


def _scaled(mounted: RigCamera, scale: float) -> RigCamera:
    camera = mounted.camera
    width, height = scaled_size(camera.size, scale)
    x, y = width / camera.width, height / camera.height
    # Pixel centres lie at integers: the border of the image, at -0.5, stays where it is.
    S = np.array([[x, 0.0, 0.5 * x - 0.5], [0.0, y, 0.5 * y - 0.5], [0.0, 0.0, 1.0]])
    K = S @ camera.matrix
    smaller = Camera(
        width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.model, camera.distortion
    )
    projection = None if mounted.projection is None else S @ mounted.projection
    return replace(mounted, camera=smaller, projection=projection)


def _scaler(scale: float) -> Callable[[RawFrame], RawFrame]:
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC

    def resize(raw: RawFrame) -> RawFrame:
        height, width = raw.image.shape
        image = cv2.resize(raw.image, scaled_size((width, height), scale), interpolation=method)
        return replace(raw, image=image)

    return resize


def _trials(recorded: Recorded, config: Config) -> Iterator[Trial]:
    frame_to_frame = with_overrides(config, ["odometry.window=0"])
    for method, start, points in (
        (WINDOWED, config, POINTS),
        (FRAME_TO_FRAME, frame_to_frame, INTEREST_POINTS),
    ):
        for scale in SIZES:
            width, height = scaled_size(recorded.image_size, scale)
            label = f"{width}x{height}"
            yield Trial(method, "pixels", label, float(width * height), start, scale)
        for factor in FEATURES:
            count = round(factor * get(start, points))
            yield Trial(
                method,
                "features",
                str(count),
                float(count),
                with_overrides(start, [f"{points}={count}"]),
            )
    for window in WINDOWS:
        changed = with_overrides(config, [f"odometry.window={window}"])
        yield Trial(WINDOWED, "window", f"{window} keyframes", float(window), changed)
