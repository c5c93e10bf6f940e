"""What an inertial sensor measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ImuSample:
    """One measurement: ``rate_rad_s`` (3,) is the angular velocity in axes of the IMU."""

    stamp_ns: int
    rate_rad_s: NDArray[np.float64]
