"""Where the rig should be next, and how sure one can be of it."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import exp_se3, log_se3, log_so3

# What a quadrotor may do unseen: linear and angular acceleration (1 sigma).
ACCELERATION_M_S2 = 3.0
ANGULAR_ACCELERATION_RAD_S2 = 2.0


MEMORY_S = 0.1
"""Over this time the noise of a twist is averaged before a gap; gusts make a longer one worse."""


class ConstantVelocity:
    """The twist of the last measured motion goes on.

    A noisy measurement moves it no further than accelerations could have changed it (a Kalman
    filter, one gain for the velocity and one for the rate).
    """

    def __init__(self) -> None:
        self.twist: NDArray[np.float64] | None = None
        self._variance = np.zeros(2)
        self._recent: deque[tuple[float, NDArray[np.float64]]] = deque()

    def update(
        self,
        T_before_after: NDArray[np.float64],
        duration_s: float,
        covariance: NDArray[np.float64] | None = None,
    ) -> None:
        """Learn from a measured motion (4, 4), whose ends have this covariance (6, 6) each."""
        measured = log_se3(T_before_after) / duration_s
        noise = np.zeros(2)
        if covariance is not None:
            noise = 2.0 / 3.0 * np.diag(covariance).reshape(2, 3).sum(axis=1) / duration_s**2
        if self.twist is None:
            self.twist, self._variance = measured.copy(), noise
        else:
            accelerations = np.array([ACCELERATION_M_S2, ANGULAR_ACCELERATION_RAD_S2])
            predicted = self._variance + (accelerations * duration_s) ** 2
            gain = predicted / (predicted + noise)
            self.twist = self.twist + np.repeat(gain, 3) * (measured - self.twist)
            self._variance = (1.0 - gain) * predicted
        self._recent.append((duration_s, measured))
        while len(self._recent) > 1 and sum(s for s, _ in self._recent) > 1.01 * MEMORY_S:
            self._recent.popleft()

    def coast(self) -> None:
        """Go on with the mean twist of the last ``MEMORY_S``: for predictions over many frames."""
        if self._recent:
            durations_s, twists = zip(*self._recent, strict=True)
            self.twist = np.average(twists, axis=0, weights=durations_s)
            self._recent.clear()

    def predict(
        self, duration_s: float, rotation: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """(4, 4) T_before_after of the next ``duration_s``; identity while nothing is known.

        ``rotation`` (3, 3) from axes after to axes before takes the place of the twist's own where
        it was felt by other means.
        """
        step = np.zeros(6) if self.twist is None else self.twist * duration_s
        if rotation is not None:
            step[3:] = log_so3(rotation)
        return exp_se3(step)

    def turn(self, rotation: NDArray[np.float64], duration_s: float) -> None:
        """Learn how the rig turned (3, 3) while nothing else was measured."""
        if self.twist is not None:
            self.twist[3:] = log_so3(rotation) / duration_s

    def rescale(self, factor: float) -> None:
        """Multiply all lengths."""
        lengths = np.array([factor] * 3 + [1.0] * 3)
        if self.twist is not None:
            self.twist = self.twist * lengths
        self._variance = self._variance * [factor**2, 1.0]
        self._recent = deque((duration_s, twist * lengths) for duration_s, twist in self._recent)

    def forget(self) -> None:
        """Drop the twist."""
        self.twist = None
        self._recent.clear()


def coasting_covariance(unseen_s: float, step_s: float) -> NDArray[np.float64]:
    """(6, 6) added by ``step_s`` more of coasting after ``unseen_s`` without a measurement.

    Position grows as ``a t^2 / 2``, so that 0.5 s costs 0.38 m and 1.5 m/s at 3 m/s^2; the total
    over many steps equals that of one long one.
    """
    t0, t1 = unseen_s, unseen_s + step_s
    position = (0.5 * ACCELERATION_M_S2) ** 2 * (t1**4 - t0**4)
    angle = (0.5 * ANGULAR_ACCELERATION_RAD_S2) ** 2 * (t1**4 - t0**4)
    return np.diag([position] * 3 + [angle] * 3)


def coasting_twist_covariance(unseen_s: float) -> NDArray[np.float64]:
    """(6, 6) added to the twist's covariance after ``unseen_s`` of coasting."""
    velocity = (ACCELERATION_M_S2 * unseen_s) ** 2
    rate = (ANGULAR_ACCELERATION_RAD_S2 * unseen_s) ** 2
    return np.diag([velocity] * 3 + [rate] * 3)
