"""Whether pairwise calibrations around a loop of cameras agree.

Walking from camera to camera and back to the first must end in the identity.  What is left over is
compared with the uncertainty that the pairs claim: an error that every single report hides (a lens
pulled to a wrong place by the same few views) shows here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.result import StoredPair
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import adjoint, inverse, log_se3

Array = NDArray[np.float64]

# 99 % quantile of chi2 with six degrees of freedom.
_CHI2_LIMIT = 16.81


@dataclass(frozen=True)
class LoopClosure:
    """The closure as a twist (6,) (m, rad) with its standard deviations, and its chi2 (6 dof)."""

    cameras: tuple[str, ...]
    twist: Array
    sigma: Array
    chi2: float

    @property
    def agrees(self) -> bool:
        """True when the closure is within the 99 % bound of its uncertainty."""
        return self.chi2 <= _CHI2_LIMIT


def close_loop(pairs: Sequence[StoredPair]) -> LoopClosure:
    """Chain pairs into a loop; each may be used in either direction.

    Raises CalibrationError when they form no loop.
    """
    if len(pairs) < 3:
        raise CalibrationError(
            f"a loop needs at least three pairs of cameras, got {len(pairs)}: give the reports of "
            "pairs that lead back to the first camera"
        )
    start = pairs[0].first
    T_here_start, covariance, here = np.eye(4), np.zeros((6, 6)), start
    names = [start]
    left = list(pairs)
    while left:
        pair = next((p for p in left if here in (p.first, p.second)), None)
        if pair is None:
            known = ", ".join(f"{p.first}-{p.second}" for p in pairs)
            raise CalibrationError(
                f"the pairs {known} form no loop: none of those left begins or ends at '{here}'"
            )
        left.remove(pair)
        if pair.first == here:
            T_next_here, step = pair.T_second_first, pair.covariance
            here = pair.second
        else:
            # Exp(xi) T inverted is T^-1 Exp(-xi) = Exp(-Ad(T^-1) xi) T^-1.
            T_next_here = inverse(pair.T_second_first)
            turn = adjoint(T_next_here)
            step = turn @ pair.covariance @ turn.T
            here = pair.first
        carry = adjoint(T_next_here)
        covariance = step + carry @ covariance @ carry.T
        T_here_start = T_next_here @ T_here_start
        names.append(here)
    if here != start:
        raise CalibrationError(
            f"the pairs lead from '{start}' to '{here}' and not back: give one more pair"
        )
    twist = log_se3(T_here_start)
    return LoopClosure(
        tuple(names),
        twist,
        np.sqrt(np.diag(covariance)),
        float(twist @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ twist),
    )
