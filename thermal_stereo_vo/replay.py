"""A recording through the pipeline, from the first frame to the figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.evaluation.timing import FrameTimer, Timing
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.pipeline import Config, Pipeline


@dataclass(frozen=True)
class Replayed:
    """All results in order, and how long they took."""

    results: tuple[OdometryResult, ...]
    timing: Timing


def replay(
    dataset: Dataset,
    calibration: RigCalibration,
    config: Config,
    observers: Sequence[Observer] = (),
    *,
    on_progress: Callable[[], None] = lambda: None,
) -> Replayed:
    """Run every frame of a recording through one pipeline.

    Kernels are warm before the first frame.  Reading and decoding is not part of the times;
    ``on_progress`` is called after each rig frame.  Observers are closed also after an error.
    """
    pipeline = Pipeline(config, calibration, observers)
    timer = FrameTimer()
    results: list[OdometryResult] = []
    try:
        pipeline.warm_up()
        wall_ms = cpu_ms = 0.0
        for raw in dataset.frames():
            wall, cpu = time.perf_counter(), time.process_time()
            found = list(pipeline.push(raw))
            wall_ms += (time.perf_counter() - wall) * 1e3
            cpu_ms += (time.process_time() - cpu) * 1e3
            if not found:
                continue
            results += found
            stages_ms = {**pipeline.take_stage_ms(), **found[-1].stats.stage_ms}
            timer.add(wall_ms, cpu_ms, stages_ms)
            wall_ms = cpu_ms = 0.0
            on_progress()
        results += pipeline.flush()
    finally:
        pipeline.close()
    return Replayed(tuple(results), timer.summary())
