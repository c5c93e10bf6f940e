"""Which reader a source needs, and why."""

from __future__ import annotations

from pathlib import Path

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.datasets.options import SourceOptions

__all__ = ["SourceOptions", "open_dataset", "require_calibration"]

SIMULATED = "sim:"
BAG_SUFFIXES = (".bag", ".db3", ".mcap")


def open_dataset(source: str | Path, options: SourceOptions | None = None) -> tuple[Dataset, str]:
    """Open a recording or a simulated run, and say in words why it was taken for what.

    ``source`` is a folder (KITTI odometry, KITTI raw, EuRoC, ``left`` + ``right``,
    ``visible`` + ``thermal``, ROS 2 bag), a bag file (``.bag``, ``.db3``, ``.mcap``) or
    ``sim:PRESET``.

    Raises DatasetError or CalibrationError that say what was wrong and what to do.
    """
    options = options or SourceOptions()
    if str(source).startswith(SIMULATED):
        from thermal_stereo_vo.datasets.simulated import open_simulated

        preset = str(source)[len(SIMULATED) :]
        return open_simulated(preset, options), f"simulated run '{preset}'"
    path = Path(source)
    if not path.exists():
        raise DatasetError(
            f"there is no recording {path}: give a folder, a bag file or {SIMULATED}PRESET"
        )
    if path.is_dir():
        return _open_folder(path, options)
    if path.suffix in BAG_SUFFIXES:
        return _open_bag(path, options)
    raise DatasetError(
        f"{path} is no recording known here: give a folder, or a bag file ending in "
        f"{', '.join(BAG_SUFFIXES)}"
    )


def require_calibration(dataset: Dataset) -> RigCalibration:
    """The calibration of ``dataset``.  Raises DatasetError when it has none."""
    calibration = dataset.calibration()
    if calibration is None:
        raise DatasetError(
            f"the recording '{dataset.name}' brings no calibration: give one with --calibration "
            "(folder with left.yaml and right.yaml, rig.yaml, KITTI calib.txt or EuRoC folder)"
        )
    return calibration


def _open_folder(path: Path, options: SourceOptions) -> tuple[Dataset, str]:
    from thermal_stereo_vo.datasets import euroc, folder, kitti

    eyes = kitti.raw_pair(path)
    if eyes is not None:
        reason = f"KITTI raw drive: it has {eyes.left} and {eyes.right}"
        return kitti.open_kitti_raw(path, eyes, options), reason
    eyes = kitti.odometry_pair(path)
    if eyes is not None:
        reason = f"KITTI odometry sequence: it has {eyes.left} and {eyes.right}"
        return kitti.open_kitti_odometry(path, eyes, options), reason
    root = euroc.euroc_root(path)
    if root is not None:
        return euroc.open_euroc(root, options), "EuRoC recording: it has cam0 and cam1"
    pair = folder.image_pair(path)
    if pair is not None:
        reason = f"pair of image folders: it has {pair[0]} and {pair[1]}"
        return folder.open_image_pair(path, pair, options), reason
    bags = [p for suffix in BAG_SUFFIXES for p in sorted(path.glob(f"*{suffix}"))]
    if bags or (path / "metadata.yaml").is_file():
        return _open_bag(path, options)
    if not any(path.iterdir()):
        raise DatasetError(f"the folder {path} is empty: give the folder of a recording")
    raise DatasetError(
        f"{path} is no recording known here: looked for image_0 + image_1, image_l + image_r, "
        "image_00 + image_01 (KITTI), cam0 + cam1 (EuRoC), left + right or visible + "
        "thermal (images) and metadata.yaml (ROS 2 bag)"
    )


def _open_bag(path: Path, options: SourceOptions) -> tuple[Dataset, str]:
    from thermal_stereo_vo.datasets.rosbag import open_bag

    return open_bag(path, options)
