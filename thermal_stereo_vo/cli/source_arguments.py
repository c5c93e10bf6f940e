"""The arguments that say where frames come from, alike in every verb."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermal_stereo_vo.datasets.options import SourceOptions

SOURCE_HELP = (
    "a rosbag (ROS 1 .bag, ROS 2 folder, .mcap or .db3), a KITTI or EuRoC folder, a folder with "
    "left/ and right/ or visible/ and thermal/, or sim:PRESET"
)


def add_source_arguments(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """SOURCE and all that may be said about it; with a ``default`` it becomes ``--source``."""
    if default is None:
        parser.add_argument("source", metavar="SOURCE", help=SOURCE_HELP)
    else:
        parser.add_argument("--source", default=default, help=f"{SOURCE_HELP} (default {default})")
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="F",
        help="calibration to use instead of the recording's own: folder with left.yaml and "
        "right.yaml, rig.yaml, KITTI calib.txt or EuRoC folder",
    )
    parser.add_argument("--left-topic", metavar="TOPIC", help="image topic of the left eye")
    parser.add_argument("--right-topic", metavar="TOPIC", help="image topic of the right eye")
    parser.add_argument("--visible-topic", metavar="TOPIC", help="images of a visible camera, and")
    parser.add_argument("--thermal-topic", metavar="TOPIC", help="of a thermal one beside it")
    parser.add_argument(
        "--imu-topic", metavar="TOPIC", help="inertial topic in a bag, for odometry.gyro.enabled"
    )
    parser.add_argument(
        "--ground-truth-topic", metavar="TOPIC", help="topic of the true poses in a bag"
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help="frame rate of images without stamps, or of a simulated run",
    )
    parser.add_argument("--length", type=float, metavar="M", help="length of a simulated run")
    parser.add_argument("--seed", type=int, default=0, help="seed of a simulated run (default 0)")


def source_options(args: argparse.Namespace, overrides: tuple[str, ...] = ()) -> SourceOptions:
    """What the arguments ask of the reader; ``overrides`` are settings of a simulated run."""
    from thermal_stereo_vo.datasets.options import SourceOptions

    return SourceOptions(
        left_topic=args.left_topic,
        right_topic=args.right_topic,
        visible_topic=args.visible_topic,
        thermal_topic=args.thermal_topic,
        imu_topic=args.imu_topic,
        ground_truth_topic=args.ground_truth_topic,
        calibration=args.calibration,
        rate_hz=args.rate,
        length_m=args.length,
        seed=args.seed,
        overrides=overrides,
    )
