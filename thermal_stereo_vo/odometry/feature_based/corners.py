"""Places whose patch can be aligned in both directions (Shi & Tomasi, CVPR 1994)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting


@dataclass(frozen=True)
class CornerConfig:
    """How many corners a keyframe gets, and how they spread."""

    points: int = setting(400, "Points a keyframe is filled up to.", minimum=50, maximum=5000)
    cell_px: int = setting(
        40, "Side of the cells that share the points.", unit="px", minimum=8, maximum=500
    )
    block_px: int = setting(
        7, "Side of the window of the structure tensor.", unit="px", minimum=3, maximum=31
    )


def find_corners(
    image: NDArray[np.float32],
    occupied_px: NDArray[np.floating],
    border_px: int,
    mask: NDArray[np.bool_] | None,
    config: CornerConfig,
) -> NDArray[np.int64]:
    """(N, 2) corners, strongest first within each cell, in cells that are not yet full.

    ``image`` (H, W) float32; ``occupied_px`` (M, 2) points already tracked, which fill their cells
    and keep new ones at a distance.  There is no threshold: contrast changes with weather and one
    hot object outshines a street; what is only noise fails to match the other eye.
    """
    strength = cv2.cornerMinEigenVal(image, config.block_px, ksize=3)
    height, width = image.shape
    rows, columns = -(-height // config.cell_px), -(-width // config.cell_px)
    per_cell = max(1, round(config.points / (rows * columns)))
    everywhere = np.ones((1, 1), np.bool_)
    everywhere.flags.writeable = False
    corners: NDArray[np.int64] = pick_corners(
        strength,
        np.ascontiguousarray(occupied_px, dtype=np.float64).reshape(-1, 2),
        everywhere if mask is None else mask,
        config.cell_px,
        per_cell,
        border_px,
    )
    return corners


@njit(cache=True, nogil=True)
def pick_corners(  # type: ignore[no-untyped-def]
    strength, occupied, mask, cell_px, per_cell, border
):
    """Local maxima of ``strength`` (H, W), at most ``per_cell`` a cell minus those occupied."""
    height, width = strength.shape
    rows = (height + cell_px - 1) // cell_px
    columns = (width + cell_px - 1) // cell_px
    room = np.full(rows * columns, per_cell, np.int64)
    taken = np.zeros((height, width), np.bool_)
    gap = max(cell_px // 5, 3)
    for n in range(len(occupied)):
        x, y = int(occupied[n, 0] + 0.5), int(occupied[n, 1] + 0.5)
        if not (0 <= x < width and 0 <= y < height):
            continue
        room[y // cell_px * columns + x // cell_px] -= 1
        taken[max(y - gap, 0) : y + gap + 1, max(x - gap, 0) : x + gap + 1] = True
    masked = mask.size > 1
    found = np.empty((rows * columns * per_cell, 2), np.int64)
    total = 0
    for r in range(rows):
        for c in range(columns):
            for _ in range(max(room[r * columns + c], 0)):
                best, bx, by = np.float32(0.0), -1, -1
                for y in range(max(r * cell_px, border), min((r + 1) * cell_px, height - border)):
                    line = strength[y]
                    for x in range(
                        max(c * cell_px, border), min((c + 1) * cell_px, width - border)
                    ):
                        if line[x] > best and not taken[y, x] and (not masked or mask[y, x]):
                            best, bx, by = line[x], x, y
                if bx < 0:
                    break
                found[total, 0], found[total, 1] = bx, by
                total += 1
                taken[max(by - gap, 0) : by + gap + 1, max(bx - gap, 0) : bx + gap + 1] = True
    return found[:total].copy()


def pick_corners_reference(
    strength: NDArray[np.float32],
    occupied: NDArray[np.float64],
    mask: NDArray[np.bool_],
    cell_px: int,
    per_cell: int,
    border: int,
) -> NDArray[np.int64]:
    """The plain numpy form of ``pick_corners``: sort each cell, take what is not too near."""
    height, width = strength.shape
    gap = max(cell_px // 5, 3)
    near = (occupied + 0.5).astype(int).tolist()
    taken = [(x, y) for x, y in near if 0 <= x < width and 0 <= y < height]
    held = [(x // cell_px, y // cell_px) for x, y in taken]
    allowed = (strength > 0.0) & mask
    allowed[:border] = allowed[height - border :] = False
    allowed[:, :border] = allowed[:, width - border :] = False
    found: list[tuple[int, int]] = []
    for r in range(-(-height // cell_px)):
        for c in range(-(-width // cell_px)):
            ys, xs = np.nonzero(
                allowed[r * cell_px : (r + 1) * cell_px, c * cell_px : (c + 1) * cell_px]
            )
            ys, xs = ys + r * cell_px, xs + c * cell_px
            room = per_cell - held.count((c, r))
            for i in np.argsort(-strength[ys, xs], kind="stable"):
                if room <= 0:
                    break
                x, y = int(xs[i]), int(ys[i])
                if all(max(abs(x - a), abs(y - b)) > gap for a, b in taken):
                    found.append((x, y))
                    taken.append((x, y))
                    room -= 1
    return np.array(found, np.int64).reshape(-1, 2)
