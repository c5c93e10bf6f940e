"""One simulated flight through the pipeline, measured against its truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.evaluation.alignment import Alignment, aligned
from thermal_stereo_vo.evaluation.association import compare
from thermal_stereo_vo.evaluation.metrics import Metrics, measure
from thermal_stereo_vo.pipeline import Config, rig_rectifier
from thermal_stereo_vo.replay import replay

if TYPE_CHECKING:
    from thermal_stereo_vo.datasets.simulated import SimulatedDataset


@dataclass(frozen=True)
class Flown:
    """Results of all rig frames, and what they are worth.

    ``positions_m`` and ``true_positions_m`` (N, 3) are the positions that both know, in the world
    of the first pose.
    """

    results: tuple[OdometryResult, ...]
    metrics: Metrics
    positions_m: NDArray[np.float64]
    true_positions_m: NDArray[np.float64]

    @property
    def errors_m(self) -> NDArray[np.float64]:
        """(N, 3) errors of the positions."""
        return self.positions_m - self.true_positions_m

    @property
    def mean_inliers(self) -> float:
        """Inliers of a frame, on average."""
        return float(np.mean([result.stats.inliers for result in self.results]))

    @property
    def zero_flow_percent(self) -> float:
        """Inliers that stuck to the sensor while the scene moved, of each hundred."""
        inliers = sum(result.stats.inliers for result in self.results)
        return 100.0 * sum(result.stats.zero_flow for result in self.results) / max(inliers, 1)

    @property
    def lost_frames(self) -> int:
        """Frames without a pose."""
        return sum(result.status is TrackingStatus.LOST for result in self.results)


def fly(
    dataset: SimulatedDataset, config: Config, calibration: RigCalibration | None = None
) -> Flown:
    """Replay a simulated flight and evaluate it against the true path of the rectified rig.

    ``calibration`` replaces the true one.
    """
    calibration = calibration or dataset.calibration()
    results = replay(dataset, calibration, config).results
    truth = dataset.ground_truth()
    T_rig_rectified = rig_rectifier(config, calibration).T_rig_rectified
    truth = Trajectory(truth.stamps_ns, truth.T_world_rig @ T_rig_rectified)
    stamps_ns = np.array([result.stamp_ns for result in results], np.int64)
    comparison = compare(estimated_trajectory(results), truth, frame_stamps_ns=stamps_ns)
    laid_over = aligned(comparison, Alignment.ORIGIN)
    T_first_world = inverse(comparison.T_world_true[0])
    known = comparison.has_pose
    return Flown(
        results,
        measure(comparison),
        (T_first_world @ laid_over.T_world_est[known])[:, :3, 3],
        (T_first_world @ laid_over.T_world_true[known])[:, :3, 3],
    )
