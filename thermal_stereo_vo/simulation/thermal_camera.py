"""From radiance to counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.settings import ThermalCameraConfig


class ThermalCamera:
    """One microbolometer camera."""

    def __init__(self, config: ThermalCameraConfig, seed: tuple[int, ...]) -> None:
        self._config = config
        self._seed = seed

    def expose(self, radiance: NDArray[np.float32], index: int) -> NDArray[np.uint16]:
        """(H, W) uint16 counts of frame ``index``."""
        config = self._config
        rng = np.random.default_rng([*self._seed, index])
        noise = rng.standard_normal(radiance.shape, dtype=np.float32)
        sigma = config.netd_mk * 1e-3 * config.counts_per_kelvin
        counts = radiance + config.offset_counts + sigma * noise
        return np.clip(np.rint(counts), 0, 16383).astype(np.uint16)
