"""What a method may say of its pose, and for how long it may guess.  Shared by all methods."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.results import TrackingStatus


@dataclass(frozen=True)
class StatusConfig:
    """When a measurement is thin, when a prediction is worth nothing, and what stays unknown."""

    degraded_inliers: int = setting(
        30, "Below this many inliers the status is DEGRADED.", minimum=6, maximum=10000
    )
    coast_max_s: float = setting(
        1.5,
        "Longest prediction without a measurement; after that the status is LOST and no pose "
        "goes out.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    scale_sigma: float = setting(
        0.002,
        "Relative uncertainty of all distances by what calibration leaves (baseline, focal length, "
        "relative yaw); no residual shows it, so it is added to the covariance of the position.",
        minimum=0.0,
        maximum=0.2,
    )
    bolometer_lag_ms: float = setting(
        10.0,
        "How long ago a bolometer saw what it shows, its thermal time constant.  Poses from linear "
        "counts (16-bit images) are moved on by this with the twist, those from 8-bit images not.",
        unit="ms",
        minimum=0.0,
        maximum=100.0,
    )
    bolometer_lag_sigma_ms: float = setting(
        2.5,
        "How well that lag is known; adds to the covariance along the twist.",
        unit="ms",
        minimum=0.0,
        maximum=100.0,
    )


class StatusMachine:
    """INITIALISING -> TRACKING <-> DEGRADED; GAP while predicting; LOST beyond ``coast_max_s``."""

    def __init__(self, config: StatusConfig, reset_counter: int = 0) -> None:
        self._config = config
        self.reset_counter = reset_counter
        self.status = TrackingStatus.INITIALISING
        self._last_measured_ns: int | None = None

    def started(self, stamp_ns: int) -> TrackingStatus:
        """The first usable frame."""
        self._last_measured_ns = stamp_ns
        self.status = TrackingStatus.INITIALISING
        return self.status

    def measured(self, stamp_ns: int, inliers: int) -> TrackingStatus:
        """A pose was measured; after LOST this is a recovery and counts as a reset."""
        if self.status is TrackingStatus.LOST:
            self.reset_counter += 1
        self._last_measured_ns = stamp_ns
        thin = inliers < self._config.degraded_inliers
        self.status = TrackingStatus.DEGRADED if thin else TrackingStatus.TRACKING
        return self.status

    def unmeasured(self, stamp_ns: int) -> TrackingStatus:
        """No measurement: predict for a while, then admit to be lost.  LOST stays LOST."""
        if self._last_measured_ns is None:
            self.status = TrackingStatus.INITIALISING
        elif (
            self.status is TrackingStatus.LOST or self.unseen_s(stamp_ns) > self._config.coast_max_s
        ):
            self.status = TrackingStatus.LOST
        else:
            self.status = TrackingStatus.GAP
        return self.status

    def unseen_s(self, stamp_ns: int) -> float:
        """Seconds since the last measurement (0 before the first)."""
        if self._last_measured_ns is None:
            return 0.0
        return (stamp_ns - self._last_measured_ns) * 1e-9
