"""``benchmark scaling``: how the time of a pair grows."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_arguments import (
    add_recording_arguments,
    read_recording,
    report,
    title,
)
from thermal_stereo_vo.cli.progress import progress

PAIRS = 30


def add_scaling_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_scaling`` reads."""
    add_recording_arguments(parser, PAIRS)


def run_scaling(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    from thermal_stereo_vo.benchmarks.scaling import (
        measure_scaling,
        scaling_record,
        scaling_report,
    )

    config, recorded = read_recording(args, PAIRS)
    with progress(recorded.pairs, "pair", quiet=args.quiet) as step:
        growths = measure_scaling(recorded, config, on_progress=step)
    text = f"{title(recorded)}; milliseconds a pair, one thread\n\n{scaling_report(growths)}"
    return report(args, text, scaling_record(growths))
