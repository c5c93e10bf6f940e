"""Poses over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus


@dataclass(frozen=True)
class Trajectory:
    """``stamps_ns`` (N,) int64, strictly increasing; ``T_world_rig`` (N, 4, 4) float64.

    Raises EvaluationError for shapes that do not fit, unordered stamps or numbers that are not
    finite.
    """

    stamps_ns: NDArray[np.int64]
    T_world_rig: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        if self.stamps_ns.shape != (n,) or self.T_world_rig.shape != (n, 4, 4):
            raise EvaluationError(
                f"a trajectory of {self.stamps_ns.shape} stamps cannot have poses of shape "
                f"{self.T_world_rig.shape}"
            )
        if np.any(np.diff(self.stamps_ns) <= 0):
            i = int(np.argmax(np.diff(self.stamps_ns) <= 0)) + 1
            raise EvaluationError(
                f"stamps must increase strictly, but pose {i} at {self.stamps_ns[i]} ns does not "
                f"come after {self.stamps_ns[i - 1]} ns"
            )
        if not np.all(np.isfinite(self.T_world_rig)):
            raise EvaluationError("a trajectory must not hold NaN or infinite numbers")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """(N, 3)."""
        return self.T_world_rig[:, :3, 3]

    @property
    def path_lengths_m(self) -> NDArray[np.float64]:
        """(N,) distance travelled up to each pose, starting with 0."""
        steps_m = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps_m)])


def estimated_trajectory(results: Sequence[OdometryResult]) -> Trajectory:
    """The poses of results in order of their stamps; frames that have none are left out.

    It begins with the last frame of the start: before that one nothing was measured, and the pose
    that stands there is no estimate.  Where the scale converged on the way, only metric poses are
    left; where it never did, all are, in their arbitrary unit.
    """
    metric_only = any(result.scale_converged for result in results)
    posed = [
        (result.stamp_ns, result.T_world_rig)
        for result in results[start_index(results) :]
        if result.T_world_rig is not None and (result.is_metric or not metric_only)
    ]
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in posed], np.int64)
    poses = np.array([T_world_rig for _, T_world_rig in posed], np.float64)
    return Trajectory(stamps_ns, poses.reshape(-1, 4, 4))


def start_index(results: Sequence[OdometryResult]) -> int:
    """Where the last frame of the start stands; 0 for no results."""
    initialising = TrackingStatus.INITIALISING
    started = next((i for i, r in enumerate(results) if r.status is not initialising), len(results))
    return max(started - 1, 0)
