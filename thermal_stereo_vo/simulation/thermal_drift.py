"""Temperature of the focal plane array over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.simulation.settings import ThermalCameraConfig


@dataclass(frozen=True)
class FpaTemperature:
    """Warm-up towards a level above the air, with a slow wander as wind and sun change."""

    air_kelvin: float
    config: ThermalCameraConfig
    phase_rad: float
    wander_kelvin: float = 0.12

    @classmethod
    def of(
        cls, air_kelvin: float, config: ThermalCameraConfig, seed: int, camera: int
    ) -> FpaTemperature:
        """Each camera wanders on its own."""
        phase = np.random.default_rng([seed, 32, camera]).uniform(0.0, 2.0 * np.pi)
        return cls(air_kelvin, config, float(phase))

    def kelvin(self, time_s: float) -> float:
        """FPA temperature at a time of the run."""
        config = self.config
        warm = 1.0 - np.exp(-(config.running_s + time_s) / config.warm_up_s)
        wander = self.wander_kelvin * np.sin(time_s / 17.0 + self.phase_rad)
        return float(self.air_kelvin + config.warm_up_kelvin * warm + wander)
