"""Arguments of the sweeps that fly many runs, keep each as a file, and go on where they stopped."""

from __future__ import annotations

import argparse
from pathlib import Path

PICTURES_FOLDER = "pictures"


def add_output_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the folder of the report, which also keeps what is finished."""
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder for the report"
    )


def add_sampling_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how often and how finely each run is flown."""
    parser.add_argument(
        "--seeds", type=int, default=3, metavar="N", help="sets of sensors (default 3)"
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="frame rate (default the preset's)"
    )


def add_work_arguments(parser: argparse.ArgumentParser, run: str, no_pictures: str = "") -> None:
    """Declare how the work is done; ``no_pictures`` tells where a ``run`` keeps none."""
    parser.add_argument(
        "--processes", type=int, default=2, metavar="N", help="processes to use (default 2)"
    )
    parser.add_argument(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="folder that keeps the rendered pictures, 1.2 MB a pair (default DIR/pictures of the "
        f"report{no_pictures})",
    )
    parser.add_argument(
        "--forget-pictures", action="store_true", help=f"remove those of a {run} once it is flown"
    )


def check_sweep_arguments(args: argparse.Namespace) -> None:
    """Raise ConfigError for counts that no sweep can have."""
    from thermal_stereo_vo.core.errors import ConfigError

    if args.seeds < 1 or args.processes < 0:
        raise ConfigError("--seeds must be 1 or more and --processes 0 or more")


def say_nothing(_: object) -> None:
    """Take the place of what tells of each finished run."""
