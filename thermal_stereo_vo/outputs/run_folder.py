"""The folder a run leaves: results, and all that is needed to repeat them."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import platform
import shutil
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import thermal_stereo_vo
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import flatten
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.outputs.replacing import write_text

PROGRAM = thermal_stereo_vo.__name__
RUN_FILE = "run.json"
WORK_FOLDER = ".partial"


class RunFolder:
    """A results folder that is filled in secret and shown when the run has succeeded.

    Inside the ``with`` block everything is written below ``path``; on leaving it the files move to
    ``directory``, where they replace those of an earlier run.  After an error nothing is left, and
    the earlier run stays.

    Raises ConfigError when ``directory`` holds anything but an earlier run, or cannot be written.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.path = directory / WORK_FOLDER
        self._is_new = not directory.exists()

    def __enter__(self) -> RunFolder:
        self._refuse_foreign_content()
        try:
            shutil.rmtree(self.path, ignore_errors=True)
            self.path.mkdir(parents=True)
        except OSError as error:
            raise ConfigError(
                f"the output folder {self.directory} cannot be written: {error.strerror}"
            ) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self._publish()
        shutil.rmtree(self.path, ignore_errors=True)
        if kind is not None and self._is_new and not any(self.directory.iterdir()):
            self.directory.rmdir()

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write ``content`` as JSON; numbers that are not finite become null."""
        write_text(self.path / name, to_json(content))

    def write_png(self, name: str, picture: NDArray[np.uint8]) -> None:
        """Write an (H, W) or (H, W, 3) BGR picture."""
        cv2.imwrite(str(self.path / name), picture)

    def _refuse_foreign_content(self) -> None:
        if not self.directory.exists():
            return
        if not self.directory.is_dir():
            raise ConfigError(f"the output {self.directory} is a file: give a folder")
        content = [entry.name for entry in self.directory.iterdir() if entry.name != WORK_FOLDER]
        if content and not is_run_folder(self.directory):
            raise ConfigError(
                f"the output folder {self.directory} is not empty and holds no earlier run "
                f"({', '.join(sorted(content)[:3])} ...): give a new folder"
            )

    def _publish(self) -> None:
        for entry in self.directory.iterdir():
            if entry.name == WORK_FOLDER:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        # run.json comes last: where it is, the run is complete.
        for entry in sorted(self.path.iterdir(), key=lambda entry: entry.name == RUN_FILE):
            entry.replace(self.directory / entry.name)


def is_run_folder(directory: Path) -> bool:
    """Whether a complete run of this program lies here."""
    try:
        record = json.loads((directory / RUN_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(record, dict) and record.get("program") == PROGRAM


def run_record(
    *,
    settings: Any,
    calibration: RigCalibration | None,
    source: str,
    source_reason: str,
    command_line: Sequence[str],
    **more: Any,
) -> dict[str, Any]:
    """What ``run.json`` holds.

    ``settings`` is a settings dataclass; ``source_reason`` says why the source was taken for what
    it was taken for; ``more`` is added as it is.
    """
    return {
        "program": PROGRAM,
        "command_line": list(command_line),
        "source": source,
        "source_reason": source_reason,
        "settings": flatten(settings),
        "calibration": None if calibration is None else calibration_record(calibration),
        "versions": versions(),
        **more,
    }


def calibration_record(calibration: RigCalibration) -> dict[str, Any]:
    """A calibration as nested dictionaries and lists."""
    return {
        "origin": calibration.origin,
        "rectified": calibration.rectified,
        "T_base_rig": calibration.T_base_rig,
        "cameras": {
            role: {
                **dataclasses.asdict(mounted.camera),
                "T_rig_camera": mounted.T_rig_camera,
                "rectification": mounted.rectification,
                "projection": mounted.projection,
            }
            for role, mounted in calibration.cameras.items()
        },
    }


def versions() -> dict[str, str]:
    """Of the package and of all that can change its numbers."""
    found = {
        PROGRAM: thermal_stereo_vo.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "platform": platform.platform(),
    }
    for name in ("numba", "scipy"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    return found


def to_json(content: Mapping[str, Any]) -> str:
    """Indented JSON of mappings, sequences, arrays, enums, paths and numbers."""
    return json.dumps(_plain(content), indent=2, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
