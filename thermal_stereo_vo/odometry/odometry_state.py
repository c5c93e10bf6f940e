"""Pose, twist and status over time: what every method keeps, and how it becomes a result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import OutOfOrderError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import exp_se3, inverse, make_transform
from thermal_stereo_vo.odometry.gyro import GyroIntegrator
from thermal_stereo_vo.odometry.inertial_filter import InertialFilter, InertialStep
from thermal_stereo_vo.odometry.motion_prior import (
    ConstantVelocity,
    coasting_covariance,
    coasting_twist_covariance,
)
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig, StatusMachine


@dataclass(frozen=True)
class Lag:
    """How long before the stamp the rig saw what a frame shows, and how well that is known."""

    lag_s: float = 0.0
    sigma_s: float = 0.0


class OdometryState:
    """Where the rig is thought to be.

    ``pose`` is where the rig was when it saw what the last frame shows, measured or predicted;
    while LOST it stays where the rig was lost, so that the pose goes on from there after a
    recovery.  A bolometer shows what it saw its time constant ago, other cameras what they saw
    ``exposure`` ago: results are moved on by that lag, to the stamp of the frame.  A ``gyro``
    guides the rotation of predictions wherever it has samples, and their translation where it
    comes with an accelerometer.
    """

    def __init__(
        self,
        config: StatusConfig,
        T_world_rig: NDArray[np.float64],
        gyro: GyroIntegrator | None = None,
        exposure: Lag = Lag(),
    ) -> None:
        self._gyro = gyro
        self._exposure = exposure
        self._config = config
        self._status = StatusMachine(config)
        self._begin(T_world_rig)

    def restart(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget everything and go on from this pose, which counts as a reset."""
        self._status = StatusMachine(self._config, self._status.reset_counter + 1)
        self._begin(T_world_rig)

    def _begin(self, T_world_rig: NDArray[np.float64]) -> None:
        self.pose = PoseEstimate.start(T_world_rig)
        self._origin_m = self.pose.T_world_rig[:3, 3].copy()
        self.prior = ConstantVelocity()
        self._inertial: InertialFilter | None = None
        if self._gyro is not None and self._gyro.accelerometer is not None:
            self._inertial = InertialFilter(self._gyro.accelerometer, self._gyro.lever_m)
        self._inertial_step: InertialStep | None = None
        self._twist_covariance = np.zeros((6, 6))
        self._stamp_ns: int | None = None
        self._step_s = 0.0
        self._by_bolometer = False

    @property
    def is_lost(self) -> bool:
        """Whether the pose is unknown."""
        return self.status is TrackingStatus.LOST

    @property
    def status(self) -> TrackingStatus:
        """The status of the last result."""
        return self._status.status

    def advance(self, stamp_ns: int, *, by_bolometer: bool | None = False) -> float:
        """Take the stamp of a new frame; returns the seconds since the last one (0 at first).

        ``by_bolometer`` says whether its images lag behind; None when it has none that could tell.
        Raises OutOfOrderError when it does not come later.
        """
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            raise OutOfOrderError(
                f"frame at {stamp_ns} ns does not come after {self._stamp_ns} ns: reset the "
                "odometry after a jump of the clock"
            )
        self._step_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        before_ns = None if self._stamp_ns is None else self._seen_ns
        self._stamp_ns = stamp_ns
        if by_bolometer is not None:
            self._by_bolometer = by_bolometer
        self._go_by_inertia(before_ns)
        return self._step_s

    def rescale(self, factor: float, pose: PoseEstimate, *, is_reset: bool = False) -> None:
        """Lengths were in a unit of ``factor`` so far; the rig is at ``pose`` in the new one.

        Where poses went out before, in another unit, that counts as a reset.
        """
        self._status.reset_counter += int(is_reset)
        lengths = np.array([factor] * 3 + [1.0] * 3)
        self.pose = pose
        self._twist_covariance *= np.outer(lengths, lengths)
        self.prior.rescale(factor)

    def _go_by_inertia(self, before_ns: int | None) -> None:
        """Where the accelerometer leads since the frame before."""
        self._inertial_step = None
        if self._gyro is None or self._inertial is None or before_ns is None:
            return
        felt = self._gyro.increments_between(before_ns, self._seen_ns)
        self._inertial_step = self._inertial.propagate(felt, self.pose.T_world_rig[:3, :3])

    def predicted(self) -> NDArray[np.float64]:
        """(4, 4) T_world_rig at the frame just taken, if the twist has gone on since the last."""
        if self.is_lost:
            return self.pose.T_world_rig @ _turned(self._felt(self._step_s))
        if self._inertial_step is not None:
            return self.pose.T_world_rig @ self._inertial_step.T_before_after
        return self.pose.T_world_rig @ self.predicted_motion(self._step_s)

    def predicted_motion(self, elapsed_s: float) -> NDArray[np.float64]:
        """(4, 4) T_before_after of the last ``elapsed_s`` before the frame just taken."""
        return self.prior.predict(elapsed_s, self._felt(elapsed_s))

    def foretold_covariance(self) -> NDArray[np.float64]:
        """(6, 6) of what the twist foretells of this frame, given the last measured pose.

        It is that of images alone, also where an IMU knows better: what an eye sees is left for no
        less.
        """
        unseen_s = self._status.unseen_s(self._now)
        return coasting_covariance(0.0, unseen_s) + unseen_s**2 * self._twist_covariance

    def started(self, stats: TrackStats, reason: str = "first frame") -> OdometryResult:
        """The first usable frame: its pose is the start."""
        if self._inertial is not None:
            self._inertial.measured(self.pose.T_world_rig, np.zeros((3, 3)))
        return self._result(self._status.started(self._now), stats, reason)

    def measured(
        self,
        pose: PoseEstimate,
        T_after_before: NDArray[np.float64],
        covariance: NDArray[np.float64],
        elapsed_s: float,
        stats: TrackStats,
    ) -> OdometryResult:
        """A pose was measured.

        ``T_after_before`` (4, 4) with the (6, 6) ``covariance`` of its left perturbation is the
        motion over the last ``elapsed_s``, from which the twist follows.
        """
        self.pose = pose
        if self._gyro is not None:
            since_ns = self._seen_ns - round(elapsed_s * 1e9)
            self._gyro.learn_bias(since_ns, self._seen_ns, inverse(T_after_before)[:3, :3])
        if self._inertial is not None:
            R = pose.T_world_rig[:3, :3]
            self._inertial.measured(pose.T_world_rig, R @ covariance[:3, :3] @ R.T)
        self.prior.update(inverse(T_after_before), elapsed_s, covariance)
        self._twist_covariance = covariance / elapsed_s**2
        return self._result(self._status.measured(self._now, stats.inliers), stats, "")

    def unmeasured(self, stats: TrackStats, reason: str) -> OdometryResult:
        """Nothing was measured: coast on the last twist, up to where that is worth nothing."""
        unseen_s = self._status.unseen_s(self._now) - self._step_s
        status = self._status.unmeasured(self._now)
        unknown = coasting_covariance(unseen_s, self._step_s)
        felt = self._felt(self._step_s)
        if felt is not None and self._gyro is not None:
            unknown[3:, 3:] = self._gyro.coasting_variance(unseen_s, self._step_s) * np.eye(3)
        inertial = self._inertial_step
        if self._inertial is not None:
            self._inertial.tilted(float(unknown[3, 3]))
        if status is TrackingStatus.GAP and inertial is not None:
            motion = inertial.T_before_after
            R_after = self.pose.T_world_rig[:3, :3] @ motion[:3, :3]
            unknown[:3, :3] = R_after.T @ inertial.growth @ R_after
            self.pose = self.pose.moved(inverse(motion), unknown)
            self.prior.update(motion, self._step_s)
        elif status is TrackingStatus.GAP:
            self.prior.coast()
            motion = self.prior.predict(self._step_s, felt)
            self.pose = self.pose.moved(inverse(motion), unknown)
            if felt is not None:
                self.prior.turn(felt, self._step_s)
        elif status is TrackingStatus.LOST:
            # The pose stays where it was lost, less and less sure, for the recovery to go on from.
            self.pose = self.pose.moved(inverse(_turned(felt)), unknown)
            if self._inertial is not None:
                self._inertial.lose_track()
        return self._result(status, stats, reason)

    @property
    def _now(self) -> int:
        assert self._stamp_ns is not None
        return self._stamp_ns

    @property
    def _lag(self) -> Lag:
        if not self._by_bolometer:
            return self._exposure
        lag_ms, sigma_ms = self._config.bolometer_lag_ms, self._config.bolometer_lag_sigma_ms
        return Lag(1e-3 * lag_ms, 1e-3 * sigma_ms if lag_ms > 0.0 else 0.0)

    @property
    def _seen_ns(self) -> int:
        """When the rig saw what the frame shows."""
        return self._now - round(self._lag.lag_s * 1e9)

    def _felt(self, elapsed_s: float) -> NDArray[np.float64] | None:
        """(3, 3) rotation of the last ``elapsed_s`` (axes after to before) by the gyro, or None."""
        if self._gyro is None or elapsed_s <= 0.0:
            return None
        return self._gyro.rotation_between(self._seen_ns - round(elapsed_s * 1e9), self._seen_ns)

    def _result(self, status: TrackingStatus, stats: TrackStats, reason: str) -> OdometryResult:
        common = {"stats": stats, "reason": reason, "reset_counter": self._status.reset_counter}
        if status is TrackingStatus.LOST:
            return OdometryResult(self._now, status, None, None, **common)  # type: ignore[arg-type]
        twist_covariance = self._twist_covariance.copy()
        if status is TrackingStatus.GAP:
            unseen_s = self._status.unseen_s(self._now)
            twist_covariance += coasting_twist_covariance(unseen_s)
            if self._gyro is not None and self._felt(self._step_s) is not None:
                twist_covariance[3:] = twist_covariance[:, 3:] = 0.0
                twist_covariance[3:, 3:] = self._gyro.rate_variance(self._step_s) * np.eye(3)
            if self._inertial_step is not None:
                R = self.pose.T_world_rig[:3, :3]
                velocity = R.T @ self._inertial_step.velocity_covariance @ R
                twist_covariance[:3] = twist_covariance[:, :3] = 0.0
                twist_covariance[:3, :3] = velocity
        twist = np.zeros(6) if self.prior.twist is None else self.prior.twist.copy()
        T_world_rig = self.pose.T_world_rig @ exp_se3(twist * self._lag.lag_s)
        return OdometryResult(
            self._now,
            status,
            T_world_rig,
            self._claimed_covariance(T_world_rig, twist, twist_covariance),
            twist=twist,
            twist_covariance=twist_covariance,
            **common,  # type: ignore[arg-type]
        )

    def _claimed_covariance(
        self,
        T_world_rig: NDArray[np.float64],
        twist: NDArray[np.float64],
        twist_covariance: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """That of the pose, of the way through the lag, and of what no residual shows.

        The error of the scale is common to all steps since the start.
        """
        covariance = self.pose.covariance.copy()
        way_m = self._config.scale_sigma * (T_world_rig[:3, 3] - self._origin_m)
        covariance[:3, :3] += np.outer(way_m, way_m)
        lag = self._lag
        if lag.lag_s > 0.0 or lag.sigma_s > 0.0:
            to_world = np.kron(np.eye(2), T_world_rig[:3, :3])
            drift = lag.sigma_s * (to_world @ twist)
            covariance += np.outer(drift, drift)
            covariance += lag.lag_s**2 * to_world @ twist_covariance @ to_world.T
        return covariance


def _turned(rotation: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """(4, 4) a rotation on the spot; none at all where nothing was felt."""
    return make_transform(np.eye(3) if rotation is None else rotation, np.zeros(3))


def with_reasons(result: OdometryResult, *reasons: str) -> OdometryResult:
    """The result with more to say of it, where there is more."""
    return replace(result, reason="; ".join(text for text in (result.reason, *reasons) if text))


def with_stages(result: OdometryResult, stage_ms: dict[str, float]) -> OdometryResult:
    """The result with the times of its stages."""
    return replace(result, stats=replace(result.stats, stage_ms=stage_ms))
