"""One camera's stamps and sequence numbers, made trustworthy."""

from __future__ import annotations

from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.v4l2 import Grab, StampKind

PLAUSIBLE_NS = 1_000_000_000
"""A driver's stamp further than this from the moment of arrival is not on the monotonic clock."""

_WRAP = 1 << 32


class StampSource:
    """Driver stamps to ROS time for one camera.

    A stamp that is not on the monotonic clock, by its flag or by its value, is replaced by the
    moment of arrival; ``by_arrival`` counts them.  ``kind`` is that of the last buffer.
    """

    def __init__(self, clock: EpochClock, offset_ns: int = 0) -> None:
        self._clock = clock
        self._offset_ns = offset_ns
        self._last_ns: int | None = None
        self.kind: StampKind | None = None
        self.by_arrival = 0
        self.backwards = 0

    def stamp_ns(self, grab: Grab) -> int | None:
        """Nanoseconds since 1970, or None for a stamp that does not lie after the last one."""
        self.kind = grab.stamp_kind
        monotonic_ns = grab.driver_ns
        if (
            grab.stamp_kind is StampKind.UNKNOWN_CLOCK
            or abs(grab.arrival_ns - grab.driver_ns) > PLAUSIBLE_NS
        ):
            self.by_arrival += 1
            monotonic_ns = grab.arrival_ns
        stamp_ns = self._clock.to_epoch_ns(monotonic_ns) + self._offset_ns
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            self.backwards += 1
            return None
        self._last_ns = stamp_ns
        return stamp_ns


class SequenceCounter:
    """Continues the driver's 32-bit frame count over wraps and restarts."""

    def __init__(self) -> None:
        self._last: int | None = None
        self.sequence = -1
        self.lost = 0

    def restart(self) -> None:
        """The stream was opened anew: its count starts again, ours goes on."""
        self._last = None

    def update(self, sequence: int) -> int:
        """Our number of the frame that the driver calls ``sequence``; gaps add to ``lost``."""
        step = 1 if self._last is None else (sequence - self._last) % _WRAP
        if not 0 < step < _WRAP // 2:  # the driver began anew by itself
            step = 1
        self._last = sequence
        self.lost += step - 1
        self.sequence += step
        return self.sequence
