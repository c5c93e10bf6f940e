"""Whether a method keeps pace with its cameras: as fast as it can, and at their own rate."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config, Pipeline

BESIDE = "bundle"
"""The stage that runs beside the frames, in its thread's processor time."""


@dataclass(frozen=True)
class Pace:
    """One pass over a recording with so many threads.

    ``wall_ms`` (N,) from a frame to its result, which at the cameras' own rate begins when the
    frame was due; ``keyframe`` (N,) bool; ``stages_ms`` stage -> milliseconds in each frame that
    had it; ``elapsed_s`` of all frames together.
    """

    threads: int
    at_rate: bool
    wall_ms: NDArray[np.float64]
    keyframe: NDArray[np.bool_]
    stages_ms: dict[str, list[float]]
    elapsed_s: float

    @property
    def frames_per_s(self) -> float:
        """Frames in a second, on average."""
        return len(self.wall_ms) / self.elapsed_s


def measure_pace(
    recorded: Recorded,
    config: Config,
    *,
    threads: Sequence[int] = (1, 2),
    on_progress: Callable[[], None] = lambda: None,
) -> list[Pace]:
    """With each of ``threads`` one pass as fast as it goes and one at the rate of the cameras."""
    before = cv2.getNumThreads()
    found = []
    try:
        for count in threads:
            cv2.setNumThreads(count)
            for at_rate in (False, True):
                mine = with_overrides(config, [f"odometry.threads={count}"])
                found.append(_one_pass(recorded, mine, count, at_rate, on_progress))
    finally:
        cv2.setNumThreads(before)
    return found


def _one_pass(
    recorded: Recorded,
    config: Config,
    threads: int,
    at_rate: bool,
    on_progress: Callable[[], None],
) -> Pace:
    pipeline = Pipeline(config, recorded.calibration)
    pipeline.warm_up()
    wall_ms, keyframe = [], []
    stages_ms: dict[str, list[float]] = defaultdict(list)
    spent_ms = 0.0
    begin = time.perf_counter()
    for raw, due_s in _due(recorded):
        start = time.perf_counter()
        if at_rate:
            start = begin + due_s
            time.sleep(max(0.0, start - time.perf_counter()))
        found = list(pipeline.push(raw))
        taken_ms = (time.perf_counter() - start) * 1e3
        # Frames of one instant are due together: at rate the last one's time is that of all.
        spent_ms = taken_ms if at_rate else spent_ms + taken_ms
        if found:
            wall_ms.append(spent_ms)
            keyframe.append(found[-1].stats.keyframe)
            for name, stage_ms in {
                **pipeline.take_stage_ms(),
                **found[-1].stats.stage_ms,
            }.items():
                stages_ms[name].append(stage_ms)
            spent_ms = 0.0
        if raw.camera == recorded.cameras[0]:
            on_progress()
    elapsed_s = time.perf_counter() - begin
    pipeline.close()
    return Pace(threads, at_rate, np.array(wall_ms), np.array(keyframe), dict(stages_ms), elapsed_s)


def _due(recorded: Recorded) -> Iterator[tuple[RawFrame, float]]:
    """Frames with the seconds after the first one at which they are there."""
    first_ns = recorded.frames[0].stamp_ns
    for raw in recorded.frames:
        yield raw, (raw.stamp_ns - first_ns) * 1e-9


def pace_report(paces: Sequence[Pace]) -> str:
    """A table of passes, and one of the stages of each."""
    header = ["", "frames/s", "frame", "p95", "keyframe", "p95", "keyframes", "beside", "p95"]
    rows = []
    for pace in paces:
        plain, key = pace.wall_ms[~pace.keyframe], pace.wall_ms[pace.keyframe]
        beside = pace.stages_ms.get(BESIDE, [])
        rows.append(
            [
                _name(pace),
                f"{pace.frames_per_s:.1f}",
                *_two(plain),
                *_two(key),
                f"{len(key)}",
                *_two(beside),
            ]
        )
    parts = [format_table(header, rows)]
    for pace in paces:
        stages = [
            [name, *_two(values), f"{len(values)}", f"{sum(values) / len(pace.wall_ms):.2f}"]
            for name, values in pace.stages_ms.items()
        ]
        parts.append(format_table([_name(pace), "median", "p95", "frames", "ms per frame"], stages))
    return "\n\n".join(parts)


def pace_record(paces: Sequence[Pace]) -> list[dict[str, Any]]:
    """The same figures for a file."""
    return [
        {
            "threads": pace.threads,
            "at_rate": pace.at_rate,
            "frames": len(pace.wall_ms),
            "frames_per_s": pace.frames_per_s,
            "frame_ms": _figures(pace.wall_ms[~pace.keyframe]),
            "keyframe_ms": _figures(pace.wall_ms[pace.keyframe]),
            "keyframes": int(pace.keyframe.sum()),
            "stages_ms": {name: _figures(values) for name, values in pace.stages_ms.items()},
        }
        for pace in paces
    ]


def _name(pace: Pace) -> str:
    threads = "1 thread" if pace.threads == 1 else f"{pace.threads} threads"
    return f"{threads}, {'at the rate of the cameras' if pace.at_rate else 'as fast as it goes'}"


def _figures(values: Sequence[float] | NDArray[np.float64]) -> dict[str, float | None]:
    if len(values) == 0:
        return {"median": None, "p95": None}
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}


def _two(values: Sequence[float] | NDArray[np.float64]) -> list[str]:
    return ["-" if value is None else f"{value:.1f}" for value in _figures(values).values()]
