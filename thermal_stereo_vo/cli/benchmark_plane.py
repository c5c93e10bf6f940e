"""``benchmark plane``: dense points on boards of a real thermal pair."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_plane_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_plane`` reads."""
    parser.description = (
        "Dense points on a calibration board against a plane: its residual, and its distance "
        "beside that of the triangulated corners."
    )
    parser.add_argument("left", help="folder of the left eye's pictures")
    parser.add_argument("right", help="folder of the right eye's pictures")
    parser.add_argument("--board", required=True, metavar="KIND:NxM:SIZE", help="as in calibrate")
    parser.add_argument(
        "--calibration", type=Path, required=True, metavar="F", help="result of calibrate stereo"
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="setting of dense stereo, e.g. disparities=320",
    )
    parser.add_argument("--picture", type=Path, metavar="F", help="PNG of the first pair's map")


def run_plane(args: argparse.Namespace) -> int:
    """Print the table; returns the exit code.

    Raises ThermalStereoError for input that cannot be used.
    """
    from thermal_stereo_vo.benchmarks.board_plane import board_planes, plane_report, shot_map
    from thermal_stereo_vo.calibration.image_sources import Source, image_shots
    from thermal_stereo_vo.calibration.targets import parse_target
    from thermal_stereo_vo.core.calibration_files import load_calibration
    from thermal_stereo_vo.core.cameras import LEFT, RIGHT
    from thermal_stereo_vo.core.config import with_overrides
    from thermal_stereo_vo.core.errors import DatasetError
    from thermal_stereo_vo.outputs.cloud_pictures import disparity_picture
    from thermal_stereo_vo.stereo.dense import DenseConfig

    config = with_overrides(DenseConfig(), args.overrides)
    calibration = load_calibration(args.calibration)
    shots = image_shots(Source((args.left, args.right)), (LEFT, RIGHT))
    planes = list(board_planes(shots, parse_target(args.board), calibration, config))
    if not planes:
        raise DatasetError(
            f"no pair of {args.left} and {args.right} shows the board densely: check --board and "
            "--calibration, or raise --set disparities"
        )
    print(plane_report(planes))
    if args.picture is not None:
        shot = next(shot for shot in shots if shot.name == planes[0].name)
        found = shot_map(shot, calibration, config)
        disparity_picture(args.picture, found.disparity_px, found.counts, title=shot.name)
    return 0
