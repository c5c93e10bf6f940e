"""``benchmark shutterless``, ``benchmark enhancement``: what the front end is worth in flight."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


def add_shutterless_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_shutterless`` reads."""
    parser.description = (
        "Fly a simulated rig whose cores warm up by about 10 K and never close a shutter, and "
        "compare the odometry on uncorrected images, under a stored flat field, under scene-based "
        "refinement and under both with that of cores without fixed pattern."
    )
    _add_flight(parser)


def add_enhancement_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_enhancement`` reads."""
    parser.description = (
        "Fly a simulated rig and compare the odometry on 8-bit views made in several ways, from "
        "the sensor's whole range to equalisation without the sky (Mouats et al. 2015, Fig. 9)."
    )
    _add_flight(parser)


def run_shutterless(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code.

    Raises:
        ThermalStereoError: for an unknown preset or a flight that cannot be flown.
    """
    from thermal_stereo_vo.cli.progress import progress
    from thermal_stereo_vo.evaluation.shutterless_report import (
        WAYS,
        measure_ways,
        shutterless_report,
        warming_settings,
    )
    from thermal_stereo_vo.pipeline import Config

    settings = (*_settings(args), *warming_settings(args.length))
    seeds = range(1, args.seeds + 1)
    with (
        _cache(args) as cache,
        progress(args.seeds * len(WAYS), "flight", quiet=args.quiet) as step,
    ):
        cells = list(measure_ways(seeds, args.preset, settings, Config(), cache, step))
    print(shutterless_report(cells))
    return 0


def run_enhancement(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code.

    Raises:
        ThermalStereoError: for an unknown preset or a flight that cannot be flown.
    """
    from thermal_stereo_vo.cli.progress import progress
    from thermal_stereo_vo.evaluation.enhancement_report import (
        VIEWS,
        enhancement_report,
        measure_views,
    )
    from thermal_stereo_vo.pipeline import Config

    seeds = range(1, args.seeds + 1)
    with (
        _cache(args) as cache,
        progress(args.seeds * len(VIEWS), "flight", quiet=args.quiet) as step,
    ):
        cells = list(measure_views(seeds, args.preset, _settings(args), Config(), cache, step))
    print(enhancement_report(cells))
    return 0


def _add_flight(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--preset", default="seq1", help="simulated flight (default: %(default)s)")
    parser.add_argument(
        "--length",
        type=float,
        default=120.0,
        metavar="M",
        help="length of the flight; 1350 is five minutes (default: %(default)g)",
    )
    parser.add_argument(
        "--scale", type=float, default=0.5, help="image size relative to 640x480 (default: 0.5)"
    )
    parser.add_argument("--seeds", type=int, default=1, help="flights with other sensor noise")
    parser.add_argument(
        "--cache", metavar="DIR", help="folder that keeps the rendered pictures (default: none)"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _settings(args: argparse.Namespace) -> tuple[str, ...]:
    return (f"render.scale={args.scale}", f"flight.length_m={args.length}")


@contextmanager
def _cache(args: argparse.Namespace) -> Iterator[Path]:
    """A folder for rendered pictures: the one asked for, or one that goes when it is left."""
    if args.cache is not None:
        yield Path(args.cache)
        return
    with TemporaryDirectory() as folder:
        yield Path(folder)
