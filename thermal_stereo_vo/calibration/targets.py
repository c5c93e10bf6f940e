"""Calibration boards: where their points lie, and what their surface looks like.

Board axes: x along a row, y along a column, z through the board away from the viewer; the first
point is the origin.  ``Target.marked`` tells the two surface materials apart, so that a simulator
draws exactly the board that the detectors look for.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError


class TargetKind(Enum):
    """Families of boards."""

    CHESSBOARD = "chessboard"
    MASK = "mask"
    CIRCLES = "circles"
    ASYMMETRIC_CIRCLES = "acircles"


_SPEC = re.compile(r"(?P<kind>[a-z]+):(?P<columns>\d+)x(?P<rows>\d+):(?P<sizes>[0-9.eE+:-]+)")
_EXAMPLES = (
    "chessboard:9x6:0.04 (inner corners, square in m), mask:6x4:0.04[:0.08] (square holes, side "
    "and pitch in m), circles:4x3:0.09 (dots, pitch in m) or acircles:4x11:0.02"
)


@dataclass(frozen=True)
class Target:
    """A flat board.

    ``columns`` x ``rows`` counts inner corners of a chessboard, square holes of a mask, dots of a
    circle grid.  ``spacing_m`` is the side of a chessboard square or of a mask hole, or the
    distance of neighbouring dots (for asymmetric grids OpenCV's diagonal half-pitch).
    ``pitch_m`` is the distance of neighbouring mask holes, twice the side when not given (the mask
    of Vidas et al.: its corners form one regular lattice).
    """

    kind: TargetKind
    columns: int
    rows: int
    spacing_m: float
    pitch_m: float = 0.0

    def __post_init__(self) -> None:
        if self.columns < 2 or self.rows < 2 or self.columns * self.rows < 6:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} points is too small: use at least 3x2"
            )
        if not (np.isfinite(self.spacing_m) and 1e-3 <= self.spacing_m <= 2.0):
            raise CalibrationError(
                f"the board spacing {self.spacing_m} m must lie between 0.001 and 2 m: "
                "give it in metres"
            )
        if self.kind is TargetKind.MASK:
            pitch_m = self.pitch_m or 2.0 * self.spacing_m
            if not 1.2 * self.spacing_m <= pitch_m <= 5.0 * self.spacing_m:
                raise CalibrationError(
                    f"the mask pitch {pitch_m} m does not fit holes of {self.spacing_m} m: "
                    "the pitch is the distance between the centres of neighbouring holes"
                )
            object.__setattr__(self, "pitch_m", pitch_m)

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the point lattice; a mask has 2 x 2 corners a hole."""
        if self.kind is TargetKind.MASK:
            return 2 * self.columns, 2 * self.rows
        return self.columns, self.rows

    @property
    def count(self) -> int:
        """Number of points."""
        columns, rows = self.grid
        return columns * rows

    @property
    def points_m(self) -> NDArray[np.float64]:
        """(count, 3) points row by row, z = 0."""
        columns, rows = self.grid
        j, i = np.mgrid[:rows, :columns].astype(np.float64)
        if self.kind is TargetKind.MASK:
            x = (i // 2) * self.pitch_m + (i % 2) * self.spacing_m
            y = (j // 2) * self.pitch_m + (j % 2) * self.spacing_m
        elif self.kind is TargetKind.ASYMMETRIC_CIRCLES:
            x, y = (2 * i + j % 2) * self.spacing_m, j * self.spacing_m
        else:
            x, y = i * self.spacing_m, j * self.spacing_m
        return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    @property
    def outline_m(self) -> NDArray[np.float64]:
        """(4, 2) corners of the patterned area with its usual border, clockwise in board axes."""
        low, high = self.points_m.min(0)[:2], self.points_m.max(0)[:2]
        border = self.pitch_m if self.kind is TargetKind.MASK else 1.5 * self.spacing_m
        (x0, y0), (x1, y1) = low - border, high + border
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    def marked(self, xy_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which material the board shows at board coordinates (..., 2).

        True on the coated squares of a chessboard (the one left above the first corner is coated),
        in the holes of a mask with its orientation mark, and on dots.
        """
        x, y = np.moveaxis(np.asarray(xy_m, dtype=np.float64), -1, 0)
        if self.kind is TargetKind.CHESSBOARD:
            i, j = np.floor(x / self.spacing_m), np.floor(y / self.spacing_m)
            inside = (i >= -1) & (i < self.columns) & (j >= -1) & (j < self.rows)
            return np.asarray(inside & ((i + j) % 2 == 0))
        if self.kind is TargetKind.MASK:
            i, j = np.floor(x / self.pitch_m), np.floor(y / self.pitch_m)
            inside = (i >= 0) & (i < self.columns) & (j >= 0) & (j < self.rows)
            hole = (x - i * self.pitch_m < self.spacing_m) & (y - j * self.pitch_m < self.spacing_m)
            return np.asarray((inside & hole) | self._orientation_mark(x, y))
        radius_m = 0.3 * self.spacing_m * (np.sqrt(2) if self._asymmetric else 1.0)
        centres = self.points_m[:, :2]
        near = np.full(x.shape, np.inf)
        for cx, cy in centres:
            np.minimum(near, (x - cx) ** 2 + (y - cy) ** 2, out=near)
        return np.asarray(near < radius_m**2)

    @property
    def _asymmetric(self) -> bool:
        return self.kind is TargetKind.ASYMMETRIC_CIRCLES

    def _orientation_mark(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """A right-angled triangular hole beyond the first hole, its right angle towards it."""
        leg_m = 0.7 * self.spacing_m
        corner_m = -0.2 * self.spacing_m
        u, v = corner_m - x, corner_m - y
        return np.asarray((u > 0) & (v > 0) & (u + v < leg_m))

    def __str__(self) -> str:
        pitch = f":{self.pitch_m:g}" if self.kind is TargetKind.MASK else ""
        return f"{self.kind.value}:{self.columns}x{self.rows}:{self.spacing_m:g}{pitch}"


def parse_target(text: str) -> Target:
    """Read a board from text such as ``chessboard:9x6:0.04``.

    Raises CalibrationError that shows how boards are written.

    >>> parse_target("mask:6x4:0.04").count
    96
    """
    match = _SPEC.fullmatch(text.strip())
    kinds = {kind.value: kind for kind in TargetKind}
    if match is None or match["kind"] not in kinds:
        raise CalibrationError(f"'{text}' is not a board: write {_EXAMPLES}")
    kind = kinds[match["kind"]]
    try:
        sizes = [float(size) for size in match["sizes"].split(":")]
    except ValueError:
        raise CalibrationError(f"'{text}' is not a board: write {_EXAMPLES}") from None
    if len(sizes) > (2 if kind is TargetKind.MASK else 1):
        raise CalibrationError(f"'{text}' has a size too many: write {_EXAMPLES}")
    return Target(kind, int(match["columns"]), int(match["rows"]), *sizes)
