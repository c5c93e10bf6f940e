"""``import-dataset``: any recording as a ROS 2 bag."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from thermal_stereo_vo.cli.source_arguments import add_source_arguments, source_options

if TYPE_CHECKING:
    from thermal_stereo_vo.core.cameras import RigCalibration
    from thermal_stereo_vo.core.transforms import Matrix
    from thermal_stereo_vo.datasets.base import Dataset

HELP = "turn a recording into a ROS 2 bag (mcap)"


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

    dataset, reason = open_dataset(args.source, source_options(args))
    if not args.quiet:
        print(f"{args.source}: {reason}", file=sys.stderr)
    count = write_bag(dataset, args.output, quiet=args.quiet)
    if not args.quiet:
        print(f"{count} images of {', '.join(dataset.cameras)} written to {args.output}")
    return 0


def write_bag(dataset: Dataset, path: Path, *, quiet: bool = True) -> int:
    """Write images, ``camera_info``, telemetry and ground truth; returns the number of images.

    Images go to ``/<role>/image_raw``, true poses to ``/ground_truth`` (``base_link`` in ``odom``
    axes), the calibration also to ``rig.yaml`` in the bag's folder.
    """
    from tqdm import tqdm

    from thermal_stereo_vo.core.camera_info import infos_from_calibration
    from thermal_stereo_vo.core.cameras import default_T_base_rig
    from thermal_stereo_vo.outputs.bag_writer import BagWriter
    from thermal_stereo_vo.outputs.ros_fields import odom_pose, pose_fields, telemetry_fields

    calibration, T_rig_rectified = _for_ros(dataset)
    infos = {} if calibration is None else infos_from_calibration(calibration)
    T_base_rig = default_T_base_rig()
    if calibration is not None and calibration.T_base_rig is not None:
        T_base_rig = calibration.T_base_rig
    truth = dataset.ground_truth()
    truth_stamps = [] if truth is None else [int(stamp) for stamp in truth.stamps_ns]
    written = 0

    instants = dataset.instants()
    with (
        BagWriter(path) as bag,
        tqdm(
            total=None if instants is None else instants * len(dataset.cameras),
            unit="image",
            disable=True if quiet else None,  # None: only on a terminal
        ) as bar,
    ):

        def write_truth(up_to_ns: float) -> None:
            nonlocal written
            while truth is not None and written < len(truth) and truth_stamps[written] <= up_to_ns:
                T_world_rig = truth.T_world_rig[written] @ T_rig_rectified
                pose = odom_pose(T_world_rig, T_base_rig)
                bag.write_odometry("/ground_truth", pose_fields(truth_stamps[written], pose))
                written += 1

        if calibration is not None:
            bag.write_calibration(calibration)
        count = 0
        for frame in dataset.frames():
            write_truth(frame.stamp_ns)
            camera, frame_id = f"/{frame.camera}", f"{frame.camera}_optical"
            bag.write_image(f"{camera}/image_raw", frame.stamp_ns, frame.image, frame_id)
            if frame.camera in infos:
                bag.write_camera_info(
                    f"{camera}/camera_info", frame.stamp_ns, infos[frame.camera], frame_id
                )
            if frame.telemetry is not None:
                bag.write_diagnostics(
                    f"{camera}/status",
                    telemetry_fields(frame.stamp_ns, frame.camera, frame.telemetry),
                )
            count += 1
            bar.update()
        write_truth(float("inf"))
    return count


def _for_ros(dataset: Dataset) -> tuple[RigCalibration | None, Matrix]:
    """The calibration with R and P, as ``camera_info`` needs them, and T_rig_rectified."""
    from thermal_stereo_vo.core.cameras import LEFT, RIGHT
    from thermal_stereo_vo.core.transforms import identity
    from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

    calibration = dataset.calibration()
    if calibration is None or not {LEFT, RIGHT} <= set(calibration.cameras):
        return calibration, identity()
    return with_rectification(calibration, RectificationConfig())
