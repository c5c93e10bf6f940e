"""How long frames take."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Milliseconds a frame; None when no frame was timed.

    ``cpu_ms`` is the mean over all threads; ``stages_ms`` the median of each stage over the frames
    in which it ran.
    """

    frames: int
    wall_median_ms: float | None
    wall_p95_ms: float | None
    wall_max_ms: float | None
    cpu_ms: float | None
    stages_ms: Mapping[str, float]

    def as_dict(self) -> dict[str, Any]:
        """What ``timing.json`` holds."""
        return {
            "frames": self.frames,
            "wall_ms_per_frame": {
                "median": self.wall_median_ms,
                "p95": self.wall_p95_ms,
                "max": self.wall_max_ms,
            },
            "cpu_ms_per_frame": self.cpu_ms,
            "stages_ms": dict(self.stages_ms),
        }


class FrameTimer:
    """Collects the times of single frames.

    >>> timer = FrameTimer()
    >>> timer.add(wall_ms=20.0, cpu_ms=25.0, stages_ms={"detect": 5.0})
    >>> timer.summary().wall_median_ms
    20.0
    """

    def __init__(self) -> None:
        self._wall_ms: list[float] = []
        self._cpu_ms: list[float] = []
        self._stages_ms: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def frame(self) -> Iterator[dict[str, float]]:
        """Time one frame; stage times may be put into the dictionary that is handed out.

        A frame that raises is not counted.
        """
        stages_ms: dict[str, float] = {}
        wall_start, cpu_start = time.perf_counter_ns(), time.process_time_ns()
        yield stages_ms
        wall_end, cpu_end = time.perf_counter_ns(), time.process_time_ns()
        self.add((wall_end - wall_start) / 1e6, (cpu_end - cpu_start) / 1e6, stages_ms)

    def add(self, wall_ms: float, cpu_ms: float, stages_ms: Mapping[str, float]) -> None:
        """Count one frame that was timed elsewhere."""
        self._wall_ms.append(wall_ms)
        self._cpu_ms.append(cpu_ms)
        for name, stage_ms in stages_ms.items():
            self._stages_ms[name].append(stage_ms)

    def summary(self) -> Timing:
        """The figures so far; stages in the order of their first appearance."""
        stages_ms = {name: float(np.median(values)) for name, values in self._stages_ms.items()}
        if not self._wall_ms:
            return Timing(0, None, None, None, None, stages_ms)
        return Timing(
            frames=len(self._wall_ms),
            wall_median_ms=float(np.median(self._wall_ms)),
            wall_p95_ms=float(np.percentile(self._wall_ms, 95)),
            wall_max_ms=float(np.max(self._wall_ms)),
            cpu_ms=float(np.mean(self._cpu_ms)),
            stages_ms=stages_ms,
        )
