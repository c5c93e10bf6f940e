"""``benchmark reconstruction``: a model of a simulated street against the truth."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_arguments import add_output_arguments, report
from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_settings,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress


def add_reconstruction_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_reconstruction`` reads."""
    parser.description = (
        "Fly down a simulated street, fuse a model with the poses of the odometry and a perfect "
        "radiometric calibration, and measure it against the true surfaces and temperatures."
    )
    parser.add_argument("--preset", default="corridor", help="flight (default: %(default)s)")
    parser.add_argument(
        "--length", type=float, default=60.0, metavar="M", help="of the flight (default 60)"
    )
    add_config_arguments(parser)
    add_output_arguments(parser)


def run_reconstruction(args: argparse.Namespace) -> int:
    """Print the figures; returns the exit code.

    Raises ThermalStereoError for settings or a preset that cannot be used.
    """
    import dataclasses

    from thermal_stereo_vo.benchmarks.reconstruction import measure_model
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.simulated import open_simulated
    from thermal_stereo_vo.reconstruction.config import ReconstructConfig

    config = load_settings(args, ReconstructConfig())
    options = SourceOptions(length_m=args.length, overrides=simulation_overrides(args))
    dataset = open_simulated(args.preset, options)
    with progress(dataset.instants(), "pair", quiet=args.quiet) as step:
        figures = measure_model(dataset, config, step)
    return report(args, figures.report(), dataclasses.asdict(figures))
