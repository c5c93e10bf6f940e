"""``import-dataset``: any recording as a ROS 2 bag."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thermal_stereo_vo.cli.progress import progress
from thermal_stereo_vo.cli.source_arguments import add_source_arguments, source_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    add_source_arguments(parser)
    parser.add_argument(
        "--output", type=Path, required=True, metavar="BAG", help="folder of the new bag"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run(args: argparse.Namespace) -> int:
    """Write the bag; nothing is left behind after an error."""
    from thermal_stereo_vo.datasets.registry import open_dataset
    from thermal_stereo_vo.outputs.dataset_bag import write_dataset

    dataset, reason = open_dataset(args.source, source_options(args))
    if not args.quiet:
        print(f"{args.source} is a {reason}", file=sys.stderr)
    instants = dataset.instants()
    total = None if instants is None else instants * len(dataset.cameras)
    with progress(total, "image", quiet=args.quiet) as step:
        count = write_dataset(dataset, args.output, step)
    if not args.quiet:
        print(f"{count} images of {', '.join(dataset.cameras)} written to {args.output}")
    return 0
