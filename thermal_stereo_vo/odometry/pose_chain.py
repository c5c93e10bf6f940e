"""The running pose: relative motions composed, covariances with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse, orthonormalised, skew


@dataclass(frozen=True)
class PoseEstimate:
    """``T_world_rig`` (4, 4) and its (6, 6) covariance in world axes (see ``core``)."""

    T_world_rig: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def start(cls, T_world_rig: NDArray[np.float64] | None = None) -> PoseEstimate:
        """A pose known exactly: the origin unless given."""
        return cls(np.eye(4) if T_world_rig is None else T_world_rig.copy(), np.zeros((6, 6)))

    def moved(
        self, T_after_before: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> PoseEstimate:
        """The pose after a measured motion.

        ``T_after_before`` (4, 4) maps coordinates before the motion to those after it;
        ``covariance`` (6, 6) is that of its left perturbation (rho, phi), in axes after it.
        """
        T_before_after = inverse(T_after_before)
        T_world_after = orthonormalised(self.T_world_rig @ T_before_after)
        arm_m = self.T_world_rig[:3, :3] @ T_before_after[:3, 3]
        F = np.eye(6)
        F[:3, 3:] = -skew(arm_m)
        G = np.kron(np.eye(2), T_world_after[:3, :3])
        grown = F @ self.covariance @ F.T + G @ covariance @ G.T
        return PoseEstimate(T_world_after, 0.5 * (grown + grown.T))
