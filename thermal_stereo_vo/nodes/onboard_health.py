"""What the onboard node tells of its pipeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from thermal_stereo_vo.core.frames import GapReason
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.nodes.vitals import Window
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.ros_fields import ERROR, OK, WARN, DiagnosticFields
from thermal_stereo_vo.pipeline import Pipeline
from thermal_stereo_vo.radiometry.gate import GateEvent, GateState

ANOTHER_TIME_MS = 60_000.0
"""An image this old has a stamp of another clock."""


class LatencyMeter(Observer):
    """From the stamp of an image to the moment its pose has been published.

    It stands behind the publisher in the list of observers.
    """

    def __init__(self, now_ns: Callable[[], int], window: int) -> None:
        self._now_ns = now_ns
        self._window = Window(window)
        self._of_another_time = 0

    def on_result(self, result: OdometryResult) -> None:
        if result.T_world_rig is None:
            return
        latency_ms = (self._now_ns() - result.stamp_ns) * 1e-6
        if 0.0 <= latency_ms < ANOTHER_TIME_MS:
            self._window.add(latency_ms)
        else:
            self._of_another_time += 1

    def fields(self) -> tuple[tuple[str, str], ...]:
        """For diagnostics."""
        return (
            *self._window.fields("latency_ms", 50, 95, 100),
            ("stamps_of_another_time", str(self._of_another_time)),
        )


class GateLog(Observer):
    """Tells the log of every event of the gates, and keeps the last one."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._count = 0
        self._last = ""

    def on_gate_event(self, event: GateEvent) -> None:
        self._count += 1
        self._last = str(event)
        # Lines of their own, as rclpy ties a line of code to one severity.
        if event.ongoing:
            self._logger.error(self._last)
        elif event.reason is GapReason.DROPPED:  # many where pairs come too fast
            self._logger.info(self._last, throttle_duration_sec=5.0)
        else:
            self._logger.info(self._last)

    def fields(self) -> tuple[tuple[str, str], ...]:
        """For diagnostics."""
        return ("gate_events", str(self._count)), ("last_gate_event", self._last)


def gate_health(pipeline: Pipeline) -> Iterator[DiagnosticFields]:
    """Gate and flat field of each camera; the message counts when the level is not OK."""
    for eye, front_end in pipeline.front_ends.items():
        state, flat_field = front_end.gate.state, front_end.flat_field_status
        level, message = OK, state.value
        values = [(f"{eye}_gate", state.value), (f"{eye}_corrections", str(front_end.gate.epoch))]
        if flat_field is not None:
            values.append((f"{eye}_flat_field", flat_field.text))
            if not flat_field.ok:
                level, message = WARN, f"{eye}: {flat_field.text}"
        if state is GateState.FAULT:
            level, message = ERROR, f"{eye} is blind: stuck shutter or dead stream"
        yield DiagnosticFields(0, level, eye, message, tuple(values))


def gyro_fields(pipeline: Pipeline, samples: int) -> tuple[tuple[str, str], ...]:
    """Samples, bias and error of the gyro; nothing where there is none."""
    gyro = pipeline.gyro
    if gyro is None:
        return ()
    return (
        ("imu_samples", str(samples)),
        ("gyro_bias_rad_s", " ".join(f"{x:.5f}" for x in gyro.bias)),
        ("gyro_error_rad_s", f"{gyro.error_rad_s:.5f}"),
    )


def stage_fields(stages_ms: Mapping[str, float]) -> tuple[tuple[str, str], ...]:
    """Wall time of the stages before the odometry."""
    return tuple((f"{stage.replace(' ', '_')}_ms", f"{ms:.3f}") for stage, ms in stages_ms.items())
