"""``inspect-bag``: what a bag holds, and how it would be replayed."""

from __future__ import annotations

import argparse
from pathlib import Path

from thermal_stereo_vo.cli.progress import progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="ROS 1 .bag, ROS 2 folder, .mcap or .db3"
    )
    parser.add_argument("--left-topic", metavar="TOPIC", help="image topic of the left eye")
    parser.add_argument("--right-topic", metavar="TOPIC", help="image topic of the right eye")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    """Print the report once the whole bag has been read."""
    from thermal_stereo_vo.datasets.bag_report import count_messages, inspect_bag
    from thermal_stereo_vo.datasets.options import SourceOptions

    options = SourceOptions(left_topic=args.left_topic, right_topic=args.right_topic)
    with progress(count_messages(args.bag), "message", quiet=args.quiet) as step:
        report = inspect_bag(args.bag, options, step)
    print(report)
    return 0
