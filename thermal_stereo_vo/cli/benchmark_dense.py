"""``benchmark dense``: dense stereo by day and by night against the simulator's truth."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_arguments import add_output_arguments, report, require_positive
from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_config,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress


def add_dense_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_dense`` reads."""
    parser.description = (
        "Disparities of simulated pairs against the truth, by day, in a cloudy and in a clear cold "
        "night, beside OpenCV's semi-global matcher with its default settings on the 8-bit view; "
        "each also at the density of the other. One thread."
    )
    parser.add_argument(
        "--pairs", type=int, default=8, metavar="N", help="instants of each flight (default 8)"
    )
    add_config_arguments(parser)
    add_output_arguments(parser)


def run_dense(args: argparse.Namespace) -> int:
    """Print the table; returns the exit code.

    Raises ConfigError for settings that cannot be used.
    """
    import dataclasses

    import cv2

    from thermal_stereo_vo.benchmarks.dense import WEATHERS, dense_report, measure
    from thermal_stereo_vo.benchmarks.dense_views import true_views

    require_positive(args, "pairs")
    config = load_config(args)
    overrides = simulation_overrides(args)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    cells = []
    try:
        with progress(len(WEATHERS) * args.pairs, "pair", quiet=args.quiet) as step:
            for weather, preset in WEATHERS.items():
                views = true_views(preset, args.pairs, overrides)
                cells += measure(weather, views, config.dense, step)
    finally:
        cv2.setNumThreads(threads)
    return report(args, dense_report(cells), [dataclasses.asdict(cell) for cell in cells])
