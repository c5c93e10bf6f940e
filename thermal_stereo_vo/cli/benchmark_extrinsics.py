"""``benchmark extrinsics``: what a wrong yaw between the eyes costs."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_flight_arguments import picture_cache
from thermal_stereo_vo.cli.config_arguments import add_config_arguments, load_config
from thermal_stereo_vo.cli.progress import progress


def add_extrinsics_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_extrinsics`` reads."""
    parser.description = (
        "Fly simulated flights with an error put into the yaw of the calibration, with and "
        "without its refinement in flight."
    )
    parser.add_argument(
        "--flights", nargs="+", default=["seq4", "seq6"], metavar="NAME", help="presets to fly"
    )
    parser.add_argument(
        "--yaw",
        nargs="+",
        type=float,
        default=[0.0, 0.1, -0.1, 0.3, -0.3],
        metavar="MRAD",
        help="errors put in (default: 0 and +-0.1, +-0.3)",
    )
    parser.add_argument(
        "--length", type=float, default=40.0, metavar="M", help="of each flight (default 40)"
    )
    parser.add_argument(
        "--scale", type=float, default=1.0, help="image size relative to 640x480 (default: 1)"
    )
    parser.add_argument(
        "--cache", metavar="DIR", help="folder that keeps the rendered pictures (default: none)"
    )
    add_config_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def run_extrinsics(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code."""
    from thermal_stereo_vo.benchmarks.extrinsics import extrinsics_report, measure_extrinsics

    config = load_config(args)
    overrides = (f"flight.length_m={args.length}", f"render.scale={args.scale}")
    flights = 2 * len(args.flights) * len(args.yaw)
    with picture_cache(args) as cache, progress(flights, "flight", quiet=args.quiet) as step:
        cells = list(measure_extrinsics(args.flights, args.yaw, overrides, config, cache, step))
    print(extrinsics_report(cells))
    return 0
