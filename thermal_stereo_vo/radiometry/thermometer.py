"""From linear counts to temperature.

The camera makers' form of Planck's law over 8-14 um (FLIR A15 manual, "Planck constants"):
``S = R / (exp(B / T) - F) + O`` for a black body of T kelvin; a grey one of emissivity e shows
``e S(T) + (1 - e) S(T_surroundings)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting


@dataclass(frozen=True)
class ThermometerConfig:
    """The radiometric calibration of the camera whose counts become temperatures."""

    planck_r: float = setting(
        0.0, "R of the camera's Planck curve; 0: counts mean no temperature.", unit="counts",
        minimum=0.0, maximum=1e9,
    )  # fmt: skip
    planck_b: float = setting(
        1428.0, "B of the camera's Planck curve.", unit="K", minimum=100.0, maximum=10_000.0
    )
    planck_f: float = setting(1.0, "F of the camera's Planck curve.", minimum=-10.0, maximum=1000.0)
    offset_counts: float = setting(
        0.0, "O: counts of a scene that does not radiate.", unit="counts", minimum=-1e6,
        maximum=1e6,
    )  # fmt: skip
    emissivity: float = setting(
        1.0, "Emissivity that all surfaces are taken to have.", minimum=0.1, maximum=1.0
    )
    surroundings_kelvin: float = setting(
        280.0, "Temperature of what they reflect, where the emissivity is below 1.", unit="K",
        minimum=1.0, maximum=1000.0,
    )  # fmt: skip


class Thermometer:
    """Reads temperatures off linear counts."""

    def __init__(self, config: ThermometerConfig) -> None:
        self._config = config

    @classmethod
    def of(cls, config: ThermometerConfig) -> Thermometer | None:
        """A thermometer, or None where no calibration is given."""
        return cls(config) if config.planck_r > 0.0 else None

    def kelvin(self, counts: NDArray[Any]) -> NDArray[np.float32]:
        """Temperatures, float32 of the same shape; NaN for counts that no temperature gives."""
        c = self._config
        signal = np.asarray(counts, np.float64) - c.offset_counts
        reflected = self.counts(np.array(c.surroundings_kelvin)) - c.offset_counts
        signal = (signal - (1.0 - c.emissivity) * reflected) / c.emissivity
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(c.planck_r / signal + c.planck_f)
            kelvin = np.where((signal > 0.0) & (logarithm > 0.0), c.planck_b / logarithm, np.nan)
        return kelvin.astype(np.float32)

    def counts(self, kelvin: NDArray[Any]) -> NDArray[np.float64]:
        """Counts of black bodies of these temperatures."""
        c = self._config
        exponential = np.exp(c.planck_b / np.asarray(kelvin, np.float64))
        return np.asarray(c.planck_r / (exponential - c.planck_f) + c.offset_counts)
