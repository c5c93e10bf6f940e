"""A source held in memory, so that reading and rendering disturb no measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.datasets.registry import require_calibration
from thermal_stereo_vo.evaluation.metrics import Metrics, evaluate
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier

LEAST_PAIRS = 3


@dataclass(frozen=True)
class Recorded:
    """Frames of a source with what is known of it; ``truth`` is of the rectified rig."""

    name: str
    cameras: tuple[str, ...]
    calibration: RigCalibration
    frames: tuple[RawFrame, ...]
    truth: Trajectory | None

    @property
    def pairs(self) -> int:
        """How many frames the first camera gave."""
        return sum(frame.camera == self.cameras[0] for frame in self.frames)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = self.frames[0].image.shape
        return width, height

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the frames of the first camera."""
        return [frame.stamp_ns for frame in self.frames if frame.camera == self.cameras[0]]

    def metrics(self, results: Iterable[OdometryResult]) -> Metrics | None:
        """Figures of an estimate, or None where nothing is known to compare it with.

        Poses are those of the rectified left camera.  Raises EvaluationError when no stamps agree.
        """
        results = list(results)
        estimate = estimated_trajectory(results)
        if self.truth is None or len(estimate) == 0:
            return None
        stamps = np.array([result.stamp_ns for result in results], np.int64)
        return evaluate(estimate, self.truth, frame_stamps_ns=stamps)


def record(
    dataset: Dataset,
    rectification: RectificationConfig,
    *,
    pairs: int | None = None,
    on_progress: Callable[[], None] = lambda: None,
) -> Recorded:
    """Read the first ``pairs`` pairs (all when None).

    Raises DatasetError for a recording without calibration or with hardly any pair.
    """
    calibration = require_calibration(dataset)
    frames = tuple(_first_pairs(dataset, pairs, on_progress))
    truth = dataset.ground_truth()
    if truth is not None and {LEFT, RIGHT} <= set(calibration.cameras):
        truth = rectified_truth(truth, Rectifier(calibration, rectification))
    recorded = Recorded(dataset.name, tuple(dataset.cameras), calibration, frames, truth)
    if recorded.pairs < LEAST_PAIRS:
        raise DatasetError(
            f"'{dataset.name}' gives {recorded.pairs} pairs: a measurement needs at least "
            f"{LEAST_PAIRS}"
        )
    return recorded


def rectified_truth(truth: Trajectory, rectifier: Rectifier) -> Trajectory:
    """Poses of the rig become those of the rectified left camera, which the results speak of."""
    return Trajectory(truth.stamps_ns, truth.T_world_rig @ rectifier.T_rig_rectified)


def _first_pairs(
    dataset: Dataset, pairs: int | None, on_progress: Callable[[], None]
) -> Iterator[RawFrame]:
    """Frames up to the ``pairs``-th of each camera."""
    seen = dict.fromkeys(dataset.cameras, 0)
    for frame in dataset.frames():
        seen[frame.camera] += 1
        if pairs is None or seen[frame.camera] <= pairs:
            yield frame
            if frame.camera == dataset.cameras[0]:
                on_progress()
        elif min(seen.values()) >= pairs:
            return
