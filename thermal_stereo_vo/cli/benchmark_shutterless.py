"""``benchmark shutterless``: odometry while the cores warm up without a shutter."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_flight_arguments import (
    add_flight_arguments,
    flight_settings,
    picture_cache,
)
from thermal_stereo_vo.cli.progress import progress


def add_shutterless_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_shutterless`` reads."""
    parser.description = (
        "Fly a simulated rig whose cores warm up by about 10 K and never close a shutter, and "
        "compare the odometry on uncorrected images, under a stored flat field, under scene-based "
        "refinement and under both with that of cores without fixed pattern."
    )
    add_flight_arguments(parser)
    parser.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="frame rate (10)")
    parser.add_argument(
        "--ways", metavar="A,B", help="some of the ways: perfect, uncorrected, refinement, ..."
    )


def run_shutterless(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code.

    Raises:
        ThermalStereoError: for an unknown preset or a flight that cannot be flown.
    """
    from thermal_stereo_vo.benchmarks.shutterless import (
        WAYS,
        measure_ways,
        shutterless_report,
        warming_settings,
    )
    from thermal_stereo_vo.core.errors import ConfigError
    from thermal_stereo_vo.pipeline import Config

    ways = tuple(WAYS) if args.ways is None else tuple(args.ways.split(","))
    unknown = [way for way in ways if way not in WAYS]
    if unknown:
        raise ConfigError(f"--ways takes some of {', '.join(WAYS)}, got '{args.ways}'")
    settings = (
        *flight_settings(args),
        *warming_settings(args.length),
        f"rate_hz={args.rate}",
    )
    seeds = range(1, args.seeds + 1)
    flights = args.seeds * len(ways)
    with picture_cache(args) as cache, progress(flights, "flight", quiet=args.quiet) as step:
        cells = list(measure_ways(seeds, args.preset, settings, Config(), cache, ways, step))
    print(shutterless_report(cells))
    return 0
