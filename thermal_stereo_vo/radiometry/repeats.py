"""Learns how often a camera's link repeats each image by design.

A 9 Hz core on a 30 Hz link sends every image three or four times; that is no freeze.
"""

from __future__ import annotations

from collections import deque

RUNS_KEPT = 16
RUNS_TO_LEARN = 4
REGULAR_RUNS = 3
"""So many repeated images among the last ones are a ratio (25 Hz on 30 Hz), not hiccups."""
LONGEST_NATIVE_RUN = 7
"""60 Hz link, 9 Hz core: six or seven repeats of each image."""


class NativeRepeats:
    """Counts the repeats that follow each new image.

    >>> repeats = NativeRepeats()
    >>> for _ in range(8):
    ...     repeats.renewed()
    >>> repeats.repeated()
    False
    """

    def __init__(self) -> None:
        self._runs: deque[int] = deque(maxlen=RUNS_KEPT)
        self._count = 0

    @property
    def limit(self) -> int:
        """How many repeats of one image are by design; one to spare for jitter."""
        if len(self._runs) < RUNS_TO_LEARN:
            return LONGEST_NATIVE_RUN
        if sum(run > 0 for run in self._runs) < REGULAR_RUNS:
            return 0
        return min(max(self._runs) + 1, LONGEST_NATIVE_RUN)

    def repeated(self) -> bool:
        """An image came again: whether that is by design."""
        self._count += 1
        return self._count <= self.limit

    def renewed(self) -> None:
        """A new image came: learn from the run before it."""
        self._runs.append(min(self._count, LONGEST_NATIVE_RUN))
        self._count = 0

    def restart(self) -> None:
        """A new image came after a freeze, from which nothing is to be learnt."""
        self._count = 0
