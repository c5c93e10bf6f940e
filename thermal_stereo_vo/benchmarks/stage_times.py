"""How long each stage takes, on one thread and on two, with the OpenCV baseline in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_stereo_vo.benchmarks.contest import (
    BaselineContender,
    PipelineContender,
    Record,
    RigFrameListener,
    contest,
)
from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.evaluation.metrics import Metrics
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.pipeline import Config

FRAME_TO_FRAME, WINDOWED = "frame to frame", "windowed"
BASELINE = BaselineContender.name


@dataclass(frozen=True)
class StageTimes:
    """Records of all contenders with this many threads, and how well each did."""

    threads: int
    records: tuple[Record, ...]
    metrics: tuple[Metrics | None, ...]

    def ratio(self, record: Record) -> float:
        """Median of a contender's times over those of the baseline."""
        baseline = next(other for other in self.records if other.name == BASELINE)
        return float(np.median(record.wall_ms) / np.median(baseline.wall_ms))


def measure_stages(
    recorded: Recorded,
    config: Config,
    *,
    threads: Sequence[int] = (1, 2),
    repeat: int = 1,
    on_progress: Callable[[], None] = lambda: None,
) -> list[StageTimes]:
    """Frame to frame, windowed and baseline, in turns; ``repeat`` passes with each of ``threads``.

    Raises ConfigError for settings whose window is 0: there would be nothing to compare.
    """
    if config.odometry.window == 0:
        raise ConfigError(
            "benchmark compares window 0 with the one of the settings: leave odometry.window at 2 "
            "or more"
        )
    found: dict[int, list[Record]] = {}
    for _ in range(repeat):
        for count in threads:
            records = contest(
                _contenders(config, recorded, count),
                recorded,
                opencv_threads=count,
                on_progress=on_progress,
            )
            if count not in found:
                found[count] = records
            else:
                for record, more in zip(found[count], records, strict=True):
                    record.extend(more)
    return [
        StageTimes(count, tuple(records), tuple(recorded.metrics(r.results) for r in records))
        for count, records in found.items()
    ]


def _contenders(
    config: Config, recorded: Recorded, threads: int
) -> list[PipelineContender | BaselineContender]:
    listener = RigFrameListener()
    frame_to_frame = with_overrides(config, ["odometry.window=0", f"odometry.threads={threads}"])
    windowed = with_overrides(config, [f"odometry.threads={threads}"])
    return [
        PipelineContender(FRAME_TO_FRAME, frame_to_frame, recorded.calibration),
        PipelineContender(WINDOWED, windowed, recorded.calibration, [listener]),
        BaselineContender(listener),
    ]


def stage_report(times: Sequence[StageTimes]) -> str:
    """A table of contenders and one of stages for each number of threads."""
    parts = []
    for each in times:
        threads = "1 thread" if each.threads == 1 else f"{each.threads} threads"
        header = [threads, "median", "p95", "CPU", "of baseline", "average (%)", "final (%)"]
        rows = [
            [
                record.name,
                f"{np.median(record.wall_ms):.1f}",
                f"{np.percentile(record.wall_ms, 95):.1f}",
                f"{np.mean(record.cpu_ms):.1f}",
                f"{each.ratio(record):.2f}",
                *_accuracy(metrics),
            ]
            for record, metrics in zip(each.records, each.metrics, strict=True)
        ]
        parts.append(format_table(header, rows))
        parts += [
            _stage_table(record, stages, threads)
            for record in each.records
            if (stages := record.stages_ms())
        ]
    return "\n\n".join(parts)


def _accuracy(metrics: Metrics | None) -> list[str]:
    if metrics is None:
        return ["-", "-"]
    values = (metrics.avg_translation_error_percent, metrics.final_error_percent)
    return ["-" if value is None else f"{value:.2f}" for value in values]


def _stage_table(record: Record, stages: dict[str, list[float]], threads: str) -> str:
    pairs = len(record.turns)
    rows = [
        [
            name,
            f"{np.median(values):.2f}",
            f"{np.percentile(values, 95):.2f}",
            f"{len(values)}",
            f"{sum(values) / pairs:.2f}",
        ]
        for name, values in stages.items()
    ]
    header = [f"{record.name}, {threads}", "median", "p95", "pairs", "ms per pair"]
    return format_table(header, rows)


def stage_record(times: Sequence[StageTimes]) -> list[dict[str, Any]]:
    """The same figures for a file."""
    return [
        {
            "threads": each.threads,
            "contender": record.name,
            "pairs": len(record.turns),
            "wall_ms": {
                "median": np.median(record.wall_ms),
                "p95": np.percentile(record.wall_ms, 95),
                "max": np.max(record.wall_ms),
            },
            "cpu_ms": np.mean(record.cpu_ms),
            "ratio_to_baseline": each.ratio(record),
            "stages_ms": {
                name: {"median": np.median(values), "p95": np.percentile(values, 95)}
                for name, values in record.stages_ms().items()
            },
            "metrics": None if metrics is None else metrics.as_dict(),
        }
        for each in times
        for record, metrics in zip(each.records, each.metrics, strict=True)
    ]
