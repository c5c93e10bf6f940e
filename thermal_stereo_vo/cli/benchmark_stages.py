"""``benchmark`` alone: milliseconds of every stage, in turns with an OpenCV baseline."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from thermal_stereo_vo.cli.benchmark_arguments import (
    add_recording_arguments,
    read_recording,
    report,
    require_positive,
    title,
)
from thermal_stereo_vo.cli.progress import progress

if TYPE_CHECKING:
    from thermal_stereo_vo.benchmarks.recorded import Recorded
    from thermal_stereo_vo.pipeline import Config

PAIRS = 60
FEATURE = "feature"


def add_stages_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_stages`` reads."""
    add_recording_arguments(parser, PAIRS)
    parser.add_argument(
        "--repeat", type=int, default=1, metavar="R", help="passes over the recording (default 1)"
    )
    parser.add_argument(
        "--threads", type=int, choices=(1, 2), help="measure with this many only (default both)"
    )


def run_stages(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    from thermal_stereo_vo.benchmarks.stage_times import (
        measure_stages,
        stage_record,
        stage_report,
    )

    require_positive(args, "repeat")
    threads = (1, 2) if args.threads is None else (args.threads,)
    config, recorded = read_recording(args, PAIRS)
    if config.odometry.method != FEATURE:
        return _run_pace(args, config, recorded, threads)
    total = recorded.pairs * args.repeat * len(threads)
    with progress(total, "pair", quiet=args.quiet) as step:
        times = measure_stages(
            recorded, config, threads=threads, repeat=args.repeat, on_progress=step
        )
    passes = "" if args.repeat == 1 else f", {args.repeat} times"
    text = f"{title(recorded)}{passes}; milliseconds a pair\n\n{stage_report(times)}"
    return report(args, text, stage_record(times))


def _run_pace(
    args: argparse.Namespace, config: Config, recorded: Recorded, threads: tuple[int, ...]
) -> int:
    """The other methods have no baseline: whether they keep pace with their cameras."""
    from thermal_stereo_vo.benchmarks.pace import measure_pace, pace_record, pace_report

    with progress(2 * len(threads) * recorded.pairs, "pair", quiet=args.quiet) as step:
        paces = measure_pace(recorded, config, threads=threads, on_progress=step)
    text = f"{title(recorded)}; milliseconds\n\n{pace_report(paces)}"
    return report(args, text, pace_record(paces))
