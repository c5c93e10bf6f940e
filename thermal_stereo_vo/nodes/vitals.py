"""How a process is doing: figures over a window, processor time, memory."""

from __future__ import annotations

import os
import resource
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np


class Window:
    """The last ``size`` values; may be filled by one thread and read by another."""

    def __init__(self, size: int) -> None:
        self._values: deque[float] = deque(maxlen=size)
        self._lock = threading.Lock()

    def add(self, value: float) -> None:
        """Take a value; the oldest goes when there is no room."""
        with self._lock:
            self._values.append(value)

    def fields(self, name: str, *percentiles: int) -> tuple[tuple[str, str], ...]:
        """Percentiles (50 is called median, 100 max) as texts for diagnostics; none without values.

        >>> window = Window(3)
        >>> for value in (9.0, 1.0, 2.0, 3.0):
        ...     window.add(value)
        >>> window.fields("latency_ms", 50, 100)
        (('latency_ms_median', '2.00'), ('latency_ms_max', '3.00'))
        """
        with self._lock:
            values = list(self._values)
        if not values:
            return ()
        names = {50: "median", 100: "max"}
        return tuple(
            (f"{name}_{names.get(percent, f'p{percent}')}", f"{number:.2f}")
            for percent, number in zip(percentiles, np.percentile(values, percentiles), strict=True)
        )


class ProcessLoad:
    """Processor time of this process since the last look, and its memory."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()

    def fields(self) -> tuple[tuple[str, str], ...]:
        """Percent of one core (above 100 with several threads) and resident memory."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        percent = 100.0 * (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-9)
        self._wall_s, self._cpu_s = wall_s, cpu_s
        return ("cpu_percent", f"{percent:.1f}"), ("memory_mb", f"{resident_mb():.1f}")


def resident_mb(pid: int | None = None) -> float:
    """Resident memory of a process, this one unless told (MB).

    Where the system does not say, the largest that this process ever had.
    """
    try:
        pages = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def processor_s(pid: int) -> float:
    """Processor time (s) that another process has used; 0 where the system does not say."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")
