"""Features of the sensor in place of the scene.

What a flat-field correction leaves of the pattern of a microbolometer sticks to the pixels: a
feature on it has zero flow while the scene moves, and pulls the pose towards standing still.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STANDS_PX = 0.3
"""A feature on the pattern moves by less than this."""
MOVES_PX = 1.0
"""The scene, and the place where the feature should be, must have moved by more than this."""


def on_fixed_pattern(
    before_px: NDArray[np.floating],
    now_px: NDArray[np.floating],
    predicted_px: NDArray[np.floating],
) -> NDArray[np.bool_]:
    """(N,) features that stood still though the scene around them and they themselves should move.

    ``before_px`` and ``now_px`` (N, 2) are their pixels in the same camera, NaN where not found;
    ``predicted_px`` (N, 2) is where each should be now.  Far points in slow flight stand still by
    right: where no motion is predicted nothing is told, and neither where the prediction is wrong,
    as most features then stand still.
    """
    flow_px = np.linalg.norm(now_px - before_px, axis=1)
    found = np.isfinite(flow_px)
    if not np.any(found) or np.median(flow_px[found]) <= MOVES_PX:
        return np.zeros(len(flow_px), np.bool_)
    expected_px = np.linalg.norm(predicted_px - before_px, axis=1)
    return np.asarray((flow_px < STANDS_PX) & (expected_px > MOVES_PX))
