"""When cameras look, when frames get lost, and when shutters close: all times of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.simulation.settings import FfcConfig, SimulationConfig, TimingConfig
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature

START_NS = 1_400_000_000_000_000_000
"""Stamp of time zero; any will do, but a stamp should look like one."""


@dataclass(frozen=True)
class Exposure:
    """One frame of one camera: when it looks, what stamp it bears, whether it gets lost."""

    camera: int
    index: int
    time_s: float
    stamp_ns: int
    dropped: bool


def stamp_ns(time_s: float) -> int:
    """The stamp of a time of the run."""
    return START_NS + round(time_s * 1e9)


def instants_in(duration_s: float, config: SimulationConfig) -> int:
    """How many instants a run of this duration has."""
    if config.duration_s is not None:
        duration_s = min(duration_s, config.duration_s)
    return int(duration_s * config.rate_hz + 1e-9) + 1


def camera_times(
    config: TimingConfig, rate_hz: float, instants: int, camera: int, seed: int
) -> tuple[Exposure, ...]:
    """All exposures of one camera.  The first camera keeps perfect time."""
    rng = np.random.default_rng([seed, 30, camera])
    nominal_s = np.arange(instants) / rate_hz
    delay_s = np.zeros(instants)
    if camera > 0:
        delay_s += (config.skew_ms + config.jitter_ms * rng.standard_normal(instants)) * 1e-3
    dropped = rng.random(instants) < config.dropped_percent / 100.0
    late_s = 1e-3 * config.late_ms * (rng.random(instants) < config.late_percent / 100.0)
    exposures = []
    last_ns = -1
    for i in range(instants):
        seen_s = nominal_s[i] + delay_s[i]
        said_s = (nominal_s[i] if config.hidden else seen_s) + late_s[i]
        last_ns = max(stamp_ns(said_s), last_ns + 1)
        exposures.append(Exposure(camera, i, float(seen_s), last_ns, bool(dropped[i])))
    return tuple(exposures)


def in_order(cameras: list[tuple[Exposure, ...]]) -> list[Exposure]:
    """Exposures of all cameras as they arrive: by stamp, then by camera."""
    return sorted(
        (exposure for camera in cameras for exposure in camera),
        key=lambda exposure: (exposure.stamp_ns, exposure.camera),
    )


def corrections(
    config: FfcConfig, fpa: FpaTemperature, duration_s: float, camera: int, seed: int
) -> tuple[float, ...]:
    """Start times (s) of the flat-field corrections of one camera."""
    if config.mode == "none":
        return ()
    shift_s = 0.0
    if camera > 0 and config.arrangement == "staggered":
        shift_s = config.stagger_s
    if camera > 0 and config.arrangement == "independent":
        shift_s = float(np.random.default_rng([seed, 31, camera]).uniform(0.0, config.period_s))
    if config.mode == "periodic":
        starts = np.arange(config.first_s + shift_s, duration_s, config.period_s)
        return tuple(float(start) for start in starts)
    starts_s: list[float] = []
    reference = fpa.kelvin(0.0)
    for time_s in np.arange(0.0, duration_s, 0.1):
        if abs(fpa.kelvin(time_s) - reference) >= config.step_kelvin:
            starts_s.append(float(time_s + shift_s))
            reference = fpa.kelvin(time_s)
    return tuple(starts_s)
