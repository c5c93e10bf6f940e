"""How far the rig has turned, as a gyroscope felt it: guidance for the odometry, never required."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

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


class GyroIntegrator:
    """Integrates angular rates, less a bias that it learns.

    ``R_rig_imu`` (3, 3) maps axes of the IMU to those of the rig.
    """

    def __init__(self, config: GyroConfig, R_rig_imu: NDArray[np.float64]) -> None:
        self._config = config
        self._max_gap_ns = round(config.max_gap_ms * 1e6)
        self._R_rig_imu = R_rig_imu
        self._samples: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._learned_s = 0.0
        self.bias = np.zeros(3)
        """(3,) rad/s in axes of the rig."""
        self.error_rad_s = 0.0
        """How far gyro and images differed in the last motion; large where the axes are wrong."""

    def push(self, stamp_ns: int, rate_rad_s: ArrayLike) -> None:
        """Take the next sample, (3,) in axes of the IMU.

        A repeated stamp or a rate that is not finite is passed over; a stamp that goes back starts
        a new record.
        """
        rate = np.asarray(rate_rad_s, dtype=np.float64)
        if not np.all(np.isfinite(rate)):
            return
        if self._samples and stamp_ns <= self._samples[-1][0]:
            if stamp_ns == self._samples[-1][0]:
                return
            self._samples.clear()
        self._samples.append((stamp_ns, self._R_rig_imu @ rate))
        while self._samples[0][0] < stamp_ns - KEPT_NS:
            self._samples.popleft()

    def reset(self) -> None:
        """Forget the samples, as the clock has jumped; the bias stays."""
        self._samples.clear()

    def rotation_between(self, t0_ns: int, t1_ns: int) -> NDArray[np.float64] | None:
        """(3, 3) from rig axes at ``t1_ns`` to those at ``t0_ns``; None where samples are missing.

        Rates are linear between samples (trapezoidal rule); the last one holds for a short while.
        """
        covering = self._covering(t0_ns, t1_ns)
        if not covering:
            return None
        times_s = np.array([stamp_ns - t0_ns for stamp_ns, _ in covering]) * 1e-9
        rates = np.array([rate for _, rate in covering]) - self.bias
        end_s = (t1_ns - t0_ns) * 1e-9
        inside = (times_s > 0.0) & (times_s < end_s)
        knots_s = np.concatenate([[0.0], times_s[inside], [end_s]])
        at_knots = np.column_stack([np.interp(knots_s, times_s, axis) for axis in rates.T])
        rotation = np.eye(3)
        for seconds, rate in zip(
            np.diff(knots_s), 0.5 * (at_knots[1:] + at_knots[:-1]), strict=True
        ):
            rotation = rotation @ exp_so3(rate * seconds)
        return rotation

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

    def _covering(self, t0_ns: int, t1_ns: int) -> list[tuple[int, NDArray[np.float64]]]:
        """The samples from the last one up to ``t0_ns`` to the first one from ``t1_ns`` on.

        Empty when they begin too late or leave too long a gap.
        """
        found: list[tuple[int, NDArray[np.float64]]] = []
        for sample in reversed(self._samples):
            if found and found[-1][0] >= t1_ns and sample[0] >= t1_ns:
                found.pop()
            found.append(sample)
            if sample[0] <= t0_ns:
                break
        found.reverse()
        if not found or found[0][0] > t0_ns:
            return []
        stamps_ns = [stamp_ns for stamp_ns, _ in found]
        stamps_ns.append(max(stamps_ns[-1], t1_ns))
        gaps_ns = (b - a for a, b in pairwise(stamps_ns))
        return found if max(gaps_ns) <= self._max_gap_ns else []
