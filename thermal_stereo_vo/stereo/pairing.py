"""Which two images belong together.

The pairer works on anything with a ``stamp_ns``, so that capture, correction and rectification all
pair alike, live and in replay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import OutOfOrderError


class Stamped(Protocol):
    """Anything that knows when it was taken."""

    @property
    def stamp_ns(self) -> int:
        """Time of the image."""


Item = TypeVar("Item", bound=Stamped)


@dataclass(frozen=True)
class PairingConfig:
    """How left and right images find each other."""

    tolerance_ms: float = setting(
        10.0,
        "Largest stamp difference of a pair; keep it below half a frame period.",
        unit="ms",
        minimum=0.0,
        maximum=1000.0,
    )
    max_waiting: int = setting(
        4,
        "Frames of one camera that may wait for the other before they go on alone.",
        minimum=1,
        maximum=100,
    )


@dataclass(frozen=True)
class Pair(Generic[Item]):
    """Two items of one instant, or one of them alone (the other is None).

    The common stamp is that of the first camera where it is present.
    """

    first: Item | None
    second: Item | None

    @property
    def stamp_ns(self) -> int:
        """The stamp that both images are published under."""
        item = self.first if self.first is not None else self.second
        assert item is not None
        return item.stamp_ns

    @property
    def skew_ns(self) -> int:
        """Stamp of the second minus stamp of the first; 0 for one alone."""
        if self.first is None or self.second is None:
            return 0
        return self.second.stamp_ns - self.first.stamp_ns


@dataclass
class PairingCounters:
    """What became of the items so far."""

    pairs: int = 0
    first_alone: int = 0
    second_alone: int = 0


class StereoPairer(Generic[Item]):
    """Pairs two streams by nearest stamp within a tolerance, in bounded memory.

    An item is known to be alone as soon as the other stream has passed it by more than the
    tolerance, or when ``max_waiting`` items wait for a stream that is silent.
    """

    def __init__(self, config: PairingConfig) -> None:
        self._tolerance_ns = round(config.tolerance_ms * 1e6)
        self._max_waiting = config.max_waiting
        self._queues: tuple[deque[Item], deque[Item]] = (deque(), deque())
        self._last_ns: list[int | None] = [None, None]
        self._last_pair_ns: int | None = None
        self.counters = PairingCounters()

    def push(self, index: int, item: Item) -> Iterator[Pair[Item]]:
        """Add an item of stream 0 or 1; yields the pairs that are now decided, in stamp order.

        Raises OutOfOrderError when the stamp does not lie after the stream's last one.
        """
        last_ns = self._last_ns[index]
        if last_ns is not None and item.stamp_ns <= last_ns:
            name = getattr(item, "camera", ("first", "second")[index])
            raise OutOfOrderError(
                f"camera '{name}': stamp {item.stamp_ns} ns does not come after {last_ns} ns; "
                "replay recordings in order, or reset after a jump of the clock"
            )
        self._last_ns[index] = item.stamp_ns
        self._queues[index].append(item)
        return self._decided()

    def flush(self) -> Iterator[Pair[Item]]:
        """The stream has ended: what still waits goes on alone."""
        first, second = self._queues
        while first or second:
            if not second or (first and first[0].stamp_ns <= second[0].stamp_ns):
                yield from self._alone(0)
            else:
                yield from self._alone(1)

    def _decided(self) -> Iterator[Pair[Item]]:
        first, second = self._queues
        while first and second:
            skew_ns = second[0].stamp_ns - first[0].stamp_ns
            if skew_ns > self._tolerance_ns or self._next_is_nearer(first, second[0], abs(skew_ns)):
                yield from self._alone(0)
            elif skew_ns < -self._tolerance_ns or self._next_is_nearer(
                second, first[0], abs(skew_ns)
            ):
                yield from self._alone(1)
            else:
                self.counters.pairs += 1
                yield from self._in_order(Pair(first.popleft(), second.popleft()))
        for index, queue in enumerate(self._queues):
            while len(queue) > self._max_waiting:
                yield from self._alone(index)

    @staticmethod
    def _next_is_nearer(queue: deque[Item], other: Item, distance_ns: int) -> bool:
        return len(queue) > 1 and abs(queue[1].stamp_ns - other.stamp_ns) < distance_ns

    def _alone(self, index: int) -> Iterator[Pair[Item]]:
        item = self._queues[index].popleft()
        if index == 0:
            self.counters.first_alone += 1
            yield from self._in_order(Pair(item, None))
        else:
            self.counters.second_alone += 1
            yield from self._in_order(Pair(None, item))

    def _in_order(self, pair: Pair[Item]) -> Iterator[Pair[Item]]:
        # A lone item that waited too long may be older than the last pair: too late to use.
        if self._last_pair_ns is None or pair.stamp_ns > self._last_pair_ns:
            self._last_pair_ns = pair.stamp_ns
            yield pair
