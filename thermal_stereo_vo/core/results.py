"""What an odometry method says of one rig frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray


class TrackingStatus(Enum):
    """How much the pose of a result is worth.

    INITIALISING: the start pose, nothing measured yet.  TRACKING: measured.  DEGRADED: measured,
    but with few or badly spread points; the covariance says how much.  GAP: predicted over a gap.
    LOST: no pose at all.
    """

    INITIALISING = "INITIALISING"
    TRACKING = "TRACKING"
    DEGRADED = "DEGRADED"
    GAP = "GAP"
    LOST = "LOST"


@dataclass(frozen=True)
class TrackStats:
    """Counts and figures of one ``process`` call; zero where a stage did not run.

    ``epipolar_dy_px`` is the median row of the right eye less that of the left, ``right_turn_mrad``
    what the method found of pitch, yaw and roll of the right eye that calibration left.
    ``zero_flow`` counts the inliers that kept their pixel though the scene moved: features of the
    sensor itself.  ``scale_sigma`` is the relative standard deviation of an estimated scale, None
    where the scale is no unknown.
    """

    features: int = 0
    matches: int = 0
    inliers: int = 0
    rms_px: float = 0.0
    iterations: int = 0
    evaluations: int = 0
    epipolar_dy_px: float = 0.0
    right_turn_mrad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    zero_flow: int = 0
    scale_sigma: float | None = None
    keyframe: bool = False
    stage_ms: Mapping[str, float] = field(default_factory=dict, compare=False)


@dataclass(frozen=True)
class OdometryResult:
    """Pose and figures for the frame with the same ``stamp_ns``.

    ``T_world_rig`` is (4, 4), or None exactly when the status is LOST.  ``covariance`` is the
    (6, 6) covariance of that pose, accumulated since the start (``core`` states order and axes).
    ``twist`` is (6,): linear (m/s), then angular (rad/s) velocity of the rig in rig axes, with its
    (6, 6) ``twist_covariance``.  ``reset_counter`` grows by one at each recovery from LOST
    and at each reset from outside, and never shrinks.  ``scale_converged`` is false while the
    lengths of pose, twist and map are in an arbitrary unit because the scale still has to be found,
    true once they are metres, and None for a method whose lengths are metres by nature.
    """

    stamp_ns: int
    status: TrackingStatus
    T_world_rig: NDArray[np.float64] | None
    covariance: NDArray[np.float64] | None
    twist: NDArray[np.float64] | None = None
    twist_covariance: NDArray[np.float64] | None = None
    stats: TrackStats = TrackStats()
    reason: str = ""
    reset_counter: int = 0
    scale_converged: bool | None = None

    @property
    def is_metric(self) -> bool:
        """Whether lengths of this result are metres."""
        return self.scale_converged is not False


@dataclass(frozen=True)
class PointCloud:
    """Points in the world frame.

    ``xyz`` (N, 3) float32 metres; ``intensity`` (N,) float32 counts or grey levels;
    ``temperature_kelvin`` (N,) float32 where the counts are radiometric, else None.  From a visible
    and a thermal camera ``intensity`` is that of the visible one and ``thermal_counts`` (N,)
    float32 that of the thermal one, NaN in either for a point the camera did not see; else None.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    temperature_kelvin: NDArray[np.float32] | None = None
    thermal_counts: NDArray[np.float32] | None = None

    @classmethod
    def empty(cls) -> PointCloud:
        """A cloud without points."""
        return cls(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
