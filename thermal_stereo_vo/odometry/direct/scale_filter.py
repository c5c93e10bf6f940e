"""How large a map is and how well that is known, from keyframe to keyframe."""

from __future__ import annotations

from collections import deque

import numpy as np

_TRUST = 16.0
"""Errors of windows have so many times the variance that their residuals claim."""
_OVERLAP = 3.5
"""Windows that share keyframes say nearly the same: so many of them count as one."""
_UNSURE_POSES = 8.0
"""What the covariance of poses says of sizes has so many times less variance than errors have."""
_SETTLING = 12.0
"""Windows over which a young map comes to rest."""
_OUTLIER = 3.0
_MEMORY = 16
_MOST_STRANGENESS = 6.0
"""Mean square of the last windows' errors over what they should be; about 0.5 for a right rig."""


class ScaleFilter:
    """Logarithm of the size, a random walk that each window measures again.

    A Kalman filter (Kalman, 1960) in which a window that is too far off weighs less (Huber).  Once
    the map has taken the size over (``settle``) what is known of it enters the next adjustment as
    ``hold``.  The size walks by ``drift`` (relative, 1 sigma) from window to window, at first by
    ``first_drift`` more, while depths of the map still settle.
    """

    def __init__(self, drift: float, first_drift: float) -> None:
        self._drift = drift
        self._first_drift = first_drift
        self._age = 0
        self._variance = np.inf
        self.log_scale = 0.0
        self.count = 0
        """How many windows have said something."""
        self._strangeness: deque[float] = deque(maxlen=_MEMORY)

    @property
    def sigma(self) -> float:
        """Relative standard deviation of the size; infinite before the first window."""
        return float(np.sqrt(self._variance))

    @property
    def agrees(self) -> bool:
        """Whether windows scatter no more than they should: with a wrong rig they do."""
        squares = np.square(self._strangeness)
        return len(squares) > 0 and float(np.mean(squares)) < _MOST_STRANGENESS

    @property
    def hold(self) -> float:
        """Relative standard deviation for an adjustment that takes its own residuals at their word.

        It trusts itself ``_TRUST * _OVERLAP`` times too much, and so shall the past.
        """
        return self.sigma / float(np.sqrt(_TRUST * _OVERLAP))

    def settle(self) -> None:
        """The map has this size from now on: what windows say is by how much it is wrong."""
        self.log_scale = 0.0

    def carry(self, variance: float) -> None:
        """The map has gone on, and what is known of it is less sure by ``variance``, as claimed."""
        self._variance += _UNSURE_POSES * _TRUST * _OVERLAP * variance

    def update(self, log_scale: float, window_sigma: float) -> None:
        """A window says ``log_scale`` and claims ``window_sigma``, infinite where it knows nothing.

        Settled, the adjustment itself has moved the map, and the window says 0.
        """
        young = self._first_drift * float(np.exp(-self._age / _SETTLING))
        self._variance += self._drift**2 + young**2
        self._age += 1
        measured = _TRUST * _OVERLAP * window_sigma**2
        if not np.isfinite(measured):
            return
        self.count += 1
        if np.isinf(self._variance):
            self._variance, self.log_scale = measured, log_scale
            return
        off = log_scale - self.log_scale
        strangeness = abs(off) / np.sqrt(self._variance + measured / _OVERLAP)
        self._strangeness.append(float(strangeness))
        measured *= max(1.0, strangeness / _OUTLIER)
        gain = self._variance / (self._variance + measured)
        self.log_scale += float(gain * off)
        self._variance *= 1.0 - gain
