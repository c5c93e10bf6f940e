"""Rig calibrations as files: the ROS ``camera_info`` pair, our ``rig.yaml``, KITTI and EuRoC."""

from __future__ import annotations

from pathlib import Path

from thermal_stereo_vo.core.calibration_formats import (
    euroc_calibration,
    kitti_odometry_calibration,
    kitti_raw_calibration,
)
from thermal_stereo_vo.core.calibration_yaml import (
    dump_camera_info,
    dump_rig,
    parse_camera_info,
    parse_rig,
    parse_yaml,
    read_text,
)
from thermal_stereo_vo.core.camera_info import calibration_from_pair, infos_from_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError

RIG_FILE = "rig.yaml"
_FOLDER_FILES = (
    RIG_FILE,
    "left.yaml",
    "calib_cam_to_cam.txt",
    "calib.txt",
    "cam0/sensor.yaml",
    "mav0/cam0/sensor.yaml",
)


def load_calibration(path: Path, image_size: tuple[int, int] | None = None) -> RigCalibration:
    """Read a calibration, whatever its format.

    ``path`` is a file or a folder: ``left.yaml`` + ``right.yaml`` (ROS ``camera_info``), our
    ``rig.yaml``, KITTI ``calib.txt`` or ``calib_cam_to_cam.txt``, or a EuRoC folder with
    ``cam0/sensor.yaml``.  ``image_size`` is the (width, height) of the images, asked for only by
    files that do not know it (KITTI ``calib.txt``).

    Raises CalibrationError for a file that is missing, unreadable or unknown, and for a stereo pair
    with zero baseline, swapped eyes or unequal sizes.
    """
    calibration = _load(path, image_size)
    if LEFT in calibration.cameras and RIGHT in calibration.cameras:
        calibration.check_stereo()
    return calibration


def find_calibration(folder: Path) -> Path | None:
    """The first calibration file known by name in ``folder``, or None."""
    for name in _FOLDER_FILES:
        if (folder / name).is_file():
            return folder / name
    return None


def save_calibration(calibration: RigCalibration, folder: Path) -> None:
    """Write ``rig.yaml``, and ``left.yaml`` and ``right.yaml`` where there is such a pair.

    All numbers survive a round trip exactly.  ``left.yaml`` and ``right.yaml`` are left out when an
    unrectified pair has no R and P yet, as their format cannot do without.  Existing files are
    replaced only after everything has been written.
    """
    texts = {RIG_FILE: dump_rig(calibration)}
    if _fits_camera_info(calibration):
        infos = infos_from_calibration(calibration)
        texts |= {f"{eye}.yaml": dump_camera_info(infos[eye]) for eye in (LEFT, RIGHT)}
    folder.mkdir(parents=True, exist_ok=True)
    partial = {folder / name: folder / f".{name}.partial" for name in texts}
    try:
        for path, temporary in partial.items():
            temporary.write_text(texts[path.name], encoding="utf-8")
        for path, temporary in partial.items():
            temporary.replace(path)
    finally:
        for temporary in partial.values():
            temporary.unlink(missing_ok=True)


def _load(path: Path, image_size: tuple[int, int] | None) -> RigCalibration:
    if path.is_dir():
        found = find_calibration(path)
        if found is None:
            raise CalibrationError(
                f"no calibration in {path}: looked for {', '.join(_FOLDER_FILES)}"
            )
        path = found
    if path.name == "sensor.yaml":
        return euroc_calibration(path.parent.parent)
    text = read_text(path)
    if path.suffix in (".yaml", ".yml"):
        document = parse_yaml(text, path)
        if "cameras" in document:
            return parse_rig(text, path)
        if "camera_matrix" in document:
            return _load_camera_info_pair(path)
        raise CalibrationError(
            f"{path} is no calibration known here: it has neither 'cameras' (rig.yaml) nor "
            "'camera_matrix' (ROS camera_info)"
        )
    if "P_rect_" in text:
        return kitti_raw_calibration(path)
    return kitti_odometry_calibration(path, image_size)


def _load_camera_info_pair(path: Path) -> RigCalibration:
    eye = next((e for e in (LEFT, RIGHT) if e in path.name), None)
    if eye is None:
        raise CalibrationError(
            f"{path} is the camera_info of one camera: name the pair left.yaml and right.yaml"
        )
    other = RIGHT if eye == LEFT else LEFT
    partner = path.with_name(path.name.replace(eye, other))
    if not partner.is_file():
        raise CalibrationError(
            f"the {other} camera of {path} is missing: looked for {partner.name} beside it"
        )
    infos = {eye: path, other: partner}
    left, right = (parse_camera_info(read_text(infos[e]), infos[e]) for e in (LEFT, RIGHT))
    return calibration_from_pair(left, right, origin=str(path.parent))


def _fits_camera_info(calibration: RigCalibration) -> bool:
    if LEFT not in calibration.cameras or RIGHT not in calibration.cameras:
        return False
    complete = all(
        calibration[eye].rectification is not None and calibration[eye].projection is not None
        for eye in (LEFT, RIGHT)
    )
    return calibration.rectified or complete
