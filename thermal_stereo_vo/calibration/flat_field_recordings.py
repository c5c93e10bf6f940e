"""Recordings of uniform sources, from folders of frames and from bags.

A folder holds any of

* ``name.npz``: ``frames`` (N, H, W) or (H, W); ``fpa_kelvin`` and, where known, ``source_kelvin``,
  one number or N; ``serial`` and ``camera`` texts if known.  The recorder of the correction node
  writes such files;
* ``name.raw`` (24-byte header with width and height, then uint16, little-endian) or an image
  ``name.png``, ``.tif``, beside ``name.txt`` with lines ``key = value``: ``fpaTemperatureC`` and,
  if known, ``sourceTemperatureC`` and ``fpaSerial``.

A bag needs the FPA temperature in its diagnostics.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.radiometric import FlatFrame
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field import KELVIN

IMAGES = (".png", ".tif", ".tiff")
BAG_BIN_KELVIN = 0.25
_HEADER = 24


@dataclass(frozen=True)
class FlatRecording:
    """Views of uniform sources by one camera; texts are empty when unknown."""

    frames: tuple[FlatFrame, ...]
    serial: str = ""
    camera: str = ""


def read_flat_fields(
    source: str | Path, *, camera: str = "", source_kelvin: float | None = None
) -> FlatRecording:
    """Read a folder, a single file or a bag.

    Args:
        source: path.
        camera: role whose images to take from a bag of several.
        source_kelvin: temperature of the source where the recording does not state it.

    Raises:
        CalibrationError: when nothing usable is there, a file is damaged or lacks its temperature.
        DatasetError: when a bag cannot be read.
    """
    path = Path(source)
    if not path.exists():
        raise CalibrationError(
            f"there is no recording {path}: give a folder of flat fields or a bag"
        )
    if _is_bag(path):
        recording = _from_bag(path, camera)
    else:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        parts = [_from_file(file) for file in files if _is_flat_field(file)]
        if not parts:
            raise CalibrationError(
                f"{path} holds no flat field: it needs .npz files, or .raw or .png files each "
                "beside a .txt with fpaTemperatureC"
            )
        recording = join(parts)
    if source_kelvin is None:
        return recording
    frames = tuple(
        frame if frame.source_kelvin is not None else replace(frame, source_kelvin=source_kelvin)
        for frame in recording.frames
    )
    return replace(recording, frames=frames)


def join(recordings: list[FlatRecording]) -> FlatRecording:
    """Several recordings of one camera as one.

    Raises:
        CalibrationError: when they name different cameras.
    """
    names = {}
    for kind in ("serial", "camera"):
        known = sorted({getattr(part, kind) for part in recordings} - {""})
        if len(known) > 1:
            raise CalibrationError(
                f"the flat fields come from several cameras ({kind} {', '.join(known)}): calibrate "
                "each camera by itself"
            )
        names[kind] = known[0] if known else ""
    frames = tuple(frame for part in recordings for frame in part.frames)
    return FlatRecording(frames, **names)


def _is_flat_field(file: Path) -> bool:
    if file.suffix == ".npz":
        return True
    return file.suffix in (".raw", *IMAGES) and file.with_suffix(".txt").exists()


def _is_bag(path: Path) -> bool:
    return path.suffix in (".bag", ".db3", ".mcap") or (path / "metadata.yaml").exists()


def _from_file(file: Path) -> FlatRecording:
    if file.suffix == ".npz":
        return _from_npz(file)
    notes = _notes(file.with_suffix(".txt"))
    image = _raw_image(file) if file.suffix == ".raw" else cv2.imread(str(file), -1)
    if image is None or image.ndim != 2:
        raise CalibrationError(f"{file} is no single-channel image: leave it out or copy it again")
    fpa_c = _number(notes, "fpaTemperatureC", file)
    if fpa_c is None:
        raise CalibrationError(f"{file.with_suffix('.txt')} has no line 'fpaTemperatureC = ...'")
    source_c = _number(notes, "sourceTemperatureC", file)
    frame = FlatFrame(
        image, fpa_c + KELVIN, None if source_c is None else source_c + KELVIN, file.name
    )
    return FlatRecording((frame,), serial=notes.get("fpaSerial", ""))


def _raw_image(file: Path) -> NDArray[np.uint16]:
    data = file.read_bytes()
    width, height = np.frombuffer(data[4:12].ljust(8, b"\0"), "<u4").tolist()
    if width * height == 0 or len(data) != _HEADER + 2 * width * height:
        raise CalibrationError(
            f"{file} is cut short or of an unknown kind: it should hold a header of {_HEADER} "
            "bytes and 16 bits for each pixel"
        )
    return np.frombuffer(data, "<u2", offset=_HEADER).reshape(height, width).astype(np.uint16)


def _notes(file: Path) -> dict[str, str]:
    notes = {}
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        key, equals, value = line.partition("=")
        if equals:
            notes[key.strip()] = value.strip()
    return notes


def _number(notes: dict[str, str], key: str, file: Path) -> float | None:
    if key not in notes:
        return None
    try:
        return float(notes[key])
    except ValueError:
        raise CalibrationError(
            f"{file.with_suffix('.txt')}: {key} = '{notes[key]}' is no number"
        ) from None


def _from_npz(file: Path) -> FlatRecording:
    try:
        with np.load(file, allow_pickle=False) as archive:
            fields: dict[str, Any] = {name: archive[name] for name in archive.files}
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile):
        raise CalibrationError(f"{file} is damaged or no .npz file: leave it out") from None
    for name in ("frames", "fpa_kelvin"):
        if name not in fields:
            raise CalibrationError(
                f"{file} has no array '{name}': a flat field needs 'frames' and 'fpa_kelvin'"
            )
    images = np.asarray(fields["frames"])
    images = images[None] if images.ndim == 2 else images
    if images.ndim != 3 or len(images) == 0:
        raise CalibrationError(f"{file}: 'frames' is {images.shape}, not (N, height, width)")
    fpa = _one_each(fields["fpa_kelvin"], len(images), "fpa_kelvin", file)
    sources: list[float | None] = [None] * len(images)
    if "source_kelvin" in fields:
        sources = [*_one_each(fields["source_kelvin"], len(images), "source_kelvin", file)]
    frames = tuple(
        FlatFrame(
            image,
            kelvin,
            source if source is not None and np.isfinite(source) else None,
            f"{file.name}[{index}]",
        )
        for index, (image, kelvin, source) in enumerate(zip(images, fpa, sources, strict=True))
    )
    return FlatRecording(frames, str(fields.get("serial", "")), str(fields.get("camera", "")))


def _one_each(values: Any, count: int, name: str, file: Path) -> list[float]:
    numbers = np.atleast_1d(np.asarray(values, np.float64))
    if numbers.ndim != 1 or len(numbers) not in (1, count):
        raise CalibrationError(f"{file}: '{name}' holds {numbers.shape} numbers for {count} frames")
    return [float(number) for number in np.broadcast_to(numbers, (count,))]


def _from_bag(path: Path, camera: str) -> FlatRecording:
    """Means of a bag's frames over small steps of FPA temperature."""
    from thermal_stereo_vo.datasets.registry import open_dataset

    dataset, _ = open_dataset(path)
    if not camera and len(dataset.cameras) > 1:
        raise CalibrationError(
            f"{path} holds the cameras {', '.join(dataset.cameras)}: choose one with --camera"
        )
    camera = camera or dataset.cameras[0]
    if camera not in dataset.cameras:
        raise CalibrationError(
            f"{path} has no camera '{camera}', only {', '.join(dataset.cameras)}"
        )
    sums: dict[int, tuple[NDArray[np.float64], float, int]] = {}
    for raw in dataset.frames():
        kelvin = None if raw.telemetry is None else raw.telemetry.fpa_temperature_kelvin
        if raw.camera != camera or kelvin is None:
            continue
        index = int(kelvin / BAG_BIN_KELVIN)
        image, total, count = sums.get(index, (np.zeros(raw.image.shape), 0.0, 0))
        sums[index] = image + raw.image, total + kelvin, count + 1
    if not sums:
        raise CalibrationError(
            f"{path} tells no FPA temperature of camera '{camera}': record the status topic along "
            "with the images"
        )
    frames = tuple(
        FlatFrame(image / count, total / count, None, f"{path.name} {total / count - KELVIN:.1f}C")
        for _, (image, total, count) in sorted(sums.items())
    )
    return FlatRecording(frames, camera=camera)
