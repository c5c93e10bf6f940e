"""What an IMU felt between two moments: guidance for the odometry, never required."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.transforms import exp_so3, log_so3

KEPT_NS = 12_000_000_000
"""Longer than any prediction may be."""
BIAS_MEMORY_S = 20.0
STILL_RAD_S = 0.1
"""Below this rate errors of scale and of the mounting are too small to be taken for a bias."""
LARGEST_BIAS_RAD_S = 0.3


@dataclass(frozen=True)
class GyroConfig:
    """How much a gyroscope is trusted."""

    enabled: bool = setting(
        False,
        "Predict rotations by the angular rates of an IMU where there are any.  Its axes are those "
        "of the calibration's T_rig_imu, else of base_link.",
    )
    noise: float = setting(
        0.005,
        "Noise density of the rates, vibration of the airframe included.",
        unit="rad/s/sqrt(Hz)",
        minimum=1e-6,
        maximum=1.0,
    )
    bias_error: float = setting(
        0.005,
        "What remains of the bias after it was learned (1 sigma).",
        unit="rad/s",
        minimum=0.0,
        maximum=1.0,
    )
    max_gap_ms: float = setting(
        25.0,
        "Longest silence between two samples that is bridged.",
        unit="ms",
        minimum=1.0,
        maximum=1000.0,
    )


@dataclass(frozen=True)
class AccelerometerConfig:
    """How much an accelerometer is trusted."""

    enabled: bool = setting(
        True,
        "With a gyro, go by the accelerometer too while nothing is seen.  It sits at T_rig_imu of "
        "the calibration, else at the origin of base_link.",
    )
    noise: float = setting(
        0.01,
        "Noise density of the specific force, vibration of the airframe included.",
        unit="m/s^2/sqrt(Hz)",
        minimum=1e-5,
        maximum=10.0,
    )
    bias: float = setting(
        0.1, "Bias before it was learned (1 sigma).", unit="m/s^2", minimum=0.0, maximum=5.0
    )
    bias_walk: float = setting(
        0.003, "Random walk of the bias.", unit="m/s^3/sqrt(Hz)", minimum=0.0, maximum=10.0
    )


@dataclass(frozen=True)
class Increments:
    """What was felt between two moments, in axes of the rig at the first of them.

    ``rotation`` (3, 3) maps axes at the second moment to those at the first.  ``velocity_m_s`` and
    ``position_m`` (3,) are the single and the double integral of the specific force,
    ``turned_s`` and ``turned_s2`` (3, 3) those of the rotation, by which a bias of the force
    enters (preintegration; Forster et al., 2017).
    """

    duration_s: float
    rotation: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]
    position_m: NDArray[np.float64]
    turned_s: NDArray[np.float64]
    turned_s2: NDArray[np.float64]


class _Sample(NamedTuple):
    stamp_ns: int
    rate_rad_s: NDArray[np.float64]
    force: NDArray[np.float64]


class GyroIntegrator:
    """Integrates angular rates, less a bias that it learns, and specific forces along with them.

    ``R_rig_imu`` (3, 3) maps axes of the IMU to those of the rig.  ``accelerometer`` says how far
    forces are trusted, None not at all; ``lever_m`` (3,) is the position of the IMU in the rig.
    """

    def __init__(
        self,
        config: GyroConfig,
        R_rig_imu: NDArray[np.float64],
        accelerometer: AccelerometerConfig | None = None,
        lever_m: NDArray[np.float64] | None = None,
    ) -> None:
        self._config = config
        self.accelerometer = accelerometer
        self.lever_m = np.zeros(3) if lever_m is None else lever_m
        self._max_gap_ns = round(config.max_gap_ms * 1e6)
        self._R_rig_imu = R_rig_imu
        self._samples: deque[_Sample] = deque()
        self._learned_s = 0.0
        self.bias = np.zeros(3)
        """(3,) rad/s in axes of the rig."""
        self.error_rad_s = 0.0
        """How far gyro and images differed in the last motion; large where the axes are wrong."""

    def push(
        self, stamp_ns: int, rate_rad_s: ArrayLike, force_m_s2: ArrayLike | None = None
    ) -> None:
        """Take the next sample, (3,) in axes of the IMU, with the specific force if it is known.

        A repeated stamp or a rate that is not finite is passed over; a stamp that goes back starts
        a new record.
        """
        rate = np.asarray(rate_rad_s, dtype=np.float64)
        force = np.full(3, np.nan) if force_m_s2 is None else np.asarray(force_m_s2, np.float64)
        if not np.all(np.isfinite(rate)):
            return
        if self._samples and stamp_ns <= self._samples[-1].stamp_ns:
            if stamp_ns == self._samples[-1].stamp_ns:
                return
            self._samples.clear()
        self._samples.append(_Sample(stamp_ns, self._R_rig_imu @ rate, self._R_rig_imu @ force))
        while self._samples[0].stamp_ns < stamp_ns - KEPT_NS:
            self._samples.popleft()

    def reset(self) -> None:
        """Forget the samples, as the clock has jumped; the bias stays."""
        self._samples.clear()

    def rotation_between(self, t0_ns: int, t1_ns: int) -> NDArray[np.float64] | None:
        """(3, 3) from rig axes at ``t1_ns`` to those at ``t0_ns``; None where samples are missing.

        Rates are linear between samples (trapezoidal rule); the last one holds for a short while.
        """
        knots = self._knots(t0_ns, t1_ns)
        if knots is None:
            return None
        knots_s, rates, _ = knots
        rotation = np.eye(3)
        for seconds, rate in zip(np.diff(knots_s), 0.5 * (rates[1:] + rates[:-1]), strict=True):
            rotation = rotation @ exp_so3(rate * seconds)
        return rotation

    def increments_between(self, t0_ns: int, t1_ns: int) -> Increments | None:
        """Rotation as by ``rotation_between``, with the integrals of the specific force.

        None where samples are missing or without a force.
        """
        knots = self._knots(t0_ns, t1_ns)
        if knots is None or not np.all(np.isfinite(knots[2])):
            return None
        knots_s, rates, forces = knots
        rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
        turned_s, turned_s2 = np.zeros((3, 3)), np.zeros((3, 3))
        for i, seconds in enumerate(np.diff(knots_s)):
            half = rotation @ exp_so3(0.25 * (rates[i] + rates[i + 1]) * seconds)
            force = half @ (0.5 * (forces[i] + forces[i + 1]))
            position += velocity * seconds + 0.5 * force * seconds**2
            velocity += force * seconds
            turned_s2 += turned_s * seconds + 0.5 * half * seconds**2
            turned_s += half * seconds
            rotation = rotation @ exp_so3(0.5 * (rates[i] + rates[i + 1]) * seconds)
        duration_s = (t1_ns - t0_ns) * 1e-9
        return Increments(duration_s, rotation, velocity, position, turned_s, turned_s2)

    def learn_bias(self, t0_ns: int, t1_ns: int, R_before_after: NDArray[np.float64]) -> None:
        """Compare with the rotation (3, 3) that was measured in images while the rig stood still.

        The bias is the mean difference, which forgets what is older than ``BIAS_MEMORY_S``.
        """
        felt = self.rotation_between(t0_ns, t1_ns)
        if felt is None:
            return
        seconds = (t1_ns - t0_ns) * 1e-9
        error = log_so3(R_before_after.T @ felt) / seconds
        self.error_rad_s = float(np.linalg.norm(error))
        turning = float(np.linalg.norm(log_so3(R_before_after))) / seconds
        if turning > STILL_RAD_S or self.error_rad_s > LARGEST_BIAS_RAD_S:
            return
        self._learned_s = min(self._learned_s + seconds, BIAS_MEMORY_S)
        self.bias = self.bias + error * seconds / self._learned_s

    def coasting_variance(self, unseen_s: float, step_s: float) -> float:
        """rad^2 on each axis by ``step_s`` more of integration after ``unseen_s`` of it."""
        t0, t1 = unseen_s, unseen_s + step_s
        return self._config.noise**2 * step_s + self._config.bias_error**2 * (t1**2 - t0**2)

    def rate_variance(self, step_s: float) -> float:
        """(rad/s)^2 on each axis of the mean rate over ``step_s``."""
        return self._config.noise**2 / step_s + self._config.bias_error**2

    def _knots(
        self, t0_ns: int, t1_ns: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
        """Moments (N,) s after ``t0_ns``, rates less the bias and forces (N, 3) at them."""
        covering = self._covering(t0_ns, t1_ns)
        if not covering:
            return None
        times_s = np.array([sample.stamp_ns - t0_ns for sample in covering]) * 1e-9
        felt = np.array([np.concatenate([s.rate_rad_s - self.bias, s.force]) for s in covering])
        end_s = (t1_ns - t0_ns) * 1e-9
        inside = (times_s > 0.0) & (times_s < end_s)
        knots_s = np.concatenate([[0.0], times_s[inside], [end_s]])
        at_knots = np.column_stack([np.interp(knots_s, times_s, axis) for axis in felt.T])
        return knots_s, at_knots[:, :3], at_knots[:, 3:]

    def _covering(self, t0_ns: int, t1_ns: int) -> list[_Sample]:
        """The samples from the last one up to ``t0_ns`` to the first one from ``t1_ns`` on.

        Empty when they begin too late or leave too long a gap.
        """
        found: list[_Sample] = []
        for sample in reversed(self._samples):
            if found and found[-1].stamp_ns >= t1_ns and sample.stamp_ns >= t1_ns:
                found.pop()
            found.append(sample)
            if sample.stamp_ns <= t0_ns:
                break
        found.reverse()
        if not found or found[0].stamp_ns > t0_ns:
            return []
        stamps_ns = [sample.stamp_ns for sample in found]
        stamps_ns.append(max(stamps_ns[-1], t1_ns))
        gaps_ns = (b - a for a, b in pairwise(stamps_ns))
        return found if max(gaps_ns) <= self._max_gap_ns else []
