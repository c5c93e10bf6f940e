"""What an inertial sensor measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ImuSample:
    """One measurement in axes of the IMU.

    ``rate_rad_s`` (3,) is the angular velocity, ``force_m_s2`` (3,) the specific force where it was
    measured: acceleration less gravity, +9.81 upwards at rest.
    """

    stamp_ns: int
    rate_rad_s: NDArray[np.float64]
    force_m_s2: NDArray[np.float64] | None = None
