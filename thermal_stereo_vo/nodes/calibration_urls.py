"""Calibration files as settings name them: ``file://``, ``package://`` or a plain path."""

from __future__ import annotations

from pathlib import Path

from thermal_stereo_vo.core.calibration_files import load_calibration
from thermal_stereo_vo.core.calibration_yaml import parse_camera_info, read_text
from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.stereo_capture import EYES, StereoCaptureConfig


def read_calibrations(config: StereoCaptureConfig) -> dict[str, CameraInfoFields]:
    """``camera_info`` by eye; nothing for an eye without URL.

    Raises CalibrationError for a file that cannot be read or is for another size than the stream.
    """
    urls = (config.left_calibration, config.right_calibration)
    infos = {
        eye: parse_camera_info(read_text(path), path)
        for eye, url in zip(EYES, urls, strict=True)
        if url
        for path in [path_of(url)]
    }
    if config.source == "grabbers":
        for eye, stream in zip(EYES, (config.grabbers.left, config.grabbers.right), strict=True):
            if eye in infos:
                check_size(eye, infos[eye], stream.width, stream.height)
    return infos


def read_rig(url: str, roles: tuple[str, str]) -> RigCalibration:
    """The rig of two cameras that no stereo pair of ``camera_info`` files can describe.

    Raises CalibrationError for no file, or one that lacks a camera.
    """
    first, second = roles
    if not url:
        raise CalibrationError(
            f"nobody says where the {first} and the {second} camera are on the rig: set "
            "rig_calibration to its rig.yaml"
        )
    calibration = load_calibration(path_of(url))
    for role in roles:
        calibration[role]  # raises for one that is missing
    return calibration


def check_size(eye: str, info: CameraInfoFields, width: int, height: int) -> None:
    """Raises CalibrationError for a calibration of another size."""
    if (info.width, info.height) != (width, height):
        raise CalibrationError(
            f"the {eye} calibration is for {info.width}x{info.height} pixels, the stream has "
            f"{width}x{height}: calibrate at the size in use, or ask for that of the calibration"
        )


def path_of(url: str) -> Path:
    """The file of a ``file://`` or ``package://`` URL, or of a plain path.

    >>> path_of("file:///etc/left.yaml").as_posix()
    '/etc/left.yaml'

    Raises CalibrationError for another scheme or a package that is not installed.
    """
    scheme, separator, rest = url.partition("://")
    if not separator:
        return Path(url)
    if scheme == "file":
        return Path(rest)
    if scheme != "package":
        raise CalibrationError(f"the calibration URL '{url}' must begin with file:// or package://")
    from ament_index_python.packages import get_package_share_directory

    package, _, inside = rest.partition("/")
    try:
        return Path(get_package_share_directory(package)) / inside
    except (LookupError, OSError):  # unknown, or no workspace is sourced at all
        raise CalibrationError(
            f"the package '{package}' of the calibration URL '{url}' is not installed"
        ) from None
