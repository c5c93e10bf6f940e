"""Calibrations as YAML text: ROS's ``camera_info`` of one camera, and our ``rig.yaml``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.cameras import (
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import identity

_CAMERA_KEYS = (
    "width",
    "height",
    "fx",
    "fy",
    "cx",
    "cy",
    "model",
    "distortion",
    "T_rig_camera",
    "rectification",
    "projection",
)
_RIG_KEYS = ("rectified", "T_base_rig", "T_rig_imu", "cameras")


def read_text(path: Path) -> str:
    """The text of a file, or CalibrationError."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CalibrationError(f"there is no calibration file {path}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read the calibration {path}: {error}") from None


def parse_yaml(text: str, path: Path) -> dict[str, Any]:
    """A YAML mapping, or CalibrationError that names ``path``."""
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationError(
            f"{path} is not valid YAML: {' '.join(str(error).split())}"
        ) from None
    if not isinstance(document, dict):
        raise CalibrationError(f"{path} must hold keys and values, as a calibration file does")
    return document


def dump_camera_info(info: CameraInfoFields) -> str:
    """``camera_info`` as the YAML of ROS's ``camera_calibration_parsers``."""

    def matrix(rows: int, numbers: Sequence[float]) -> dict[str, Any]:
        return {"rows": rows, "cols": len(numbers) // rows, "data": list(numbers)}

    document = {
        "image_width": info.width,
        "image_height": info.height,
        "camera_name": info.name,
        "camera_matrix": matrix(3, info.k),
        "distortion_model": info.distortion_model,
        "distortion_coefficients": matrix(1, info.d),
        "rectification_matrix": matrix(3, info.r),
        "projection_matrix": matrix(3, info.p),
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)


def parse_camera_info(text: str, path: Path) -> CameraInfoFields:
    """The inverse of ``dump_camera_info``; ``path`` is for messages."""
    document = parse_yaml(text, path)

    def matrix(key: str) -> tuple[float, ...]:
        return tuple(float(x) for x in document[key]["data"])

    try:
        return CameraInfoFields(
            width=int(document["image_width"]),
            height=int(document["image_height"]),
            distortion_model=str(document["distortion_model"]),
            d=matrix("distortion_coefficients"),
            k=matrix("camera_matrix"),
            r=matrix("rectification_matrix"),
            p=matrix("projection_matrix"),
            name=str(document.get("camera_name", path.stem)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} is no complete camera_info file: {error!r} is missing or malformed"
        ) from None
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def dump_rig(calibration: RigCalibration) -> str:
    """A rig of any cameras as YAML; every number survives exactly."""
    document: dict[str, Any] = {"rectified": calibration.rectified}
    if calibration.T_base_rig is not None:
        document["T_base_rig"] = _rows(calibration.T_base_rig)
    if calibration.T_rig_imu is not None:
        document["T_rig_imu"] = _rows(calibration.T_rig_imu)
    document["cameras"] = {
        role: _camera_document(mounted) for role, mounted in calibration.cameras.items()
    }
    head = (
        "# Camera rig.  T_a_b maps b to a, in metres; lengths of cameras in pixels.\n"
        "# rig: optical frame of the rectified left (or visible) camera; base: base_link.\n"
    )
    return head + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)


def parse_rig(text: str, path: Path) -> RigCalibration:
    """The inverse of ``dump_rig``; ``path`` is for messages."""
    document = parse_yaml(text, path)
    _refuse_unknown(document, _RIG_KEYS, path, "")
    cameras = document.get("cameras")
    if not isinstance(cameras, Mapping) or not cameras:
        raise CalibrationError(f"{path} names no cameras: give them under 'cameras:'")
    T_base_rig, T_rig_imu = document.get("T_base_rig"), document.get("T_rig_imu")
    return RigCalibration(
        {str(role): _parse_camera(role, value, path) for role, value in cameras.items()},
        rectified=bool(document.get("rectified", False)),
        origin=str(path),
        T_base_rig=None if T_base_rig is None else _motion(T_base_rig, path, "T_base_rig"),
        T_rig_imu=None if T_rig_imu is None else _motion(T_rig_imu, path, "T_rig_imu"),
    )


def _camera_document(mounted: RigCamera) -> dict[str, Any]:
    camera = mounted.camera
    document: dict[str, Any] = {
        "width": int(camera.width),
        "height": int(camera.height),
        "fx": float(camera.fx),
        "fy": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "model": camera.model.value,
        "distortion": [float(x) for x in camera.distortion],
        "T_rig_camera": _rows(mounted.T_rig_camera),
    }
    if mounted.rectification is not None:
        document["rectification"] = _rows(mounted.rectification)
    if mounted.projection is not None:
        document["projection"] = _rows(mounted.projection)
    return document


def _parse_camera(role: str, value: Any, path: Path) -> RigCamera:
    if not isinstance(value, Mapping):
        raise CalibrationError(f"{path}: camera '{role}' must hold keys and values")
    _refuse_unknown(value, _CAMERA_KEYS, path, f"cameras.{role}.")
    models = [model.value for model in DistortionModel]
    name = value.get("model", DistortionModel.NONE.value)
    if name not in models:
        raise CalibrationError(
            f"{path}: camera '{role}' has the distortion model '{name}': known are "
            f"{', '.join(models)}"
        )
    try:
        camera = Camera(
            width=int(value["width"]),
            height=int(value["height"]),
            fx=float(value["fx"]),
            fy=float(value["fy"]),
            cx=float(value["cx"]),
            cy=float(value["cy"]),
            model=DistortionModel(name),
            distortion=tuple(float(x) for x in value.get("distortion") or ()),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path}: camera '{role}' is incomplete: {error!r} is missing or malformed"
        ) from None
    except CalibrationError as error:
        raise CalibrationError(f"{path}: camera '{role}': {error}") from None
    T_rig_camera = value.get("T_rig_camera")
    where = f"cameras.{role}."
    return RigCamera(
        camera,
        identity() if T_rig_camera is None else _motion(T_rig_camera, path, f"{where}T_rig_camera"),
        _matrix(value.get("rectification"), (3, 3), path, f"{where}rectification"),
        _matrix(value.get("projection"), (3, 4), path, f"{where}projection"),
    )


def _motion(value: Any, path: Path, key: str) -> NDArray[np.float64]:
    T = _matrix(value, (4, 4), path, key)
    assert T is not None
    R = T[:3, :3]
    rigid = np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-5) and np.linalg.det(R) > 0
    if not rigid or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(
            f"{path}: {key} is no rigid motion: give a rotation (3x3), a translation in metres "
            "and the last row 0 0 0 1"
        )
    return T


def _matrix(value: Any, shape: tuple[int, int], path: Path, key: str) -> NDArray[np.float64] | None:
    if value is None:
        return None
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != shape or not np.all(np.isfinite(matrix)):
        raise CalibrationError(f"{path}: {key} must be {shape[0]} rows of {shape[1]} numbers")
    return matrix


def _refuse_unknown(
    mapping: Mapping[str, Any], known: Sequence[str], path: Path, prefix: str
) -> None:
    for key in mapping:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean '{prefix}{near[0]}'?" if near else f"known are {', '.join(known)}"
            raise CalibrationError(f"{path}: unknown key '{prefix}{key}': {hint}")


def _rows(matrix: NDArray[np.float64]) -> list[list[float]]:
    return [[float(x) for x in row] for row in matrix]
