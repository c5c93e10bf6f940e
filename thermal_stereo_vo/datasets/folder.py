"""Two folders of images, ``left`` and ``right`` or ``visible`` and ``thermal``.

Files are named by stamp or just numbered.
"""

from __future__ import annotations

import re
from pathlib import Path

from thermal_stereo_vo.core.calibration_files import find_calibration, load_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, THERMAL, VISIBLE
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.datasets.image_files import (
    ImageFile,
    ImageFileDataset,
    list_images,
    read_grey,
)
from thermal_stereo_vo.datasets.options import SourceOptions

_NANOSECOND_DIGITS = 16
"""Whole numbers this long are stamps in nanoseconds (after 1970-04-26); shorter ones count."""


def image_pair(folder: Path) -> tuple[str, str] | None:
    """The roles that ``folder`` holds folders of, or None."""
    for pair in ((LEFT, RIGHT), (VISIBLE, THERMAL)):
        if all((folder / role).is_dir() for role in pair):
            return pair
    return None


def open_image_pair(
    folder: Path, pair: tuple[str, str], options: SourceOptions
) -> ImageFileDataset:
    """The pair below ``folder``, with a calibration file beside the two folders if there is one.

    Stamps come from ``options.rate_hz`` and the place in the folder; without a rate from the file
    names, which then are nanoseconds (16 digits or more) or seconds with a fraction.

    Raises DatasetError when names are no stamps and no rate is given.
    """
    files = {role: _stamped(list_images(folder / role), options.rate_hz) for role in pair}
    path = options.calibration or find_calibration(folder)
    calibration = None
    if path is not None:
        height, width = read_grey(files[pair[0]][0].path).shape
        calibration = load_calibration(path, (width, height))
    return ImageFileDataset(folder.resolve().name, files, calibration)


def _stamped(images: list[Path], rate_hz: float | None) -> list[ImageFile]:
    if rate_hz is not None:
        return [ImageFile(round(i * 1e9 / rate_hz), path, i) for i, path in enumerate(images)]
    stamped = sorted((_stamp(path), path) for path in images)
    return [ImageFile(stamp, path, i) for i, (stamp, path) in enumerate(stamped)]


def _stamp(path: Path) -> int:
    seconds = re.fullmatch(r"(\d+)[._](\d{1,9})", path.stem)
    if seconds:
        return int(seconds[1]) * 10**9 + int(seconds[2].ljust(9, "0"))
    if path.stem.isdigit() and len(path.stem) >= _NANOSECOND_DIGITS:
        return int(path.stem)
    raise DatasetError(
        f"{path} is not named by a stamp (nanoseconds, or seconds with a fraction): give the frame "
        "rate with --rate"
    )
