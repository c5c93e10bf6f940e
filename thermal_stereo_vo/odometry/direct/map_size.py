"""The size of a window of keyframes, and how surely it is handed on to the next window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse


def size_of(T_k_w: NDArray[np.float64]) -> float:
    """Root of the sum of squared distances of keyframes (K, 4, 4) to the oldest, the first."""
    return float(np.sqrt(np.sum((T_k_w @ inverse(T_k_w[0]))[:, :3, 3] ** 2)))


def slopes_of_size(T_k_w: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) derivative of the logarithm of the size by what shifts each keyframe.

    By the translations of their left perturbations; about the oldest turns change nothing either.
    """
    T_k_oldest = T_k_w @ inverse(T_k_w[0])
    ways = T_k_oldest[:, :3, 3]
    slopes = ways / (float(np.sum(ways**2)) + 1e-12)
    slopes[0] = -np.einsum("kij,ki->j", T_k_oldest[1:, :3, :3], slopes[1:])
    return np.asarray(slopes)


@dataclass(frozen=True)
class SolvedWindow:
    """Keyframes ``slots``, their poses ``T_k_w`` (K, 4, 4), and the covariance of these.

    ``covariance`` (6 (K-1), 6 (K-1)) of the left perturbations of all but the oldest, given that.
    """

    slots: tuple[int, ...]
    T_k_w: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def variance_of_rest(self, slots: list[int]) -> float:
        """Variance of the logarithm of how large the part ``slots`` is against the whole.

        Known to that much less than the whole is the size of that part, on which the next window
        stands.  Nothing where no two of them are left.
        """
        kept = [i for i, slot in enumerate(self.slots) if slot in slots]
        if len(kept) < 2:
            return 0.0
        slopes = -slopes_of_size(self.T_k_w)
        slopes[kept] += slopes_of_size(self.T_k_w[kept])
        by_pose = np.zeros((len(self.slots) - 1, 6))
        by_pose[:, :3] = slopes[1:]
        slope = by_pose.ravel()
        return float(slope @ self.covariance @ slope)


def variance_of_newest(T_k_w: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """What the place of the newest keyframe (the last) adds to that of the size's logarithm.

    ``covariance`` (6, 6) of its left perturbation, given the others.
    """
    slope = slopes_of_size(T_k_w)[-1]
    return float(slope @ covariance[:3, :3] @ slope)
