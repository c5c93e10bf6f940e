"""One simulated flight through the pipeline, measured against its truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.metrics import Metrics, evaluate
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.replay import replay
from thermal_stereo_vo.stereo.rectification import Rectifier

if TYPE_CHECKING:
    from thermal_stereo_vo.datasets.simulated import SimulatedDataset


@dataclass(frozen=True)
class Flown:
    """Results of all rig frames, and what they are worth."""

    results: tuple[OdometryResult, ...]
    metrics: Metrics

    @property
    def mean_inliers(self) -> float:
        """Inliers of a frame, on average."""
        return float(np.mean([result.stats.inliers for result in self.results]))

    @property
    def lost_frames(self) -> int:
        """Frames without a pose."""
        return sum(result.status is TrackingStatus.LOST for result in self.results)


def fly(dataset: SimulatedDataset, config: Config) -> Flown:
    """Replay a simulated flight and evaluate it against the true path of the rectified rig."""
    calibration = dataset.calibration()
    results = replay(dataset, calibration, config).results
    truth = dataset.ground_truth()
    T_rig_rectified = Rectifier(calibration, config.rectification).T_rig_rectified
    posed = [result for result in results if result.T_world_rig is not None]
    estimate = Trajectory(
        np.array([result.stamp_ns for result in posed], np.int64),
        np.array([result.T_world_rig for result in posed]),
    )
    metrics = evaluate(estimate, Trajectory(truth.stamps_ns, truth.T_world_rig @ T_rig_rectified))
    return Flown(results, metrics)
