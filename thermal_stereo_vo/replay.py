"""A recording through the pipeline, from the first frame to the figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.datasets.base import Dataset, WithImu
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
    Inertial measurements go before the frames that they reach up to.

    Raises DatasetError for a recording without the cameras that the method needs.
    """
    pipeline = Pipeline(config, calibration, observers)
    needed = pipeline.rectifier.roles
    if not set(needed) <= set(dataset.cameras):
        pipeline.close()
        raise DatasetError(
            f"the recording '{dataset.name}' has the cameras {', '.join(dataset.cameras)}, but the "
            f"method '{config.odometry.method}' needs {' and '.join(needed)}: choose another "
            "--method, or a calibration and a recording of the same rig"
        )
    timer = FrameTimer()
    results: list[OdometryResult] = []
    try:
        pipeline.warm_up()
        wall_ms = cpu_ms = 0.0
        inertial = _ImuFeed(dataset if pipeline.gyro is not None else None)
        for raw in dataset.frames():
            for sample in inertial.up_to(raw.stamp_ns):
                pipeline.push_imu(sample)
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


class _ImuFeed:
    """The inertial measurements of a recording, read alongside its frames."""

    def __init__(self, dataset: Dataset | None) -> None:
        self._samples = dataset.imu() if isinstance(dataset, WithImu) else iter(())
        self._last_ns: int | None = None

    def up_to(self, stamp_ns: int) -> Iterator[ImuSample]:
        """Those not yet given, up to the first one that does not come before ``stamp_ns``."""
        while self._last_ns is None or self._last_ns < stamp_ns:
            sample = next(self._samples, None)
            if sample is None:
                return
            self._last_ns = sample.stamp_ns
            yield sample
