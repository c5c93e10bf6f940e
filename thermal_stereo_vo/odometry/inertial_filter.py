"""Velocity of the rig and gravity, from tracked positions and the specific force that was felt.

A linear Kalman filter: attitudes come from images and gyro, and all the rest enters linearly.  It
carries the rig over the time in which it sees nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import make_transform
from thermal_stereo_vo.odometry.gyro import AccelerometerConfig, Increments
from thermal_stereo_vo.odometry.information import positive

GRAVITY_M_S2 = 9.81
GRAVITY_TOLERANCE_M_S2 = 0.5
"""What feels another gravity than this has other units or axes, or no accelerometer."""
GRAVITY_WALK = 0.002
"""m/s^2/sqrt(s): the attitude of the odometry drifts against it."""
START_SPEED_M_S, START_ACCELERATION_M_S2 = 10.0, 3.0
POSITION_SIGMA_M = 0.006
"""Least noise of a tracked position; keyframes and their adjustment make it jump that much."""
SETTLED_M_S = 0.3
"""Velocity must be known to this before it is gone by."""
SURPRISE_MEMORY = 40
MOST_SURPRISE = 25.0
"""Squared innovations this many times larger than foreseen: something is wrong with the IMU."""
P, V, G, B = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True)
class InertialStep:
    """How the rig moved by what the IMU felt.

    ``T_before_after`` (4, 4); ``growth`` (3, 3) of the covariance of its position and
    ``velocity_covariance`` (3, 3), both in world axes.
    """

    T_before_after: NDArray[np.float64]
    growth: NDArray[np.float64]
    velocity_covariance: NDArray[np.float64]


class InertialFilter:
    """State (12,): position and velocity of the IMU, gravity, all in the world, and force bias.

    ``lever_m`` (3,) is the position of the IMU in the rig.
    """

    def __init__(self, config: AccelerometerConfig, lever_m: NDArray[np.float64]) -> None:
        self._config = config
        self._lever_m = lever_m
        self._x = np.zeros(12)
        self._P = np.zeros((12, 12))
        self._is_started = self._knows_gravity = False
        self._surprise = 1.0
        self._measured_P = np.zeros((3, 3))

    @property
    def gravity_m_s2(self) -> NDArray[np.float64]:
        """(3,) in the world."""
        return self._x[G].copy()

    @property
    def bias_m_s2(self) -> NDArray[np.float64]:
        """(3,) of the specific force, in axes of the rig."""
        return self._x[B].copy()

    @property
    def velocity_m_s(self) -> NDArray[np.float64]:
        """(3,) of the IMU in the world."""
        return self._x[V].copy()

    @property
    def is_trusted(self) -> bool:
        """Whether velocity and gravity are known and what was felt agrees with what was seen."""
        return (
            self._is_started
            and self._knows_gravity
            and float(np.trace(self._P[V, V])) < SETTLED_M_S**2
            and abs(float(np.linalg.norm(self._x[G])) - GRAVITY_M_S2) < GRAVITY_TOLERANCE_M_S2
            and self._surprise < MOST_SURPRISE
        )

    def lose_track(self) -> None:
        """Forget the motion; gravity and bias stay."""
        self._is_started = False

    def propagate(
        self, felt: Increments | None, R_world_rig: NDArray[np.float64]
    ) -> InertialStep | None:
        """Go on by what was felt since the last step, which began in this attitude (3, 3).

        Returns the motion of the rig, or None while it is not to be trusted.
        """
        if felt is None or felt.duration_s <= 0.0:
            self.lose_track()
            return None
        if not self._is_started:
            return None
        if not self._knows_gravity:
            self._x[G] = -R_world_rig @ felt.velocity_m_s / felt.duration_s
            self._P[G, G] = START_ACCELERATION_M_S2**2 * np.eye(3)
            self._P[B, B] = self._config.bias**2 * np.eye(3)
            self._knows_gravity = True
        seconds, before_m, before_P = felt.duration_s, self._x[P].copy(), self._P[P, P].copy()
        F = np.eye(12)
        F[P, V] = seconds * np.eye(3)
        F[P, G] = 0.5 * seconds**2 * np.eye(3)
        F[P, B] = -R_world_rig @ felt.turned_s2
        F[V, G] = seconds * np.eye(3)
        F[V, B] = -R_world_rig @ felt.turned_s
        self._x = F @ self._x
        self._x[P] += R_world_rig @ felt.position_m
        self._x[V] += R_world_rig @ felt.velocity_m_s
        self._P = F @ self._P @ F.T + self._noise(seconds)
        # Seen from the rig: the IMU swings about it.
        moved_m = R_world_rig.T @ (self._x[P] - before_m)
        moved_m -= (felt.rotation - np.eye(3)) @ self._lever_m
        if not self.is_trusted:
            return None
        scale = max(self._surprise, 1.0)
        return InertialStep(
            make_transform(felt.rotation, moved_m),
            scale * positive(self._P[P, P] - before_P),
            scale * self._P[V, V],
        )

    def tilted(self, variance_rad2: float) -> None:
        """The attitude became less sure by this while nothing was seen: gravity seems to turn."""
        self._P[G, G] += GRAVITY_M_S2**2 * variance_rad2 * np.eye(3)

    def measured(
        self, T_world_rig: NDArray[np.float64], covariance_m2: NDArray[np.float64]
    ) -> None:
        """A pose (4, 4) was seen, its position with the noise (3, 3) in world axes."""
        position_m = T_world_rig[:3, :3] @ self._lever_m + T_world_rig[:3, 3]
        noise = covariance_m2 + POSITION_SIGMA_M**2 * np.eye(3)
        if not self._is_started:
            self._x[P], self._x[V] = position_m, 0.0
            self._P[:6, :] = self._P[:, :6] = 0.0
            self._P[P, P], self._P[V, V] = noise, START_SPEED_M_S**2 * np.eye(3)
            self._is_started = True
            return
        innovation = position_m - self._x[P]
        S = self._P[P, P] + noise
        surprise = float(innovation @ np.linalg.solve(S, innovation)) / 3.0
        self._surprise += (surprise - self._surprise) / SURPRISE_MEMORY
        gain = np.linalg.solve(S, self._P[P, :]).T
        self._x = self._x + gain @ innovation
        keep = np.eye(12)
        keep[:, P] -= gain
        self._P = keep @ self._P @ keep.T + gain @ noise @ gain.T

    def _noise(self, seconds: float) -> NDArray[np.float64]:
        """(12, 12) of what is felt wrongly, and of what wanders, within one step."""
        force, eye = self._config.noise**2, np.eye(3)
        noise = np.zeros((12, 12))
        noise[P, P] = force * seconds**3 / 3.0 * eye
        noise[P, V] = noise[V, P] = force * seconds**2 / 2.0 * eye
        noise[V, V] = force * seconds * eye
        noise[G, G] = GRAVITY_WALK**2 * seconds * eye
        noise[B, B] = self._config.bias_walk**2 * seconds * eye
        return noise
