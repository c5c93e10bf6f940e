"""``benchmark painting``: temperatures on a visible camera's cloud against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_painting_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_painting`` reads."""
    parser.description = (
        "Paint the cloud of a simulated visible camera with the temperatures that the thermal "
        "camera beside it sees, and compare with the true ones."
    )
    parser.add_argument("--preset", default="ms-02", help="run (default: %(default)s)")
    parser.add_argument("--at", type=float, default=0.3, help="part of the run (default 0.3)")
    parser.add_argument("--picture", type=Path, metavar="F", help="PNG of the painted cloud")


def run_painting(args: argparse.Namespace) -> int:
    """Print the figures; returns the exit code.

    Raises SimulationError for an unknown preset.
    """
    import numpy as np

    from thermal_stereo_vo.benchmarks.painting import painted_view
    from thermal_stereo_vo.core.cameras import default_T_base_rig
    from thermal_stereo_vo.core.transforms import transform_points
    from thermal_stereo_vo.outputs.cloud_pictures import oblique_view

    view = painted_view(args.preset, args.at)
    print(view.report())
    if args.picture is not None:
        given = np.isfinite(view.painted_kelvin)
        xyz = transform_points(default_T_base_rig(), view.xyz_m[given])
        oblique_view(
            args.picture,
            xyz,
            view.painted_kelvin[given] - 273.15,
            label="temperature (degC)",
            eye_m=np.array([-0.6, -0.9, 0.6]),
            target_m=np.median(xyz, axis=0),
            point_m=0.02,
        )
    return 0
