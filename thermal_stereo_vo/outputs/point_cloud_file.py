"""Point clouds as PLY and PCD, binary little-endian.

PLY after G. Turk, The PLY polygon file format (1994); PCD after the file format page of the Point
Cloud Library (version 0.7).  Fields are float32 ``x y z intensity`` and, where known,
``temperature`` (kelvin) and ``thermal`` (counts), then whatever else is known of each point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.outputs.replacing import replacing

Table = NDArray[Any]
"""(N,) structured array."""

PLY_TYPES = {
    name: code
    for code, names in (
        ("i1", "char int8"),
        ("u1", "uchar uint8"),
        ("<i2", "short int16"),
        ("<u2", "ushort uint16"),
        ("<i4", "int int32"),
        ("<u4", "uint uint32"),
        ("<f4", "float float32"),
        ("<f8", "double float64"),
    )
    for name in names.split()
}
COLOURS = ("red", "green", "blue")
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
LONGEST_HEADER_LINES = 200


def write_ply(
    path: Path,
    cloud: PointCloud,
    more: Mapping[str, NDArray[Any]] | None = None,
    rgb: NDArray[np.uint8] | None = None,
) -> None:
    """Write a cloud as PLY, as MeshLab, CloudCompare and Open3D read it.

    ``more`` holds further columns (N,), written as float32; ``rgb`` (N, 3) the colours that viewers
    show.
    """
    table = _table(cloud, more or {})
    if rgb is not None:
        table = _with_colours(table, rgb)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(
            f"property {'uchar' if name in COLOURS else 'float'} {name}"
            for name in table.dtype.names or ()
        ),
        "end_header",
    ]
    _write(path, header, table)


def write_pcd(
    path: Path, cloud: PointCloud, more: Mapping[str, NDArray[Any]] | None = None
) -> None:
    """Write a cloud as PCD, as the Point Cloud Library reads it; ``more`` as in ``write_ply``."""
    table = _table(cloud, more or {})
    names = table.dtype.names or ()
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' for _ in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(table)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        "DATA binary",
    ]
    _write(path, header, table)


def read_ply(path: Path) -> PointCloud:
    """Read the vertices of a binary little-endian PLY file; their other properties are ignored.

    Raises DatasetError for other formats, list properties and files that end too soon.
    """
    return _read(path, _ply_layout)


def read_pcd(path: Path) -> PointCloud:
    """Read a binary PCD file; further fields are ignored.

    Raises DatasetError for other formats and files that end too soon.
    """
    return _read(path, _pcd_layout)


def _table(cloud: PointCloud, more: Mapping[str, NDArray[Any]]) -> Table:
    columns: dict[str, NDArray[Any]] = {
        "x": cloud.xyz[:, 0],
        "y": cloud.xyz[:, 1],
        "z": cloud.xyz[:, 2],
        "intensity": cloud.intensity,
    }
    if cloud.temperature_kelvin is not None:
        columns["temperature"] = cloud.temperature_kelvin
    if cloud.thermal_counts is not None:
        columns["thermal"] = cloud.thermal_counts
    columns |= more
    table = np.empty(len(cloud.xyz), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def _with_colours(table: Table, rgb: NDArray[np.uint8]) -> Table:
    layout = [*table.dtype.descr, *((name, "u1") for name in COLOURS)]
    coloured = np.empty(len(table), dtype=layout)
    for name in table.dtype.names or ():
        coloured[name] = table[name]
    for k, name in enumerate(COLOURS):
        coloured[name] = rgb[:, k]
    return coloured


def _write(path: Path, header: Sequence[str], table: Table) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(table.tobytes())


def _read(path: Path, layout: Callable[[Path, list[list[str]]], tuple[Any, int]]) -> PointCloud:
    try:
        with path.open("rb") as file:
            dtype, count = layout(path, _header(path, file))
            data = file.read(count * dtype.itemsize)
    except OSError as error:
        raise DatasetError(f"the cloud {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise DatasetError(f"the header of {path} is damaged: {error}") from None
    if len(data) < count * dtype.itemsize:
        raise DatasetError(
            f"the cloud {path} ends after {len(data) // dtype.itemsize} of {count} points: it was "
            "cut off; write it again"
        )
    table = np.frombuffer(data, dtype=dtype)
    missing = [name for name in ("x", "y", "z") if name not in (dtype.names or ())]
    if missing:
        raise DatasetError(f"the cloud {path} has no {', '.join(missing)}: it holds no points")
    xyz = np.column_stack([table["x"], table["y"], table["z"]]).astype(np.float32)
    intensity = _column(table, "intensity")
    return PointCloud(
        xyz,
        np.zeros(count, np.float32) if intensity is None else intensity,
        _column(table, "temperature"),
        _column(table, "thermal"),
    )


def _column(table: Table, name: str) -> NDArray[np.float32] | None:
    if name not in (table.dtype.names or ()):
        return None
    return np.asarray(table[name], dtype=np.float32)


def _header(path: Path, file: BinaryIO) -> list[list[str]]:
    """Words of the header lines; leaves the file at the first byte of the points."""
    lines: list[list[str]] = []
    for _ in range(LONGEST_HEADER_LINES):
        words = file.readline(1000).decode("ascii", errors="replace").split()
        lines.append(words)
        if words[:1] in (["end_header"], ["DATA"]):
            return lines
    raise DatasetError(f"{path} has no end of header: it is no point cloud file, or cut off")


def _ply_layout(path: Path, header: list[list[str]]) -> tuple[Any, int]:
    if header[0] != ["ply"] or ["format", "binary_little_endian", "1.0"] not in header:
        raise DatasetError(f"{path} is not a binary little-endian PLY 1.0 file: convert it")
    count, fields = 0, []
    element = ""
    for words in header:
        if words[:1] == ["element"] and len(words) == 3:
            if not element and words[1] != "vertex":
                raise DatasetError(f"{path} does not begin with its vertices: convert it")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise DatasetError(
                    f"{path}: the vertex property '{' '.join(words[1:])}' is not a plain number"
                )
            fields.append((words[2], PLY_TYPES[words[1]]))
    return np.dtype(fields), count


def _pcd_layout(path: Path, header: list[list[str]]) -> tuple[Any, int]:
    entries = {words[0]: words[1:] for words in header if words}
    if entries.get("DATA") != ["binary"]:
        raise DatasetError(f"{path} is not a PCD file with 'DATA binary': convert it")
    try:
        sizes = [int(size) for size in entries["SIZE"]]
        counts = [int(number) for number in entries.get("COUNT", ["1"] * len(sizes))]
        kinds = [PCD_TYPES[kind] for kind in entries["TYPE"]]
        fields = [
            (name, f"<{kind}{size}", (number,)) if number > 1 else (name, f"<{kind}{size}")
            for name, kind, size, number in zip(
                entries["FIELDS"], kinds, sizes, counts, strict=True
            )
        ]
        return np.dtype(fields), int(entries["POINTS"][0])
    except (KeyError, ValueError, IndexError, TypeError):
        raise DatasetError(
            f"the header of {path} is damaged: FIELDS, SIZE, TYPE and POINTS are needed"
        ) from None
