"""From the kernel's monotonic clock to ROS time (nanoseconds since 1970), never backwards."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

MAX_SLEW = 500e-6
"""Fraction of time by which stamps may run fast or slow: that of a clock steered by NTP."""

STEP_NS = 100_000_000
"""A system clock ahead by more than this was set, not steered."""

REFRESH_NS = 1_000_000_000


def sample_offset_ns(attempts: int = 5) -> int:
    """System clock minus monotonic clock, to about a microsecond.

    The monotonic clock is read before and after; of several attempts the least interrupted counts.
    """
    best: tuple[int, int] | None = None
    for _ in range(attempts):
        before_ns = time.monotonic_ns()
        epoch_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        width_ns = after_ns - before_ns
        if best is None or width_ns < best[0]:
            best = (width_ns, epoch_ns - (before_ns + width_ns // 2))
    assert best is not None
    return best[1]


class EpochClock:
    """Follows the system clock at no more than ``MAX_SLEW``, so that stamps keep their order.

    A clock set forward (a first GPS or NTP fix) is followed at once.  A clock set back is not:
    stamps stay on the old time and only creep towards the new one; ``behind_ns`` says how far the
    system clock lags then.  All cameras share one object, so that their skew stays what it was.
    """

    def __init__(self, sample: Callable[[], int] = sample_offset_ns) -> None:
        self._sample = sample
        self._lock = threading.Lock()
        self._start_ns: int | None = None
        self._offset_ns = 0
        self._slope = 0.0
        self.steps = 0
        self.behind_ns = 0

    def to_epoch_ns(self, monotonic_ns: int) -> int:
        """Nanoseconds since 1970 of a moment on CLOCK_MONOTONIC."""
        with self._lock:
            if self._start_ns is None:
                self._start_ns, self._offset_ns = monotonic_ns, self._sample()
            elif monotonic_ns - self._start_ns >= REFRESH_NS:
                self._refresh(monotonic_ns)
            return monotonic_ns + self._offset_at(monotonic_ns)

    def _offset_at(self, monotonic_ns: int) -> int:
        assert self._start_ns is not None
        elapsed_ns = min(max(monotonic_ns - self._start_ns, 0), REFRESH_NS)
        return self._offset_ns + round(self._slope * elapsed_ns)

    def _refresh(self, monotonic_ns: int) -> None:
        current_ns = self._offset_at(monotonic_ns)
        target_ns = self._sample()
        error_ns = target_ns - current_ns
        if error_ns > STEP_NS:
            self.steps += 1
            current_ns, error_ns = target_ns, 0
        self.behind_ns = max(-error_ns, 0)
        # The rest is spread over the time until the next look, so that no two stamps change order.
        self._slope = max(-MAX_SLEW, min(MAX_SLEW, error_ns / REFRESH_NS))
        self._start_ns, self._offset_ns = monotonic_ns, current_ns
