"""How the rig moves while a frame is looked at, for cameras that looked a little earlier.

At 30 deg/s ten milliseconds are a third of a degree: more than what turning does to the view from a
lever arm of 10 cm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3

_MOST_CHANGE_OF_INTERVAL = 1.5


@dataclass(frozen=True)
class LateCameras:
    """Where the rig was a frame ago, and how it moved.

    ``T_before`` (4, 4) rig from world ``elapsed_s`` ago.  ``twist_before`` (6,) is the mean
    velocity of the interval before, of about the same length, in axes of the rig; None where it is
    not known.  ``lags_s`` (C,) is how late the cameras are.
    """

    lags_s: NDArray[np.float64]
    T_before: NDArray[np.float64]
    elapsed_s: float
    twist_before: NDArray[np.float64] | None

    @classmethod
    def after(
        cls,
        lags_s: NDArray[np.float64],
        T_before: NDArray[np.float64],
        elapsed_s: float,
        before: tuple[NDArray[np.float64], float] | None,
    ) -> LateCameras:
        """As above from the mean velocity ``before`` and the seconds that it was taken over."""
        usable = before is not None and (
            1.0 / _MOST_CHANGE_OF_INTERVAL < elapsed_s / before[1] < _MOST_CHANGE_OF_INTERVAL
        )
        return cls(lags_s, T_before, elapsed_s, before[0] if usable and before else None)

    def mean_twist(self, T_rig_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6,) mean velocity since then, if the rig is at ``T_rig_world`` (4, 4) now."""
        return np.asarray(log_se3(self.T_before @ inverse(T_rig_world)) / self.elapsed_s)

    def twist(self, T_rig_world: NDArray[np.float64], ago_s: float = 0.0) -> NDArray[np.float64]:
        """(6,) velocity ``ago_s`` ago; the mean one is that of the middle of the interval."""
        mean = self.mean_twist(T_rig_world)
        if self.twist_before is None:
            return mean
        share = 0.5 - ago_s / self.elapsed_s
        return np.asarray(mean + share * (mean - self.twist_before))

    def lately(self, T_rig_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6,) velocity in the middle of the longest lag."""
        return self.twist(T_rig_world, 0.5 * float(self.lags_s[np.argmax(np.abs(self.lags_s))]))

    def T_then_now(self, T_rig_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C, 4, 4) rig when each camera looked from the rig at ``T_rig_world`` (4, 4) now."""
        twist = self.lately(T_rig_world)
        return np.stack([exp_se3(lag_s * twist) for lag_s in self.lags_s])
