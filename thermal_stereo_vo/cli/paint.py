"""``paint CLOUD IMAGE``: temperatures of a camera on a cloud made with another."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``paint``."""
    parser.description = (
        "Paint a cloud in axes of the rig with what one of its cameras sees; points that it does "
        "not see, or that lie hidden behind others, are left out."
    )
    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="binary PLY, axes of the rig")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="raw 8- or 16-bit picture")
    parser.add_argument(
        "--calibration", type=Path, required=True, metavar="F", help="rig.yaml with that camera"
    )
    parser.add_argument("--camera", default="thermal", help="its role (default: %(default)s)")
    parser.add_argument("--output", type=Path, required=True, metavar="F", help="PLY to write")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="radiometric calibration, e.g. planck_r=216973; without it counts are painted",
    )


def run(args: argparse.Namespace) -> int:
    """Read, paint, write."""
    import numpy as np

    from thermal_stereo_vo.core.calibration_files import load_calibration
    from thermal_stereo_vo.core.config import with_overrides
    from thermal_stereo_vo.core.errors import DatasetError
    from thermal_stereo_vo.core.results import PointCloud
    from thermal_stereo_vo.core.transforms import inverse
    from thermal_stereo_vo.datasets.image_files import read_grey
    from thermal_stereo_vo.outputs.cloud_pictures import colours_of
    from thermal_stereo_vo.outputs.point_cloud_file import read_ply, write_ply
    from thermal_stereo_vo.radiometry.thermometer import Thermometer, ThermometerConfig
    from thermal_stereo_vo.reconstruction.painting import painted

    thermometer = Thermometer.of(with_overrides(ThermometerConfig(), args.overrides))
    mounted = load_calibration(args.calibration)[args.camera]
    cloud, image = read_ply(args.cloud), read_grey(args.image)
    if image.shape != (mounted.camera.height, mounted.camera.width):
        raise DatasetError(
            f"{args.image} has {image.shape[1]}x{image.shape[0]} pixels, but the calibration of "
            f"'{args.camera}' is for {mounted.camera.width}x{mounted.camera.height}"
        )
    counts = painted(cloud.xyz, image, mounted.camera, inverse(mounted.T_rig_camera))
    seen = np.isfinite(counts)
    if not seen.any():
        raise DatasetError(
            f"camera '{args.camera}' sees no point of {args.cloud}: the cloud must be in axes of "
            "the rig that the calibration speaks of"
        )
    kelvin = None if thermometer is None else thermometer.kelvin(counts[seen])
    result = PointCloud(cloud.xyz[seen], counts[seen], kelvin)
    shown = result.intensity if kelvin is None else kelvin
    write_ply(args.output, result, rgb=colours_of(shown))
    print(f"{seen.sum()} of {len(seen)} points painted; {args.output}")
    return 0
