"""``reconstruct SOURCE --output DIR``: a model of what a recording has seen."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_settings,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress
from thermal_stereo_vo.cli.source_arguments import add_source_arguments, source_options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from thermal_stereo_vo.reconstruction.reconstructor import Reconstructor
    from thermal_stereo_vo.reconstruction.volume import SurfaceModel

ZERO_CELSIUS_KELVIN = 273.15


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``reconstruct``."""
    parser.description = (
        "Run the odometry over a recording, fuse dense clouds of its keyframes into one model and "
        "write it as model.ply and model.pcd: axes of odom (x ahead, y left, z up), intensity and, "
        "with thermometer.planck_r, temperature, each with its spread, and how often it was seen."
    )
    add_source_arguments(parser)
    add_config_arguments(parser)
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder for the model"
    )
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run(args: argparse.Namespace) -> int:
    """Replay, fuse, write DIR."""
    from thermal_stereo_vo.core.cameras import default_T_base_rig
    from thermal_stereo_vo.core.errors import DatasetError
    from thermal_stereo_vo.core.transforms import transform_points
    from thermal_stereo_vo.datasets.registry import open_dataset, require_calibration
    from thermal_stereo_vo.outputs.cloud_pictures import disparity_picture
    from thermal_stereo_vo.outputs.run_folder import RunFolder, run_record
    from thermal_stereo_vo.outputs.trajectory_file import TrajectoryFiles
    from thermal_stereo_vo.radiometry.thermometer import Thermometer
    from thermal_stereo_vo.reconstruction.config import ReconstructConfig
    from thermal_stereo_vo.reconstruction.reconstructor import Reconstructor, in_axes
    from thermal_stereo_vo.replay import replay
    from thermal_stereo_vo.stereo.rectification import Rectifier

    config = load_settings(args, ReconstructConfig())
    dataset, reason = open_dataset(args.source, source_options(args, simulation_overrides(args)))
    calibration = require_calibration(dataset)
    rectifier = Rectifier(calibration, config.rectification)
    known = rectifier.rectified_calibration.T_base_rig
    T_base_rig = default_T_base_rig() if known is None else known
    reconstructor = Reconstructor(config.dense, config.model, Thermometer.of(config.thermometer))
    with RunFolder(args.output) as folder:
        files = TrajectoryFiles(folder.path)
        with progress(dataset.instants(), "pair", quiet=args.quiet) as step:
            replay(dataset, calibration, config, [files, reconstructor], on_progress=step)
        model = in_axes(T_base_rig, reconstructor.model())
        if len(model.cloud.xyz) == 0:
            raise DatasetError(
                f"{args.source} gives no surface at all: {reconstructor.keyframes} keyframes gave "
                f"{reconstructor.measured_points} points; lower model.volume.min_count or raise "
                "dense.max_sigma_px"
            )
        figures = _figures(reconstructor, model)
        folder.write_json("model.json", figures)
        _write_clouds(folder.path, model)
        if not args.no_plot:
            way_m = transform_points(T_base_rig, files.trajectory.positions_m)
            _draw(folder.path, model, way_m, dataset.name, config.model.volume.voxel_m)
            sample = reconstructor.sample
            if sample is not None:
                picture = folder.path / "disparity.png"
                disparity_picture(picture, sample.disparity_px, sample.counts)
        folder.write_json(
            "run.json",
            run_record(
                settings=config,
                calibration=calibration,
                source=args.source,
                source_reason=reason,
                command_line=sys.argv,
                T_rig_rectified=rectifier.T_rig_rectified,
            ),
        )
    if not args.quiet:
        print(f"{args.source}: {reason}")
        print(
            f"{figures['keyframes']} keyframes gave {figures['measured_points']} points; the model "
            f"has {figures['points']} in {config.model.volume.voxel_m:g} m voxels"
        )
        print(f"results are in {args.output}")
    return 0


def _figures(reconstructor: Reconstructor, model: SurfaceModel) -> dict[str, object]:
    import numpy as np

    xyz, temperature = model.cloud.xyz, model.cloud.temperature_kelvin
    return {
        "keyframes": reconstructor.keyframes,
        "measured_points": reconstructor.measured_points,
        "points": len(xyz),
        "lowest_m": xyz.min(axis=0),
        "highest_m": xyz.max(axis=0),
        "median_count": float(np.median(model.count)),
        "median_temperature_kelvin": None if temperature is None else float(np.median(temperature)),
    }


def _write_clouds(folder: Path, model: SurfaceModel) -> None:
    import numpy as np

    from thermal_stereo_vo.outputs.cloud_pictures import colours_of
    from thermal_stereo_vo.outputs.point_cloud_file import write_pcd, write_ply

    more = {"intensity_spread": model.intensity_spread}
    if model.temperature_spread_kelvin is not None:
        more["temperature_spread"] = model.temperature_spread_kelvin
    more["count"] = model.count.astype(np.float32)
    write_ply(folder / "model.ply", model.cloud, more, colours_of(_shown(model)[0]))
    write_pcd(folder / "model.pcd", model.cloud, more)


def _draw(
    folder: Path, model: SurfaceModel, way_m: NDArray[np.float64], name: str, voxel_m: float
) -> None:
    """From above, and from behind and above where the run began."""
    import numpy as np

    from thermal_stereo_vo.outputs.cloud_pictures import oblique_view, top_view

    values, label = _shown(model)
    xyz = model.cloud.xyz
    top_view(folder / "top.png", xyz, values, way_m, label=label, title=name, point_m=voxel_m)
    start_m = way_m[0] if len(way_m) else np.zeros(3)
    ahead = way_m[-1] - start_m if len(way_m) else np.zeros(3)
    length_m = float(np.linalg.norm(ahead))
    ahead = ahead / length_m if length_m > 1.0 else np.array([1.0, 0.0, 0.0])
    oblique_view(
        folder / "oblique.png",
        xyz,
        values,
        label=label,
        title=name,
        eye_m=start_m - 8.0 * ahead + [0.0, 0.0, 9.0],
        target_m=start_m + 15.0 * ahead - [0.0, 0.0, 1.0],
        point_m=voxel_m,
    )


def _shown(model: SurfaceModel) -> tuple[NDArray[np.float32], str]:
    """What becomes colour: temperature where known, else intensity."""
    if model.cloud.temperature_kelvin is None:
        return model.cloud.intensity, "intensity (counts)"
    return model.cloud.temperature_kelvin - ZERO_CELSIUS_KELVIN, "temperature (degC)"
