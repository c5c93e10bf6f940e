"""``benchmark enhancement``: odometry on several 8-bit views of the same flight."""

from __future__ import annotations

import argparse
from pathlib import Path

from thermal_stereo_vo.cli.benchmark_flight_arguments import (
    add_flight_arguments,
    flight_settings,
    picture_cache,
)
from thermal_stereo_vo.cli.progress import progress


def add_enhancement_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_enhancement`` reads."""
    parser.description = (
        "Fly a simulated rig and compare the odometry on 8-bit views made in several ways, from "
        "the sensor's whole range to equalisation without the sky (Mouats et al. 2015, Fig. 9)."
    )
    add_flight_arguments(parser, length_m=60.0, scale=1.0)
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="draw the ways from above (default: none)"
    )
    parser.add_argument(
        "--window",
        type=int,
        default=0,
        metavar="N",
        help="odometry.window; 0 (default) is the paper's method, which sees nothing but the view; "
        "the windowed one follows linear counts and needs the view only to find itself again",
    )


def run_enhancement(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code.

    Raises:
        ThermalStereoError: for an unknown preset or a flight that cannot be flown.
    """
    from thermal_stereo_vo.benchmarks.enhancement import (
        VIEWS,
        enhancement_report,
        measure_views,
        plot_views,
    )
    from thermal_stereo_vo.core.config import with_overrides
    from thermal_stereo_vo.pipeline import Config

    config = with_overrides(Config(), [f"odometry.window={args.window}"])
    seeds = range(1, args.seeds + 1)
    flights = args.seeds * len(VIEWS)
    with picture_cache(args) as cache, progress(flights, "flight", quiet=args.quiet) as step:
        cells = list(measure_views(seeds, args.preset, flight_settings(args), config, cache, step))
    print(enhancement_report(cells))
    if args.picture is not None:
        plot_views(args.picture, cells)
    return 0
