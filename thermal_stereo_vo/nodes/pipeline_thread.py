"""A pipeline on a thread of its own: made ready, fed, started again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import ThermalStereoError
from thermal_stereo_vo.nodes import runtime
from thermal_stereo_vo.nodes.publisher import ResultPublisher
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.pipeline import Config, Pipeline


class PipelineThread:
    """Keeps a node's callbacks short.

    With ``newest_only`` frames that come too fast are dropped and counted.  After a reset the pose
    goes on from the last one that was published.
    """

    def __init__(
        self, node: runtime.BaseNode[Any], publisher: ResultPublisher, *, newest_only: bool
    ) -> None:
        self._node = node
        self._publisher = publisher
        self._worker = runtime.Worker(newest_only=newest_only, on_error=node.fail)
        self._ready = threading.Event()
        self._resets = 0
        self._reset_reason = ""
        self.pipeline: Pipeline | None = None

    @property
    def is_ready(self) -> bool:
        """Whether frames can be processed."""
        return self._ready.is_set()

    def prepare(
        self, config: Config, calibration: RigCalibration, observers: Sequence[Observer] = ()
    ) -> None:
        """Build a pipeline and compile its kernels, which may take a minute the very first time."""
        self._worker.submit(partial(self._prepare, config, calibration, observers))

    def feed(self, work: Callable[[Pipeline], object], *, frame: bool = False) -> None:
        """Do this with the pipeline after all earlier work; an unusable input is refused."""
        self._worker.submit(partial(self._feed, work), frame=frame)

    def start_again(self, reason: str) -> None:
        """Forget all images; any stamp may follow."""
        self._worker.submit(partial(self._start_again, reason))

    def counters(self) -> tuple[tuple[str, str], ...]:
        """For diagnostics."""
        return (
            ("pairs_dropped", str(self._worker.dropped)),
            ("jobs_waiting", str(self._worker.waiting)),
            ("resets", str(self._resets)),
            ("reset_reason", self._reset_reason),
        )

    def close(self) -> None:
        """Finish the frame under way."""
        self._worker.close()

    def _prepare(
        self, config: Config, calibration: RigCalibration, observers: Sequence[Observer]
    ) -> None:
        pipeline = Pipeline(config, calibration, [self._publisher, *observers])
        start_s = time.monotonic()
        pipeline.warm_up()
        self._node.get_logger().info(f"kernels are ready after {time.monotonic() - start_s:.1f} s")
        self.pipeline = pipeline
        self._publisher.expect_another_pipeline()
        if self._publisher.last_pose is not None:
            pipeline.reset(self._publisher.last_pose)
        self._ready.set()

    def _feed(self, work: Callable[[Pipeline], object]) -> None:
        if self.pipeline is None:
            return
        try:
            work(self.pipeline)
        except ThermalStereoError as error:
            self._node.refuse(error)

    def _start_again(self, reason: str) -> None:
        self._node.get_logger().warning(f"the odometry starts again from its last pose: {reason}")
        self._resets += 1
        self._reset_reason = reason
        if self.pipeline is not None:
            last = self._publisher.last_pose
            self.pipeline.reset(np.eye(4) if last is None else last)
