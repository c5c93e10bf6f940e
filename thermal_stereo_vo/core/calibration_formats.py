"""Calibration files of public recordings: KITTI (odometry and raw) and EuRoC.

The KITTI images are rectified, so their cameras are the pinholes of the projection matrices.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.calibration_yaml import parse_yaml, read_text
from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse, make_transform, orthonormalised

_EUROC_MODELS = {
    "radial-tangential": DistortionModel.RADIAL_TANGENTIAL,
    "radtan": DistortionModel.RADIAL_TANGENTIAL,
    "equidistant": DistortionModel.EQUIDISTANT,
    "none": DistortionModel.NONE,
}


def kitti_odometry_calibration(
    path: Path, image_size: tuple[int, int] | None, eyes: tuple[str, str] = ("P0", "P1")
) -> RigCalibration:
    """``calib.txt``: lines ``P0: ...`` to ``P3: ...``, or two bare rows of 12 (left, right).

    The file does not know the (width, height) of the images: the recording gives it.
    """
    if image_size is None:
        raise CalibrationError(
            f"{path} does not say how large the images are: use it together with its images"
        )
    rows = _numbers_by_key(path)
    bare = [numbers for key, numbers in rows if not key and len(numbers) == 12]
    if bare:
        if len(bare) != 2:
            raise CalibrationError(
                f"{path} has {len(bare)} rows of 12 numbers instead of 2 (left, right)"
            )
        return _rectified_pair(bare[0], bare[1], image_size, image_size, path)
    named = dict(rows)
    left, right = (_projection(named, key, path) for key in eyes)
    return _rectified_pair(left, right, image_size, image_size, path)


def kitti_raw_calibration(path: Path, eyes: tuple[str, str] = ("00", "01")) -> RigCalibration:
    """``calib_cam_to_cam.txt``: ``P_rect_0x`` and ``S_rect_0x`` of the synced, rectified images."""
    named = dict(_numbers_by_key(path))
    left, right = (_projection(named, f"P_rect_{eye}", path) for eye in eyes)
    sizes = []
    for eye in eyes:
        size = named.get(f"S_rect_{eye}", [])
        if len(size) != 2:
            raise CalibrationError(f"{path} has no image size 'S_rect_{eye}' (two numbers)")
        sizes.append((round(size[0]), round(size[1])))
    return _rectified_pair(left, right, sizes[0], sizes[1], path)


def euroc_calibration(folder: Path) -> RigCalibration:
    """``cam0/sensor.yaml`` (left) and ``cam1/sensor.yaml`` (right) in ``folder``.

    The rig frame is the left camera as it is mounted; nothing is rectified.
    """
    left, T_body_left = euroc_camera(folder / "cam0" / "sensor.yaml")
    right, T_body_right = euroc_camera(folder / "cam1" / "sensor.yaml")
    T_left_right = inverse(T_body_left) @ T_body_right
    return RigCalibration(
        {LEFT: RigCamera(left), RIGHT: RigCamera(right, T_left_right)}, origin=str(folder)
    )


def euroc_camera(path: Path) -> tuple[Camera, NDArray[np.float64]]:
    """The camera of a ``sensor.yaml`` and its ``T_BS`` = (4, 4) T_body_camera."""
    text = read_text(path)
    # The OpenCV header "%YAML:1.0" is no valid YAML directive.
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    document = parse_yaml("\n".join(lines), path)
    try:
        width, height = (int(x) for x in document["resolution"])
        fx, fy, cx, cy = (float(x) for x in document["intrinsics"])
        name = str(document.get("distortion_model", "none")).lower()
        coefficients = tuple(float(x) for x in document.get("distortion_coefficients", ()))
        T_body_camera = euroc_extrinsics(document)
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} is no EuRoC camera file: resolution, intrinsics or T_BS is missing or "
            f"malformed ({error!r})"
        ) from None
    if name not in _EUROC_MODELS:
        raise CalibrationError(
            f"{path} has the distortion model '{name}': known are {', '.join(_EUROC_MODELS)}"
        )
    model = _EUROC_MODELS[name]
    if model is DistortionModel.NONE:
        coefficients = ()
    return Camera(width, height, fx, fy, cx, cy, model, coefficients), T_body_camera


def euroc_extrinsics(document: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4) T_BS of a parsed ``sensor.yaml``, its rotation made exact."""
    T = np.array(document["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
    return orthonormalised(T)


def _numbers_by_key(path: Path) -> list[tuple[str, list[float]]]:
    rows = []
    for line in read_text(path).splitlines():
        key, colon, rest = line.partition(":")
        if not colon:
            key, rest = "", line
        try:
            numbers = [float(word) for word in rest.split()]
        except ValueError:
            continue  # calib_time and other words
        if numbers:
            rows.append((key.strip(), numbers))
    return rows


def _projection(named: dict[str, list[float]], key: str, path: Path) -> list[float]:
    numbers = named.get(key, [])
    if len(numbers) != 12:
        raise CalibrationError(
            f"{path} has no projection matrix '{key}' of 12 numbers (it has: "
            f"{', '.join(k for k in named if k) or 'nothing that looks like one'})"
        )
    return numbers


def _rectified_pair(
    left: list[float],
    right: list[float],
    left_size: tuple[int, int],
    right_size: tuple[int, int],
    path: Path,
) -> RigCalibration:
    cameras, columns = [], []
    for numbers, (width, height) in ((left, left_size), (right, right_size)):
        fx, cx, fy, cy = numbers[0], numbers[2], numbers[5], numbers[6]
        cameras.append(Camera(width, height, fx, fy, cx, cy))
        columns.append(numbers[3] / fx)
    # P[0, 3] = -fx * x of the camera; the tiny y and z of the colour cameras are no part of a
    # rectified pair.
    T_left_right = make_transform(np.eye(3), [columns[0] - columns[1], 0.0, 0.0])
    return RigCalibration(
        {LEFT: RigCamera(cameras[0]), RIGHT: RigCamera(cameras[1], T_left_right)},
        rectified=True,
        origin=str(path),
    )
