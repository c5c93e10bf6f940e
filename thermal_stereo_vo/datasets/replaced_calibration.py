"""The calibration the caller gave instead of the recording's own."""

from __future__ import annotations

from pathlib import Path

from thermal_stereo_vo.core.calibration_files import load_calibration
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.datasets.image_files import read_grey
from thermal_stereo_vo.datasets.options import SourceOptions


def replaced_calibration(options: SourceOptions, first_image: Path) -> RigCalibration | None:
    """``options.calibration`` for images like ``first_image``, or None when none was given."""
    if options.calibration is None:
        return None
    height, width = read_grey(first_image).shape
    return load_calibration(options.calibration, (width, height))
