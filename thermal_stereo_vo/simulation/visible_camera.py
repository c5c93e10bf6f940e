"""From light to 8 bits: exposure, photons, read noise, gain."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.settings import VisibleCameraConfig

SIGNAL_STEP = 1.0 / 32768.0
"""Light of one step of the stored noise-free signal; 1 is a white surface in daylight."""


class VisibleCamera:
    """An 8-bit camera with automatic exposure, then gain, for the light at hand.

    ``illumination`` is that of the scene relative to daylight; it fixes exposure and gain, as a
    well-tuned control loop would.
    """

    def __init__(
        self, config: VisibleCameraConfig, illumination: float, seed: tuple[int, ...]
    ) -> None:
        self._config, self._seed = config, seed
        # A grey of 25 % shall come out at 30 % of the range.
        wanted = 0.30 / 0.25 * config.full_well / (config.electrons * max(illumination, 1e-9))
        self.exposure_s = float(min(wanted, config.longest_ms * 1e-3))
        self.gain = float(min(wanted / self.exposure_s, config.highest_gain))

    def expose(
        self, signal: NDArray[np.uint16], illumination: float, index: int
    ) -> NDArray[np.uint8]:
        """(H, W) uint8 frame of a signal (H, W) uint16 in ``SIGNAL_STEP`` of the illumination."""
        config = self._config
        light = signal.astype(np.float32) * np.float32(SIGNAL_STEP * illumination)
        if config.blur_px > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), config.blur_px)
        electrons = np.minimum(
            light * np.float32(config.electrons * self.exposure_s), config.full_well
        )
        rng = np.random.Generator(np.random.SFC64([*self._seed, index]))
        noise = rng.standard_normal(light.shape, np.float32)
        noisy = electrons + np.sqrt(electrons + config.read_noise**2, dtype=np.float32) * noise
        grey = noisy * np.float32(self.gain * 255.0 / config.full_well) + np.float32(2.0)
        return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
