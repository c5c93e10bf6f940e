"""``benchmark radiometry``: figures of the thermal front end on real recordings."""

from __future__ import annotations

import argparse


def add_radiometry_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_radiometry`` reads."""
    parser.description = (
        "Print figures of the thermal front end: uniformity under a stored flat field, events of "
        "the gate, fixed pattern before and after scene-based refinement, processor time."
    )
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR",
        help="folder that holds the recordings flat_fields_fpa, lepton_cptv, optris_sweep, "
        "euroc_standing_still, lwir_drive (each may be absent)",
    )


def run_radiometry(args: argparse.Namespace) -> int:
    """Print the report; returns the exit code.

    Raises:
        DatasetError: when the folder is not there.
    """
    from pathlib import Path

    from thermal_stereo_vo.core.errors import DatasetError
    from thermal_stereo_vo.evaluation.radiometry_report import radiometry_report

    data = Path(args.data)
    if not data.is_dir():
        raise DatasetError(f"there is no folder {data}: give the one that holds the recordings")
    for line in radiometry_report(data):
        print(line, flush=True)
    return 0
