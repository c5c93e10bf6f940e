"""``benchmark ffc``: what flat-field corrections in flight cost."""

from __future__ import annotations

import argparse
from pathlib import Path

from thermal_stereo_vo.cli.config_arguments import add_config_arguments, load_config
from thermal_stereo_vo.cli.progress import progress


def add_ffc_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_ffc`` reads."""
    parser.description = (
        "Fly a straight leg, a turn and hover without and with flat-field corrections, staggered "
        "and of both cameras at once, 0.5 s and 1 s long.  An IMU helps with --set "
        "odometry.gyro.enabled=true."
    )
    add_config_arguments(parser)
    parser.add_argument("--rate", type=float, default=20.0, metavar="HZ", help="frame rate (20)")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="image size relative to 640x480 (1)"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="sensor seeds (5)")
    parser.add_argument(
        "--flights", metavar="A,B", help="some of the flights: straight, turn, hover"
    )
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path("benchmark_cache"),
        metavar="DIR",
        help="folder that keeps the noise-free pictures, so that each flight is rendered once",
    )
    parser.add_argument("--quiet", action="store_true", help="draw no progress bar")


def run_ffc(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    from thermal_stereo_vo.benchmarks.ffc import FLIGHTS, SCHEDULES, ffc_report, measure_all
    from thermal_stereo_vo.core.errors import ConfigError

    config = load_config(args)
    flights = tuple(FLIGHTS) if args.flights is None else tuple(args.flights.split(","))
    unknown = [flight for flight in flights if flight not in FLIGHTS]
    if unknown or args.seeds < 1:
        raise ConfigError(
            f"--flights takes some of {', '.join(FLIGHTS)} and --seeds at least 1, got "
            f"'{args.flights}' and {args.seeds}"
        )
    seeds, total = range(args.seeds), len(flights) * len(SCHEDULES) * args.seeds
    with progress(total, "flight", quiet=args.quiet) as step:
        cells = list(
            measure_all(seeds, config, args.rate, args.scale, args.cache, flights, on_progress=step)
        )
    print(ffc_report(cells, with_imu=config.odometry.gyro.enabled))
    return 0
