"""Noise-free pictures in order, rendered by several processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.presets import plan_run
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.studio import Studio

Job = tuple[str, float]
"""Role of the camera and time (s)."""

_AHEAD = 3
"""Pictures waiting for each process: enough that none stands idle."""


def render_in_order(
    plan: RunPlan, jobs: Iterable[Job], workers: int
) -> Generator[NDArray[np.uint16], None, None]:
    """Yield the signal (H, W) uint16 of each job.

    The pictures do not depend on ``workers``; 0 renders in this process.  Closing the generator
    ends the processes.
    """
    if workers == 0:
        studio = Studio(plan)
        for role, time_s in jobs:
            yield studio.picture(role, time_s).signal
        return
    # A fresh interpreter each: forking a process that runs threads may hang.
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=(plan.preset, plan.config),
    )
    waiting: deque[Future[NDArray[np.uint16]]] = deque()
    remaining = iter(jobs)
    try:
        while True:
            while len(waiting) < _AHEAD * workers:
                job = next(remaining, None)
                if job is None:
                    break
                waiting.append(pool.submit(_render, job))
            if not waiting:
                return
            yield waiting.popleft().result()
    finally:
        with contextlib.suppress(Exception):
            pool.shutdown(wait=True, cancel_futures=True)


_studio: list[Studio] = []
"""The studio of this process; empty in the process that owns the pool."""


def _start(preset: str, config: SimulationConfig) -> None:
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner of the pool hears Ctrl-C
    cv2.setNumThreads(1)
    _studio.append(Studio(plan_run(preset, config)))


def _render(job: Job) -> NDArray[np.uint16]:
    return _studio[0].picture(*job).signal
