"""Which keyframe a full window can do without."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse, log_se3

_LEAST_IN_SIGHT = 0.05
_LEAST_POINTS = 10
_TURN = 0.5
_NEAR = 1e-3


def most_dispensable(
    T_k_w: NDArray[np.float64],
    T_new: NDArray[np.float64],
    rho: float,
    points: NDArray[np.int64],
    in_sight: NDArray[np.float64],
) -> int:
    """Index of the keyframe of ``T_k_w`` (K, 4, 4), oldest first, to give up for one at ``T_new``.

    First those of which nearly nothing is in sight any more (``in_sight`` (K,) share of their
    ``points`` (K,)), then, as in DSO (Engel et al., TPAMI 2018), the one that is far from the new
    one and near to others; the newest stays.  Distances are those of what is seen: by translation
    in units of the depth 1 / ``rho``, by rotation as long as it keeps things in sight.
    """
    gone = np.flatnonzero(((in_sight < _LEAST_IN_SIGHT) | (points < _LEAST_POINTS))[:-1])
    if len(gone) > 0:
        return int(gone[0])
    T_all = [*T_k_w, T_new]
    scores = []
    for i, T_i in enumerate(T_k_w[:-1]):
        away = [_distance(T_i @ inverse(T), rho) for j, T in enumerate(T_all) if j != i]
        scores.append(np.sqrt(away[-1]) * np.sum(1.0 / (np.array(away) + _NEAR)))
    return int(np.argmax(scores))


def _distance(T: NDArray[np.float64], rho: float) -> float:
    step = log_se3(T)
    return float(rho * np.linalg.norm(step[:3]) + _TURN * np.linalg.norm(step[3:]))
