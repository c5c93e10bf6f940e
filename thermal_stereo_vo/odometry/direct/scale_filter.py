"""How well the size of a metric map is known, from keyframe to keyframe."""

from __future__ import annotations

import numpy as np

_TRUST = 8.0
"""Variances by residuals are claimed so many times as large, as those of poses are."""
_OVERLAP = 7.0
"""Windows that share keyframes say nearly the same: so many of them count as one."""


class ScaleFilter:
    """Variance of the logarithm of the size, a random walk that each window measures again.

    A Kalman filter (Kalman, 1960) whose state is the map itself: what was known before enters the
    adjustment as ``hold``.
    """

    def __init__(self, variance: float, drift: float) -> None:
        self._variance = variance
        self._drift = drift

    @property
    def sigma(self) -> float:
        """Relative standard deviation of the size."""
        return float(np.sqrt(self._variance))

    @property
    def hold(self) -> float:
        """Relative standard deviation for an adjustment that takes its own residuals at their word.

        It trusts itself ``_TRUST * _OVERLAP`` times too much, and so shall the past.
        """
        return self.sigma / float(np.sqrt(_TRUST * _OVERLAP))

    def update(self, window_sigma: float) -> None:
        """A window has measured the size so well, as its residuals say; inf: not at all."""
        measured = _TRUST * _OVERLAP * window_sigma**2
        if np.isfinite(measured):
            self._variance *= measured / (self._variance + measured)
        self._variance += self._drift**2
