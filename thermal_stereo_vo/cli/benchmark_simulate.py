"""``benchmark simulate``: how fast the simulator renders and senses."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_arguments import (
    add_output_arguments,
    report,
    require_positive,
)
from thermal_stereo_vo.cli.progress import progress


def add_simulate_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_simulate`` reads."""
    parser.add_argument("--preset", default="corridor", help="simulated run (default corridor)")
    parser.add_argument(
        "--frames", type=int, default=40, metavar="N", help="pairs to render (default 40)"
    )
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="processes that render (default 2)"
    )
    add_output_arguments(parser)


def run_simulate(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code.

    Raises SimulationError for an unknown preset and ConfigError for impossible counts.
    """
    from thermal_stereo_vo.simulation.benchmark import benchmark_simulate, simulate_report

    require_positive(args, "frames")
    require_positive(args, "workers")
    with progress(4 * args.frames, "picture", quiet=args.quiet) as step:
        figures = benchmark_simulate(
            args.preset, pairs=args.frames, workers=args.workers, on_progress=step
        )
    return report(args, simulate_report(figures), figures.as_dict())
