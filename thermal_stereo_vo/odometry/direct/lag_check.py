"""Whether the second camera's stamps keep step with those of the first.

A constant lag is estimated and does no harm.  One that grows is another clock: within a window the
camera then moves otherwise than the rig, and the size of the map comes out wrong.
"""

from __future__ import annotations

from collections import deque

import numpy as np

_MEMORY = 10
_LEAST_WINDOWS = 4
_LEAST_SURE = 0.03
"""A window counts that claims to tell the lag better than this share of the limit."""
_RELIEF = 0.5


class LagCheck:
    """Gathers what windows say of the lag."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._recent: deque[float] = deque(maxlen=_MEMORY)
        self.drift_s: float | None = None
        """How far the lag has moved within the last windows; None while it may well stand."""

    def add(self, lag_s: float, sigma_s: float) -> None:
        """Take in what a window said; told stays told until half of the limit."""
        if sigma_s > _LEAST_SURE * self._limit_s:
            return
        self._recent.append(lag_s)
        if len(self._recent) < _LEAST_WINDOWS:
            return
        moved_s = float(np.ptp(self._recent))
        limit_s = self._limit_s if self.drift_s is None else _RELIEF * self._limit_s
        self.drift_s = moved_s if moved_s > limit_s else None
