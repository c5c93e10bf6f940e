"""The file of a stored flat field: one versioned .npz per camera."""

from __future__ import annotations

import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field import FlatFieldCalibration

FORMAT = "thermal_stereo_vo flat field"
VERSION = 1

_TEXTS = ("serial", "camera")
_NUMBERS = ("minimum_kelvin", "maximum_kelvin", "centre_kelvin", "scale_kelvin")
_ARRAYS = {
    "level": np.float64,
    "offset": np.float32,
    "gain": np.float32,
    "bad": np.bool_,
    "fpa_kelvin": np.float64,
    "uncorrected_counts": np.float64,
    "residual_counts": np.float64,
}


def save_flat_field(path: str | Path, calibration: FlatFieldCalibration) -> None:
    """Write the flat field; the file appears only when it is whole.

    Raises:
        CalibrationError: when the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    fields: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    for name in (*_TEXTS, *_NUMBERS, *_ARRAYS):
        fields[name] = getattr(calibration, name)
    try:
        with temporary.open("wb") as file:
            np.savez(file, **fields)
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise CalibrationError(f"cannot write the flat field {path}: {error.strerror}") from None


def load_flat_field(path: str | Path) -> FlatFieldCalibration:
    """Read a flat field.

    Raises:
        CalibrationError: when the file is missing, damaged, of another kind or of a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise CalibrationError(
            f"there is no flat field {path}: make one with 'calibrate flat-field', or leave "
            "flat_field.file empty"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            fields = {name: archive[name] for name in archive.files}
    except (ValueError, TypeError, OSError, EOFError, KeyError, zipfile.BadZipFile):
        raise CalibrationError(
            f"{path} is damaged or no .npz file: copy it again, or calibrate again"
        ) from None
    if str(fields.get("format", "")) != FORMAT:
        raise CalibrationError(
            f"{path} is no flat field: give a file made by 'calibrate flat-field'"
        )
    version = int(fields.get("version", 0))
    if version != VERSION:
        raise CalibrationError(
            f"{path} is a flat field of version {version}, this program reads version {VERSION}: "
            "calibrate again or use the program that wrote it"
        )
    missing = [name for name in (*_TEXTS, *_NUMBERS, *_ARRAYS) if name not in fields]
    if missing:
        raise CalibrationError(f"{path} lacks {', '.join(missing)}: calibrate again")
    try:
        values: dict[str, Any] = {name: str(fields[name]) for name in _TEXTS}
        values |= {name: float(fields[name]) for name in _NUMBERS}
        values |= {name: fields[name].astype(kind) for name, kind in _ARRAYS.items()}
        return FlatFieldCalibration(**values)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    except (TypeError, ValueError):
        raise CalibrationError(f"{path} holds fields of the wrong kind: calibrate again") from None
