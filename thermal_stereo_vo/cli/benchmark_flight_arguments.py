"""Arguments of the measurements that fly simulated rigs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


def add_flight_arguments(
    parser: argparse.ArgumentParser, length_m: float = 120.0, scale: float = 0.5
) -> None:
    """Declare which flight, how large and how often."""
    parser.add_argument("--preset", default="seq1", help="simulated flight (default: %(default)s)")
    parser.add_argument(
        "--length",
        type=float,
        default=length_m,
        metavar="M",
        help="length of the flight; 1350 is five minutes (default: %(default)g)",
    )
    parser.add_argument(
        "--scale",
        type=float,
        default=scale,
        help="image size relative to 640x480 (default: %(default)g)",
    )
    parser.add_argument("--seeds", type=int, default=1, help="flights with other sensor noise")
    parser.add_argument(
        "--cache", metavar="DIR", help="folder that keeps the rendered pictures (default: none)"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def flight_settings(args: argparse.Namespace) -> tuple[str, ...]:
    """Settings of the simulation that the arguments ask for."""
    return (f"render.scale={args.scale}", f"flight.length_m={args.length}")


@contextmanager
def picture_cache(args: argparse.Namespace) -> Iterator[Path]:
    """A folder for rendered pictures: the one asked for, or one that goes when it is left."""
    if args.cache is not None:
        yield Path(args.cache)
        return
    with TemporaryDirectory() as folder:
        yield Path(folder)
