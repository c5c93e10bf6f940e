"""``benchmark solvers``: what the choice of the minimiser changes."""

from __future__ import annotations

import argparse
from pathlib import Path

from thermal_stereo_vo.cli.benchmark_arguments import add_output_arguments, report


def add_solvers_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_solvers`` reads."""
    parser.add_argument(
        "--matches",
        type=Path,
        metavar="DIR",
        help="recorded matches: matches.npz with step_000, ... (N x 8 pixels uL vL uR vR before "
        "and after), calib.txt (f cx cy baseline) and poses.txt; simulated ones when left out",
    )
    parser.add_argument(
        "--score-from",
        type=int,
        metavar="N",
        help="first step that counts for the final error (default 0)",
    )
    parser.add_argument("--seed", type=int, help="seed of RANSAC (default 0)")
    add_output_arguments(parser)
    parser.set_defaults(matches=None, score_from=0)


def run_solvers(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    import numpy as np

    from thermal_stereo_vo.benchmarks.solvers import (
        comparison_record,
        comparison_report,
        load_steps,
    )
    from thermal_stereo_vo.odometry.solver_comparison import compare_solvers, simulate_steps

    if args.matches is not None:
        sequence = load_steps(args.matches, args.score_from)
    else:
        sequence = simulate_steps(np.random.default_rng(args.seed))
    comparison = compare_solvers(sequence, seed=args.seed)
    return report(args, comparison_report(comparison), comparison_record(comparison))
