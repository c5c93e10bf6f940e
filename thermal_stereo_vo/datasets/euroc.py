"""EuRoC MAV recordings (ASL format): ``cam0``, ``cam1``, ``state_groundtruth_estimate0``.

M. Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.calibration_formats import (
    euroc_calibration,
    euroc_camera,
    euroc_extrinsics,
)
from thermal_stereo_vo.core.calibration_yaml import parse_yaml, read_text
from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import (
    identity,
    inverse,
    make_transform,
    rotation_from_quat_xyzw,
)
from thermal_stereo_vo.datasets.image_files import (
    ImageFile,
    ImageFileDataset,
    list_images,
    read_lines,
)
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.replaced_calibration import replaced_calibration
from thermal_stereo_vo.datasets.truth import true_poses

GROUND_TRUTH = "state_groundtruth_estimate0"


def euroc_root(folder: Path) -> Path | None:
    """The folder with ``cam0`` and ``cam1``: ``folder`` itself or its ``mav0``; else None."""
    for root in (folder, folder / "mav0"):
        if (root / "cam0").is_dir() and (root / "cam1").is_dir():
            return root
    return None


def open_euroc(root: Path, options: SourceOptions) -> ImageFileDataset:
    """The recording below ``root`` (see ``euroc_root``); ground truth is that of the left camera.

    Raises DatasetError for missing images, broken lists or stamps out of order.
    """
    files = {role: _camera(root / name) for role, name in ((LEFT, "cam0"), (RIGHT, "cam1"))}
    calibration = replaced_calibration(options, files[LEFT][0].path)
    sensor = root / "cam0" / "sensor.yaml"
    if calibration is None and sensor.is_file():
        calibration = euroc_calibration(root)
        calibration.check_stereo()
    truth = None
    if (root / GROUND_TRUTH / "data.csv").is_file() and sensor.is_file():
        _, T_body_left = euroc_camera(sensor)
        truth = _ground_truth(root / GROUND_TRUTH, T_body_left)
    name = root.resolve()
    return ImageFileDataset(
        name.parent.name if name.name == "mav0" else name.name, files, calibration, truth
    )


def _camera(folder: Path) -> list[ImageFile]:
    """Images by ``data.csv`` (stamp, file name), or by file names that are stamps."""
    data = folder / "data"
    listing = folder / "data.csv"
    if listing.is_file():
        entries = []
        for number, line in enumerate(read_lines(listing), start=1):
            words = [word.strip() for word in line.split(",")]
            if not line.strip() or line.startswith("#"):
                continue
            if len(words) < 2 or not words[0].isdigit():
                raise DatasetError(f"{listing}:{number}: '{line}' is not 'stamp,file name'")
            entries.append((int(words[0]), data / words[1]))
        if not entries:
            raise DatasetError(f"{listing} lists no images")
        missing = [path for _, path in entries if not path.is_file()]
        if missing:
            raise DatasetError(
                f"{listing} lists {len(missing)} images that are not there, the first is "
                f"{missing[0]}: copy the recording again"
            )
    else:
        entries = [(_stamp(path), path) for path in list_images(data if data.is_dir() else folder)]
    return [ImageFile(stamp, path, sequence) for sequence, (stamp, path) in enumerate(entries)]


def _stamp(path: Path) -> int:
    if not path.stem.isdigit():
        raise DatasetError(
            f"{path} is not named by its stamp in nanoseconds and there is no data.csv: add one"
        )
    return int(path.stem)


def _ground_truth(folder: Path, T_body_left: NDArray[np.float64]) -> Trajectory:
    """``data.csv``: stamp, p_RS_R (m), q_RS (w x y z) of the sensor S, which has a ``T_BS``."""
    path = folder / "data.csv"
    stamps, poses = [], []
    T_left_sensor = inverse(T_body_left) @ _mount(folder / "sensor.yaml")
    T_sensor_left = inverse(T_left_sensor)
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(",")
        try:
            stamp = int(words[0])
            x, y, z, qw, qx, qy, qz = (float(word) for word in words[1:8])
            rotation = rotation_from_quat_xyzw([qx, qy, qz, qw])
        except (ValueError, IndexError):
            raise DatasetError(
                f"{path}:{number}: '{line[:60]}' is not 'stamp, x, y, z, qw, qx, qy, qz, ...'"
            ) from None
        stamps.append(stamp)
        poses.append(make_transform(rotation, [x, y, z]) @ T_sensor_left)
    return true_poses(stamps, poses, str(path))


def _mount(path: Path) -> NDArray[np.float64]:
    """T_BS of a sensor; identity without a file, as the estimate is that of the body itself."""
    if not path.is_file():
        return identity()
    text = "\n".join(line for line in read_text(path).splitlines() if not line.startswith("%"))
    document = parse_yaml(text, path)
    try:
        return euroc_extrinsics(document)
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} has no readable T_BS: {error!r}") from None
