"""How fast the picture moves, to judge what a stamp difference between two eyes costs."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_SHRINK = 8
_MIN_SIZE = 8
_MIN_RESPONSE = 0.4


class ImageMotion:
    """Global image motion between consecutive frames, by phase correlation of a small copy.

    Fixed pattern noise of single pixels averages out in the small copy, so that it does not pass
    for standing still.  Good to about three pixels a frame, enough to judge a skew.
    ``every``: two consecutive frames out of so many are looked at.
    """

    def __init__(self, every: int = 1) -> None:
        self._every = every
        self._count = 0
        self._last: NDArray[np.float32] | None = None
        self._last_ns = 0
        self._window: NDArray[np.float32] | None = None

    def update(self, image: NDArray[Any], stamp_ns: int) -> float | None:
        """Speed in px/s of full-size pixels since the frame before, or None where it is unclear."""
        turn = self._count % self._every
        self._count += 1
        if turn > 1:
            return None
        if turn == 0 and self._every > 1:
            self._last = None
        size = (image.shape[1] // _SHRINK, image.shape[0] // _SHRINK)
        if min(size) < _MIN_SIZE:
            return None
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        last, self._last = self._last, small
        interval_s = (stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        if last is None or last.shape != small.shape or interval_s <= 0.0:
            return None
        if self._window is None or self._window.shape != small.shape:
            self._window = cv2.createHanningWindow(size, cv2.CV_32F)
        shift, response = cv2.phaseCorrelate(last - last.mean(), small - small.mean(), self._window)
        if not response > _MIN_RESPONSE:
            return None
        return float(np.hypot(*shift)) * _SHRINK / interval_s
