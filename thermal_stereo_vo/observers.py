"""Who listens to a pipeline: files, plots, ROS topics.  Every method does nothing by default."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.radiometry.gate import GateEvent


class Observer:
    """Override what you want to hear."""

    wants_points: bool = False
    """Whether ``on_points`` shall be called; the map is only gathered when somebody asks."""

    def on_gate_event(self, event: GateEvent) -> None:
        """A camera went blind, came back, or has a fault."""

    def on_rig_frame(self, frame: RigFrame) -> None:
        """The rectified frame, before the odometry sees it."""

    def on_result(self, result: OdometryResult) -> None:
        """Once for each rig frame."""

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        """The map points after each result that has a pose."""

    def close(self) -> None:
        """The run is over (also after an error): finish files."""


class ObserverList(Observer):
    """Several observers as one, told in order."""

    def __init__(self, observers: Sequence[Observer] = ()) -> None:
        self._observers = list(observers)
        self.wants_points = any(observer.wants_points for observer in self._observers)

    def on_gate_event(self, event: GateEvent) -> None:
        for observer in self._observers:
            observer.on_gate_event(event)

    def on_rig_frame(self, frame: RigFrame) -> None:
        for observer in self._observers:
            observer.on_rig_frame(frame)

    def on_result(self, result: OdometryResult) -> None:
        for observer in self._observers:
            observer.on_result(result)

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        for observer in self._observers:
            if observer.wants_points:
                observer.on_points(stamp_ns, cloud)

    def close(self) -> None:
        errors = []
        for observer in self._observers:
            try:
                observer.close()
            except Exception as error:  # the others must still finish their files
                errors.append(error)
        if errors:
            raise errors[0]


class StageTimer:
    """Wall time of named stages within one frame, in milliseconds."""

    def __init__(self) -> None:
        self._stage_ms: dict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._stage_ms[name] += (time.perf_counter() - start) * 1e3

    def add(self, name: str, stage_ms: float) -> None:
        """Add time that was measured elsewhere, as beside this thread."""
        self._stage_ms[name] += stage_ms

    def take(self) -> dict[str, float]:
        """Stage -> milliseconds since the last call; starts anew."""
        taken = dict(self._stage_ms)
        self._stage_ms.clear()
        return taken
