"""Trajectories as text: TUM, KITTI and EuRoC.

* TUM: ``stamp x y z qx qy qz qw``, one pose a line; the stamp is in seconds with nine decimals and
  goes from and to integer nanoseconds without a float in between.
* KITTI: the upper 3x4 of ``T_world_rig``, row by row, one line for each frame.  A frame without a
  pose (LOST) is a line of twelve ``nan``, so that line i stays frame i.
* EuRoC: ``stamp_ns, x, y, z, qw, qx, qy, qz, ...``, one pose a line.

Numbers are written in the shortest form that is read back bit for bit.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.core.transforms import (
    make_transform,
    orthonormalised,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
)
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.replacing import write_text

Pose = NDArray[np.float64]

NS_PER_S = 1_000_000_000
ROTATION_TOLERANCE = 1e-3
FRAME_COLUMNS = (
    "stamp_ns",
    "status",
    "reset_counter",
    "features",
    "matches",
    "inliers",
    "rms_px",
    "scale_converged",
    "reason",
)


class TrajectoryFormat(Enum):
    """What a text file of poses may be."""

    TUM = "tum"
    KITTI = "kitti"
    EUROC = "euroc"


def sniff_format(path: Path) -> TrajectoryFormat:
    """Tell the format of a text file by its first line of numbers.

    Twelve numbers are KITTI; more than eight, or eight that begin with nanoseconds, EuRoC; eight
    TUM.  Raises EvaluationError for anything else.
    """
    for number, fields in _rows(path):
        if len(fields) == 12:
            return TrajectoryFormat.KITTI
        if len(fields) > 8 or (len(fields) == 8 and len(fields[0]) > 15 and "." not in fields[0]):
            return TrajectoryFormat.EUROC
        if len(fields) == 8:
            return TrajectoryFormat.TUM
        raise EvaluationError(
            f"{path}, line {number}, is no pose: a TUM file has 8 numbers a line, a KITTI file 12, "
            f"a EuRoC file 8 or more that begin with nanoseconds; this line has {len(fields)}"
        )
    raise EvaluationError(f"{path} holds no pose")


def format_stamp(stamp_ns: int) -> str:
    """Seconds with nine decimals.

    >>> format_stamp(1403636579763555527)
    '1403636579.763555527'
    >>> format_stamp(-5)
    '-0.000000005'
    """
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), NS_PER_S)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"


def parse_stamp(text: str) -> int:
    """Integer nanoseconds of a decimal number of seconds, exactly.

    >>> parse_stamp("1403636579.763555527")
    1403636579763555527
    >>> parse_stamp("1.403636579763555527e+09")
    1403636579763555527
    """
    return int(Decimal(text).scaleb(9).to_integral_value())


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write all poses; the file appears complete or not at all."""
    lines = ["# stamp_s x_m y_m z_m qx qy qz qw"]
    for stamp_ns, T in zip(trajectory.stamps_ns, trajectory.T_world_rig, strict=True):
        numbers = [*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])]
        lines.append(f"{format_stamp(int(stamp_ns))} {' '.join(map(_exact, numbers))}")
    write_text(path, "\n".join(lines) + "\n")


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file (blanks or commas between the numbers, ``#`` begins a comment).

    Raises EvaluationError with file and line for anything that is not eight numbers.
    """
    stamps, poses = [], []
    for number, fields in _rows(path):
        if len(fields) != 8:
            raise EvaluationError(
                f"{path}, line {number}: a TUM line has 8 numbers (stamp x y z qx qy qz qw), "
                f"this one {len(fields)}"
            )
        stamps.append(_stamp(path, number, fields[0]))
        values = _floats(path, number, fields[1:])
        poses.append(_pose(path, number, values[:3], values[3:]))
    return _trajectory(path, stamps, poses)


def write_kitti(path: Path, poses: Sequence[Pose | None]) -> None:
    """Write one line for each frame, ``nan`` twelve times where there is no pose."""
    lines = []
    for T in poses:
        numbers = np.full(12, np.nan) if T is None else T[:3].ravel()
        lines.append(" ".join(map(_exact, numbers)))
    write_text(path, "".join(f"{line}\n" for line in lines))


def read_kitti(path: Path) -> list[Pose | None]:
    """Read one pose (4, 4) for each line, None for a line of ``nan``.

    Raises EvaluationError with file and line for anything that is no rigid motion.
    """
    poses: list[Pose | None] = []
    for number, fields in _rows(path):
        if len(fields) != 12:
            raise EvaluationError(
                f"{path}, line {number}: a KITTI pose has 12 numbers (3x4, row by row), this line "
                f"{len(fields)}"
            )
        values = _floats(path, number, fields).reshape(3, 4)
        if np.all(np.isnan(values)):
            poses.append(None)
            continue
        rotation = values[:, :3]
        error = np.max(np.abs(rotation @ rotation.T - np.eye(3)))
        if not error < ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise EvaluationError(f"{path}, line {number}: the left 3x3 is not a rotation")
        poses.append(orthonormalised(make_transform(rotation, values[:, 3])))
    return poses


def kitti_trajectory(poses: Sequence[Pose | None], stamps_ns: NDArray[np.int64]) -> Trajectory:
    """Give the poses of a KITTI file the stamps (N,) of their frames; missing ones are left out.

    Raises EvaluationError when the numbers of poses and stamps differ.
    """
    if len(poses) != len(stamps_ns):
        raise EvaluationError(
            f"{len(poses)} KITTI poses do not fit {len(stamps_ns)} frames: one line is needed for "
            "each frame"
        )
    kept = [i for i, T in enumerate(poses) if T is not None]
    stacked = np.array([poses[i] for i in kept], dtype=np.float64).reshape(-1, 4, 4)
    return Trajectory(np.asarray(stamps_ns, np.int64)[kept], stacked)


def read_euroc(path: Path) -> Trajectory:
    """Read a EuRoC ground truth csv (``state_groundtruth_estimate0/data.csv`` and its like).

    The poses are those of the body the file speaks of (in EuRoC the IMU).  Raises EvaluationError
    with file and line for anything else.
    """
    stamps, poses = [], []
    for number, fields in _rows(path):
        if len(fields) < 8:
            raise EvaluationError(
                f"{path}, line {number}: a EuRoC line begins with 8 numbers (stamp_ns x y z qw qx "
                f"qy qz), this one has {len(fields)}"
            )
        if not fields[0].lstrip("-").isdecimal():
            raise EvaluationError(
                f"{path}, line {number}: '{fields[0]}' is not a whole number of nanoseconds"
            )
        stamps.append(int(fields[0]))
        values = _floats(path, number, fields[1:8])
        poses.append(_pose(path, number, values[:3], values[[4, 5, 6, 3]]))
    return _trajectory(path, stamps, poses)


class TrajectoryFiles(Observer):
    """Keeps every result and writes ``trajectory.tum``, ``trajectory_kitti.txt``, ``frames.csv``.

    ``frames.csv`` has a line for each frame, with or without a pose: stamp, status and counts.
    Once the scale has converged, poses of before are left out, as ``estimated_trajectory`` does.
    Nothing is written before ``close``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._results: list[OdometryResult] = []

    def on_result(self, result: OdometryResult) -> None:
        self._results.append(result)

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far, from the last frame of the start on."""
        return estimated_trajectory(self._results)

    @property
    def frame_stamps_ns(self) -> NDArray[np.int64]:
        """(N,) the stamps of all frames so far, also of those without a pose."""
        return np.array([result.stamp_ns for result in self._results], dtype=np.int64)

    @property
    def status_counts(self) -> dict[TrackingStatus, int]:
        """How many frames had each status."""
        statuses = [result.status for result in self._results]
        return {status: statuses.count(status) for status in TrackingStatus}

    def close(self) -> None:
        write_tum(self._folder / "trajectory.tum", self.trajectory)
        metric_only = any(result.scale_converged for result in self._results)
        poses = [
            result.T_world_rig if result.is_metric or not metric_only else None
            for result in self._results
        ]
        write_kitti(self._folder / "trajectory_kitti.txt", poses)
        write_text(self._folder / "frames.csv", self._frame_table())

    def _frame_table(self) -> str:
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(FRAME_COLUMNS)
        for result in self._results:
            stats = result.stats
            counts = (stats.features, stats.matches, stats.inliers, f"{stats.rms_px:.4f}")
            scale = "" if result.scale_converged is None else str(result.scale_converged).lower()
            reason = " ".join(result.reason.split())
            head = (result.stamp_ns, result.status.value, result.reset_counter)
            table.writerow((*head, *counts, scale, reason))
        return text.getvalue()


def read_frame_stamps(path: Path) -> NDArray[np.int64]:
    """(N,) the stamps of all frames, from the ``frames.csv`` of a run."""
    stamps = []
    for number, line in enumerate(_lines(path), start=1):
        first = line.partition(",")[0]
        if number == 1 or not first:
            continue
        if not first.lstrip("-").isdecimal():
            raise EvaluationError(f"{path}, line {number}: '{first}' is not a stamp in nanoseconds")
        stamps.append(int(first))
    return np.array(stamps, dtype=np.int64)


def _exact(value: float) -> str:
    return repr(float(value))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise EvaluationError(f"there is no file {path}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path} cannot be read as text: {error}") from None


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(_lines(path), start=1):
        fields = line.partition("#")[0].replace(",", " ").split()
        if fields:
            yield number, fields


def _floats(path: Path, number: int, fields: Sequence[str]) -> NDArray[np.float64]:
    try:
        return np.array([float(field) for field in fields])
    except ValueError as error:
        raise EvaluationError(f"{path}, line {number}: {error}") from None


def _stamp(path: Path, number: int, text: str) -> int:
    try:
        return parse_stamp(text)
    except (InvalidOperation, ValueError, OverflowError):
        raise EvaluationError(
            f"{path}, line {number}: '{text}' is not a stamp in seconds"
        ) from None


def _pose(
    path: Path, number: int, position_m: NDArray[np.float64], quat_xyzw: NDArray[np.float64]
) -> Pose:
    try:
        return make_transform(rotation_from_quat_xyzw(quat_xyzw), position_m)
    except ValueError as error:
        raise EvaluationError(f"{path}, line {number}: {error}") from None


def _trajectory(path: Path, stamps_ns: list[int], poses: list[Pose]) -> Trajectory:
    if not poses:
        raise EvaluationError(f"{path} holds no pose")
    try:
        return Trajectory(np.array(stamps_ns, dtype=np.int64), np.array(poses))
    except EvaluationError as error:
        raise EvaluationError(f"{path}: {error}") from None
