"""Contenders timed on the same frames, one after the other at each frame.

On a machine that does other work too, times of different minutes cannot be compared; those of
contenders that take turns can, by their ratio.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.frames import RawFrame, RigFrame
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.evaluation.opencv_baseline import OpenCvBaseline
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.pipeline import Config, Pipeline

LONGEST_WAIT_S = 5.0
_THREADS = Path("/proc/self/task")


class Contender(Protocol):
    """Takes raw frames in order; ``push`` says what became ready with this one."""

    name: str

    def warm_up(self) -> None:
        """Do everything that only the first frame would pay for."""

    def push(self, raw: RawFrame) -> Sequence[OdometryResult]:
        """Take the next frame of the recording."""

    def take_stage_ms(self) -> Mapping[str, float]:
        """Stage -> milliseconds since the last call."""


class PipelineContender:
    """A whole pipeline, from raw frames to poses."""

    def __init__(
        self,
        name: str,
        config: Config,
        calibration: RigCalibration,
        observers: Sequence[Observer] = (),
    ) -> None:
        self.name = name
        self._pipeline = Pipeline(config, calibration, observers)
        self._stage_ms: dict[str, float] = {}

    def warm_up(self) -> None:
        self._pipeline.warm_up()

    def push(self, raw: RawFrame) -> Sequence[OdometryResult]:
        found = list(self._pipeline.push(raw))
        if found:
            self._stage_ms = {**self._pipeline.take_stage_ms(), **found[-1].stats.stage_ms}
        return found

    def take_stage_ms(self) -> Mapping[str, float]:
        return self._stage_ms


class RigFrameListener(Observer):
    """Keeps the rectified frame that a pipeline made last, for those who start from it."""

    def __init__(self) -> None:
        self._frame: RigFrame | None = None

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._frame = frame

    def take(self) -> RigFrame | None:
        """The frame made since the last call."""
        frame, self._frame = self._frame, None
        return frame


class BaselineContender:
    """The OpenCV baseline on the rectified frames of another contender, who comes before it.

    It pays for no front end.  Frames on which an eye is blind are left out.
    """

    name = "OpenCV baseline"

    def __init__(self, source: RigFrameListener) -> None:
        self._source = source
        self._baseline = OpenCvBaseline()

    def warm_up(self) -> None:
        """OpenCV compiles nothing."""

    def push(self, raw: RawFrame) -> Sequence[OdometryResult]:
        frame = self._source.take()
        if frame is None or any(view.display is None for view in frame.views.values()):
            return []
        return [self._baseline.process(frame)] if len(frame.views) == 2 else []

    def take_stage_ms(self) -> Mapping[str, float]:
        return {}


@dataclass(frozen=True)
class Turn:
    """What one contender did with one frame; CPU over all threads, work after the answer too."""

    wall_ms: float
    cpu_ms: float
    stages_ms: Mapping[str, float]


class Record:
    """All turns and results of one contender."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.turns: list[Turn] = []
        self.results: list[OdometryResult] = []

    @property
    def wall_ms(self) -> NDArray[np.float64]:
        """(N,) milliseconds from the frame to its result."""
        return np.array([turn.wall_ms for turn in self.turns])

    @property
    def cpu_ms(self) -> NDArray[np.float64]:
        """(N,) milliseconds of all threads together."""
        return np.array([turn.cpu_ms for turn in self.turns])

    def stages_ms(self) -> dict[str, list[float]]:
        """Stage -> milliseconds in each frame in which it ran, in order of first appearance."""
        stages: dict[str, list[float]] = defaultdict(list)
        for turn in self.turns:
            for name, stage_ms in turn.stages_ms.items():
                stages[name].append(stage_ms)
        return dict(stages)

    def extend(self, other: Record) -> None:
        """Count the turns of another pass too; the results stay those of the first."""
        self.turns += other.turns


def contest(
    contenders: Sequence[Contender],
    recorded: Recorded,
    *,
    opencv_threads: int = 2,
    prepare: Mapping[str, Callable[[RawFrame], RawFrame]] | None = None,
    on_progress: Callable[[], None] = lambda: None,
) -> list[Record]:
    """Let every contender take each frame before any takes the next.

    ``prepare`` changes the frames for the contender of that name, outside the measured time.
    The number of OpenCV's threads is as before afterwards.
    """
    prepare = prepare or {}
    records = [Record(contender.name) for contender in contenders]
    before = cv2.getNumThreads()
    cv2.setNumThreads(opencv_threads)
    try:
        for contender in contenders:
            contender.warm_up()
        wall_ms, cpu_ms = np.zeros(len(contenders)), np.zeros(len(contenders))
        for raw in recorded.frames:
            for i, contender in enumerate(contenders):
                mine = prepare[contender.name](raw) if contender.name in prepare else raw
                wall, cpu = time.perf_counter(), time.process_time()
                found = contender.push(mine)
                wall_ms[i] += (time.perf_counter() - wall) * 1e3
                wait_until_idle()
                cpu_ms[i] += (time.process_time() - cpu) * 1e3
                if found:
                    stages_ms = contender.take_stage_ms()
                    records[i].turns.append(Turn(wall_ms[i], cpu_ms[i], stages_ms))
                    records[i].results += found
                    wall_ms[i] = cpu_ms[i] = 0.0
            if raw.camera == recorded.cameras[0]:
                on_progress()
    finally:
        cv2.setNumThreads(before)
    return records


def wait_until_idle() -> None:
    """Let the other threads of this process finish what they do, so that they disturb nobody.

    Looks at the states that Linux shows; elsewhere it waits a moment.
    """
    if not _THREADS.is_dir():
        time.sleep(2e-3)
        return
    deadline = time.perf_counter() + LONGEST_WAIT_S
    quiet = 0
    # Twice: a thread that waits for the interpreter's lock sleeps while we look.
    while quiet < 2 and time.perf_counter() < deadline:
        quiet = 0 if _others_run() else quiet + 1
        time.sleep(1e-4)


def _others_run() -> bool:
    me = str(threading.get_native_id())
    for thread in _THREADS.iterdir():
        if thread.name == me:
            continue
        try:
            state = (thread / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # it has just ended
            continue
        if state in ("R", "D"):
            return True
    return False
