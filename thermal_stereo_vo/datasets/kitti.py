"""KITTI: odometry sequences (``image_0``, ``image_1``, ``calib.txt``) and raw drives.

A. Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from thermal_stereo_vo.core.calibration_formats import (
    kitti_odometry_calibration,
    kitti_raw_calibration,
)
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import make_transform, orthonormalised
from thermal_stereo_vo.datasets.image_files import (
    ImageFile,
    ImageFileDataset,
    check_order,
    list_images,
    read_grey,
    read_lines,
)
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.replaced_calibration import replaced_calibration
from thermal_stereo_vo.datasets.truth import true_poses

RATE_HZ = 10.0


@dataclass(frozen=True)
class EyeFolders:
    """Image folders of the left and right eye, and what the calibration file calls them."""

    left: str
    right: str
    keys: tuple[str, str]


ODOMETRY_PAIRS = (
    EyeFolders("image_0", "image_1", ("P0", "P1")),
    EyeFolders("image_l", "image_r", ("P0", "P1")),
    EyeFolders("image_2", "image_3", ("P2", "P3")),
)
RAW_PAIRS = (
    EyeFolders("image_00", "image_01", ("00", "01")),
    EyeFolders("image_02", "image_03", ("02", "03")),
)


def odometry_pair(folder: Path) -> EyeFolders | None:
    """The image folders of an odometry sequence, or None when ``folder`` is none."""
    return _present(folder, ODOMETRY_PAIRS)


def raw_pair(folder: Path) -> EyeFolders | None:
    """The image folders of a raw drive, or None when ``folder`` is none."""
    return _present(folder, RAW_PAIRS)


def open_kitti_odometry(folder: Path, eyes: EyeFolders, options: SourceOptions) -> ImageFileDataset:
    """A sequence folder; ``times.txt`` (seconds) and ``poses.txt`` (3x4 rows) where present."""
    paths = {LEFT: list_images(folder / eyes.left), RIGHT: list_images(folder / eyes.right)}
    times = folder / "times.txt"
    times_ns = _read_seconds(times) if times.is_file() else None
    files = {role: _stamped(images, times_ns, times, options) for role, images in paths.items()}
    check_order(files)
    calibration = replaced_calibration(options, paths[LEFT][0])
    if calibration is None and (folder / "calib.txt").is_file():
        height, width = read_grey(paths[LEFT][0]).shape
        calibration = kitti_odometry_calibration(folder / "calib.txt", (width, height), eyes.keys)
        calibration.check_stereo()
    poses = folder / "poses.txt"
    return ImageFileDataset(
        folder.resolve().name,
        files,
        calibration,
        _read_poses(poses, files[LEFT]) if poses.is_file() else None,
    )


def open_kitti_raw(folder: Path, eyes: EyeFolders, options: SourceOptions) -> ImageFileDataset:
    """A synced and rectified drive; ``calib_cam_to_cam.txt`` here or in the folder of the date."""
    files = {}
    for role, name in ((LEFT, eyes.left), (RIGHT, eyes.right)):
        camera = folder / name
        images = list_images(camera / "data" if (camera / "data").is_dir() else camera)
        stamps = camera / "timestamps.txt"
        times_ns = _read_dates(stamps) if stamps.is_file() else None
        files[role] = _stamped(images, times_ns, stamps, options)
    calibration = replaced_calibration(options, files[LEFT][0].path)
    if calibration is None:
        calibration = _raw_calibration(folder, eyes.keys)
    return ImageFileDataset(folder.resolve().name, files, calibration)


def _present(folder: Path, pairs: Sequence[EyeFolders]) -> EyeFolders | None:
    for eyes in pairs:
        if (folder / eyes.left).is_dir() and (folder / eyes.right).is_dir():
            return eyes
    return None


def _raw_calibration(folder: Path, keys: tuple[str, str]) -> RigCalibration | None:
    for place in (folder, folder.resolve().parent):
        path = place / "calib_cam_to_cam.txt"
        if path.is_file():
            calibration = kitti_raw_calibration(path, keys)
            calibration.check_stereo()
            return calibration
    return None


def _stamped(
    images: Sequence[Path], times_ns: Sequence[int] | None, origin: Path, options: SourceOptions
) -> list[ImageFile]:
    """Images with their stamps: line n of the times belongs to file number n."""
    numbers = _numbers(images)
    if times_ns is None:
        period_ns = 1e9 / (options.rate_hz or RATE_HZ)
        return [
            ImageFile(round(number * period_ns), path, number)
            for number, path in zip(numbers, images, strict=True)
        ]
    rows = _rows_of(numbers, len(times_ns), origin)
    return [
        ImageFile(times_ns[row], path, number)
        for number, row, path in zip(numbers, rows, images, strict=True)
    ]


def _numbers(images: Sequence[Path]) -> list[int]:
    """Frame numbers from file names such as 000012.png; places in the list where there are none."""
    if all(image.stem.isdigit() for image in images):
        return [int(image.stem) for image in images]
    return list(range(len(images)))


def _rows_of(numbers: Sequence[int], rows: int, origin: Path) -> Sequence[int]:
    """Which line belongs to which image: by frame number, or in order where the counts agree."""
    if max(numbers) < rows:
        return numbers
    if len(numbers) == rows:
        return range(rows)
    raise DatasetError(
        f"{origin} has {rows} lines, but there are {len(numbers)} images up to number "
        f"{max(numbers)}: one line for each image is needed"
    )


def _read_seconds(path: Path) -> list[int]:
    """Seconds, one a line, to nanoseconds without a detour over floats."""
    stamps = []
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            continue
        match = re.fullmatch(r"(\d+)(?:\.(\d*))?(?:[eE]([+-]?\d+))?", line.strip())
        if match is None:
            raise DatasetError(f"{path}:{number}: '{line}' is no time in seconds")
        if match[3] is not None:
            stamps.append(round(float(line) * 1e9))
        else:
            stamps.append(int(match[1]) * 10**9 + int((match[2] or "").ljust(9, "0")[:9]))
    return stamps


def _read_dates(path: Path) -> list[int]:
    """Lines such as ``2011-09-26 13:02:25.967790592``, taken as UTC, to nanoseconds."""
    stamps = []
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            continue
        whole, _, fraction = line.strip().partition(".")
        try:
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            nanoseconds = int(fraction.ljust(9, "0")[:9])
        except ValueError:
            raise DatasetError(f"{path}:{number}: '{line.strip()}' is no date and time") from None
        stamps.append(int(moment.timestamp()) * 10**9 + nanoseconds)
    return stamps


def _read_poses(path: Path, images: Sequence[ImageFile]) -> Trajectory:
    """Rows of 12 numbers, the pose of the left camera in the world."""
    try:
        rows = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise DatasetError(f"{path} is no pose file (12 numbers a row): {error}") from None
    if rows.shape[1] != 12:
        raise DatasetError(f"{path} has {rows.shape[1]} numbers a row: poses need 12 (3x4)")
    places = _rows_of([image.sequence for image in images], len(rows), path)
    poses = [orthonormalised(make_transform(T[:, :3], T[:, 3])) for T in rows.reshape(-1, 3, 4)]
    stamps = [image.stamp_ns for image in images]
    return true_poses(stamps, [poses[place] for place in places], str(path))
