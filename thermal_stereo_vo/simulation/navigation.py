"""What the other sensors of the airframe would say: inertial unit and satellite receiver.

White noise and random walks as inertial data sheets state them; a satellite fix has a white error
and one that wanders over a minute (first-order Gauss-Markov).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.schedule import stamp_ns
from thermal_stereo_vo.simulation.settings import NavigationConfig
from thermal_stereo_vo.simulation.trajectory import GRAVITY_M_S2

if TYPE_CHECKING:
    from thermal_stereo_vo.simulation.trajectory import Motion

_START_BIAS_RAD_S, _START_BIAS_M_S2 = 2e-3, 0.03
_WANDER_S = 60.0
_LATITUDE_DEG, _LONGITUDE_DEG, _ALTITUDE_M = 52.07, -0.62, 110.0
_EARTH_M = 6378137.0


@dataclass(frozen=True)
class Inertial:
    """One measurement in axes of ``base_link``: turn rate (3,) and specific force (3,)."""

    stamp_ns: int
    rate_rad_s: NDArray[np.float64]
    force_m_s2: NDArray[np.float64]


@dataclass(frozen=True)
class Fix:
    """One satellite fix: latitude and longitude (deg), altitude (m), and the same in the map."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    position_m: NDArray[np.float64]


def inertial_measurements(
    motion: Motion, duration_s: float, config: NavigationConfig, seed: int
) -> Iterator[Inertial]:
    """All measurements of a run, in order of their stamps."""
    rng = np.random.default_rng([seed, 50])
    step_s = 1.0 / config.imu_rate_hz
    upwards = np.array([0.0, 0.0, GRAVITY_M_S2])
    gyro_bias = _START_BIAS_RAD_S * rng.standard_normal(3)
    force_bias = _START_BIAS_M_S2 * rng.standard_normal(3)
    for n in range(int(duration_s * config.imu_rate_hz + 1e-9) + 1):
        time_s = n * step_s
        R_base_map = motion.T_map_base(time_s)[:3, :3].T
        rate = motion.angular_velocity_rad_s(time_s)
        force = R_base_map @ (motion.acceleration_m_s2(time_s) + upwards)
        white = rng.standard_normal((4, 3))
        gyro_bias = gyro_bias + config.gyro_walk * np.sqrt(step_s) * white[0]
        force_bias = force_bias + config.accelerometer_walk * np.sqrt(step_s) * white[1]
        yield Inertial(
            stamp_ns(time_s),
            rate + gyro_bias + config.gyro_noise / np.sqrt(step_s) * white[2],
            force + force_bias + config.accelerometer_noise / np.sqrt(step_s) * white[3],
        )


def satellite_fixes(
    motion: Motion, duration_s: float, config: NavigationConfig, seed: int
) -> Iterator[Fix]:
    """All fixes of a run; the height errs twice as much as the place."""
    rng = np.random.default_rng([seed, 51])
    step_s = 1.0 / config.gps_rate_hz
    spread = np.array([1.0, 1.0, 2.0])
    wander = config.gps_wander_m * spread * rng.standard_normal(3)
    keep = np.exp(-step_s / _WANDER_S)
    for n in range(int(duration_s * config.gps_rate_hz + 1e-9) + 1):
        time_s = n * step_s
        white = rng.standard_normal((2, 3))
        driving = config.gps_wander_m * np.sqrt(1.0 - keep * keep) * spread
        wander = keep * wander + driving * white[0]
        position = (
            motion.T_map_base(time_s)[:3, 3] + wander + config.gps_noise_m * spread * white[1]
        )
        east, north, up = position
        level = _EARTH_M * np.cos(np.radians(_LATITUDE_DEG))
        yield Fix(
            stamp_ns(time_s),
            _LATITUDE_DEG + float(np.degrees(north / _EARTH_M)),
            _LONGITUDE_DEG + float(np.degrees(east / level)),
            _ALTITUDE_M + float(up),
            position,
        )
