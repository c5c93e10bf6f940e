"""Mask boards: square holes before a warm (or cold) panel, an orientation mark beside the first.

The board of Vidas et al. (A mask-based approach for the geometric calibration of thermal-infrared
cameras, IEEE TIM 2012).  The holes form a lattice; the small triangular hole beyond one corner of
it says which hole is the first, so that every corner has an absolute number: views that the image
border cuts stay useful, and left and right agree without guessing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.corner_fit import fit_corners
from thermal_stereo_vo.calibration.normalisation import local_normalisation
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardView, Detection

Array = NDArray[np.float64]

_SEARCH_WIDTH_PX = 800
_RADII_PX = (12.0, 24.0, 48.0)
_LEVELS = (148, 108)
_MIN_SIDE_PX = 7.0
_MIN_HOLES_FRACTION = 0.5
_MAX_SIGMA_PX = 0.35
_MARK_AREA = (0.02, 0.7)
_MARK_CONTRAST = 0.25
_UNSEEN = "no mask board seen: is it in view, sharp, and warmer or colder than its holes?"


@dataclass(frozen=True)
class Holes:
    """Square holes: ``corners`` (N, 4, 2) clockwise in the image, and small blobs (M, 2) + area."""

    corners: Array
    blobs: Array
    blob_areas: Array

    @property
    def centres(self) -> Array:
        """(N, 2)."""
        return np.asarray(self.corners.mean(1))


@dataclass(frozen=True)
class HoleLattice:
    """Holes with lattice coordinates.

    ``cells`` (N, 2) int (column, row) from 0, with x to y turning clockwise in the image (board z
    away from the viewer).  ``corners`` (N, 4, 2) run top left, top right, bottom right, bottom left
    in those axes.
    """

    cells: NDArray[np.int64]
    corners: Array

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        columns, rows = self.cells.max(0) + 1
        return int(columns), int(rows)

    def turned(self) -> HoleLattice:
        """The same holes with the axes turned by a quarter: x becomes what y was, reversed y x."""
        columns, _ = self.size
        x, y = self.cells.T
        cells = np.stack([y, columns - 1 - x], axis=1)
        return HoleLattice(cells, np.roll(self.corners, -1, axis=1))


def detect_mask(image: NDArray[Any], target: Target) -> Detection:
    """Find the holes of a mask board in an (H, W) image of any depth, and number their corners."""
    shrink = min(1.0, _SEARCH_WIDTH_PX / image.shape[1])
    small = image
    if shrink < 1.0:
        small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    refused, most = Detection(None, _UNSEEN), 0
    for radius_px in _RADII_PX:
        even = local_normalisation(small, radius_px)
        for level in _LEVELS:
            holes = _holes(even, level)
            lattice = _lattice(holes, target)
            if lattice is None:
                continue
            method = f"local {radius_px:g} px, level {level}"
            marks = _marks(small, holes, lattice)
            detection = _numbered(image, marks, lattice, target, shrink, method)
            if detection.found:
                return detection
            if len(lattice.cells) > most:
                refused, most = detection, len(lattice.cells)
    return refused


def _holes(view: NDArray[np.uint8], level: int) -> Holes:
    """Convex quadrilaterals of about square shape, and smaller blobs that may be the mark.

    Contours run around bright and around dark regions alike, so either may be the warm side.
    """
    _, binary = cv2.threshold(view, level, 255, cv2.THRESH_BINARY)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    height, width = view.shape
    quads, blobs, areas = [], [], []
    for contour in contours:
        area = cv2.contourArea(contour)
        if area < 0.1 * _MIN_SIDE_PX**2 or area > 0.05 * width * height:
            continue
        moments = cv2.moments(contour)
        blobs.append((moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]))
        areas.append(area)
        x, y, w, h = cv2.boundingRect(contour)
        if x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= height - 1:
            continue  # cut by the border: its corners are not the hole's
        quad = _quadrilateral(contour, area)
        if quad is not None:
            quads.append(quad)
    return Holes(
        np.array(quads, dtype=np.float64).reshape(-1, 4, 2),
        np.array(blobs, dtype=np.float64).reshape(-1, 2),
        np.array(areas, dtype=np.float64),
    )


def _quadrilateral(contour: NDArray[np.int32], area: float) -> Array | None:
    """(4, 2) corners clockwise in the image, or None when the blob is no foreshortened square."""
    hull = cv2.convexHull(contour)
    perimeter = cv2.arcLength(hull, True)
    for tolerance in (0.05, 0.08, 0.11):
        polygon = cv2.approxPolyDP(hull, tolerance * perimeter, True)
        if len(polygon) <= 4:
            break
    if len(polygon) != 4 or not cv2.isContourConvex(polygon):
        return None
    quad = polygon.reshape(4, 2).astype(np.float64)
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    if sides.min() < _MIN_SIDE_PX or sides.max() > 3.0 * sides.min():
        return None
    if area < 0.8 * cv2.contourArea(hull) or area < 0.75 * cv2.contourArea(polygon):
        return None
    (ax, ay), (bx, by) = quad[1] - quad[0], quad[2] - quad[1]
    return np.asarray(quad if ax * by - ay * bx > 0.0 else quad[::-1].copy())


def _lattice(holes: Holes, target: Target) -> HoleLattice | None:
    """The largest set of holes that are neighbours of each other at the board's pitch."""
    count = len(holes.corners)
    wanted = target.columns * target.rows
    if count < _MIN_HOLES_FRACTION * wanted:
        return None
    centres = holes.centres
    step = target.pitch_m / target.spacing_m
    # Columns: where the right and the lower neighbour should be, from the hole's own sides.
    best: HoleLattice | None = None
    done: set[int] = set()
    for start in range(count):
        if start in done:
            continue
        cells = {start: (0, 0)}
        corners = {start: holes.corners[start]}
        queue = [start]
        while queue:
            current = queue.pop()
            quad = corners[current]
            across = 0.5 * (quad[1] - quad[0] + quad[2] - quad[3]) * step
            down = 0.5 * (quad[3] - quad[0] + quad[2] - quad[1]) * step
            tolerance = 0.3 * min(np.linalg.norm(across), np.linalg.norm(down))
            for (dx, dy), offset in (
                ((1, 0), across),
                ((-1, 0), -across),
                ((0, 1), down),
                ((0, -1), -down),
            ):
                distance = np.linalg.norm(centres - (centres[current] + offset), axis=1)
                other = int(np.argmin(distance))
                if distance[other] > tolerance or other in cells:
                    continue
                cells[other] = (cells[current][0] + dx, cells[current][1] + dy)
                corners[other] = _aligned(holes.corners[other], across, down)
                queue.append(other)
        done |= set(cells)
        if best is None or len(cells) > len(best.cells):
            members = sorted(cells)
            grid = np.array([cells[m] for m in members])
            best = HoleLattice(grid - grid.min(0), np.array([corners[m] for m in members]))
    if best is None or len(best.cells) < _MIN_HOLES_FRACTION * wanted:
        return None
    if len(np.unique(best.cells, axis=0)) < len(best.cells):
        return None
    return best


def _aligned(quad: Array, across: Array, down: Array) -> Array:
    """Start a clockwise quadrilateral at its top left corner as the neighbour sees it."""
    diagonal = across / np.linalg.norm(across) + down / np.linalg.norm(down)
    towards = (quad - quad.mean(0)) @ diagonal
    return np.roll(quad, -int(np.argmin(towards)), axis=0)


def _marks(image: NDArray[Any], holes: Holes, lattice: HoleLattice) -> Holes:
    """The holes with only those small blobs that are about as warm as the holes."""
    counts = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)

    def at(pixels: Array) -> Array:
        x = np.clip(np.rint(pixels[:, 0]).astype(int), 0, image.shape[1] - 1)
        y = np.clip(np.rint(pixels[:, 1]).astype(int), 0, image.shape[0] - 1)
        return np.asarray(counts[y, x], dtype=np.float64)

    centres = lattice.corners.mean(1)
    # Half a pitch beyond the middle of a side lies the mask itself.
    gaps = np.concatenate(
        [
            2.0 * (c[[0, 1]].mean(0, keepdims=True)) - m[None]
            for c, m in zip(lattice.corners, centres, strict=True)
        ]
    )
    inside, mask = float(np.median(at(centres))), float(np.median(at(gaps)))
    step = inside - mask
    if len(holes.blobs) == 0 or step == 0.0:
        return holes
    alike = (at(holes.blobs) - mask) / step > _MARK_CONTRAST
    return Holes(holes.corners, holes.blobs[alike], holes.blob_areas[alike])


def _numbered(
    image: NDArray[Any],
    holes: Holes,
    lattice: HoleLattice,
    target: Target,
    shrink: float,
    method: str,
) -> Detection:
    """Find the mark, number the holes from it, and fit their corners on the counts."""
    wanted = (target.columns, target.rows)
    columns, rows = lattice.size
    if max(columns, rows) > max(wanted) or min(columns, rows) > min(wanted):
        return Detection(
            None,
            f"{columns}x{rows} holes seen where the board has {wanted[0]}x{wanted[1]}: wrong board "
            "size given?",
        )
    candidates = []
    turned = lattice
    for _ in range(4):
        if turned.size[0] <= wanted[0] and turned.size[1] <= wanted[1]:
            candidates.append((_mark_distance(holes, turned), turned))
        turned = turned.turned()
    candidates.sort(key=lambda item: item[0])
    if not candidates or candidates[0][0] > 1.0:
        if _mirrored(holes, lattice, wanted):
            return Detection(
                None, "the image is mirrored: switch off the camera's mirror (revert) setting"
            )
        return Detection(
            None, "the orientation mark (the cut corner beside the first hole) is not in view"
        )
    chosen = candidates[0][1]
    if len(chosen.cells) < _MIN_HOLES_FRACTION * wanted[0] * wanted[1]:
        return Detection(
            None,
            f"partial view: {len(chosen.cells)} of {wanted[0] * wanted[1]} holes seen complete",
        )
    return _fitted(image, chosen, target, shrink, method)


def _mark_distance(holes: Holes, lattice: HoleLattice) -> float:
    """How badly the best small blob fits as the mark before the first hole; below 1 it does.

    Its centre should lie about (-0.5, -0.5) sides outside the first hole, generously: marks are cut
    by hand, and by the image border.
    """
    first = np.flatnonzero((lattice.cells == 0).all(1))
    if len(first) == 0 or len(holes.blobs) == 0:
        return np.inf
    quad = lattice.corners[first[0]]
    across = 0.5 * (quad[1] - quad[0] + quad[2] - quad[3])
    down = 0.5 * (quad[3] - quad[0] + quad[2] - quad[1])
    sides = np.stack([across, down], axis=1)
    area = abs(np.linalg.det(sides))
    local = np.linalg.solve(sides, (holes.blobs - quad[0]).T).T
    apart = np.linalg.norm(local - (-0.5, -0.5), axis=1) / 0.7
    relative = holes.blob_areas / area
    apart[(relative < _MARK_AREA[0]) | (relative > _MARK_AREA[1])] = np.inf
    return float(apart.min())


def _mirrored(holes: Holes, lattice: HoleLattice, wanted: tuple[int, int]) -> bool:
    """Whether the mark sits where only a mirrored image would show it."""
    if set(lattice.size) != set(wanted):
        return False
    turned = lattice
    for _ in range(4):
        if turned.size == wanted[::-1] and _mark_distance(holes, turned) < 1.0:
            return True
        turned = turned.turned()
    return False


def _fitted(
    image: NDArray[Any], lattice: HoleLattice, target: Target, shrink: float, method: str
) -> Detection:
    quads = (lattice.corners + 0.5) / shrink - 0.5
    ahead = np.roll(quads, -1, axis=1) - quads
    behind = np.roll(quads, 1, axis=1) - quads
    # Corners run clockwise: the first edge of corner k leads to k + 1, the second back to k - 1.
    edges = np.stack([ahead, behind], axis=2)
    reach = 0.5 * min(1.0, target.pitch_m / target.spacing_m - 1.0) * 0.85
    fit = fit_corners(
        image, quads.reshape(-1, 2), edges.reshape(-1, 2, 2), convex=True, reach=reach
    )
    # The corner (column, row) within its hole, in the order top left, top right, ...
    column = 2 * lattice.cells[:, :1] + (0, 1, 1, 0)
    row = 2 * lattice.cells[:, 1:] + (0, 0, 1, 1)
    ids = (row * 2 * target.columns + column).ravel()
    good = fit.good & (fit.sigma_px < _MAX_SIGMA_PX)
    if good.any():
        good &= np.sign(fit.amplitude) == np.sign(np.median(fit.amplitude[good]))
        good &= fit.sigma_px < 6.0 * np.median(fit.sigma_px[good])
    if good.sum() < _MIN_HOLES_FRACTION * target.count:
        return Detection(
            None, f"only {int(good.sum())} of {target.count} hole corners are sharp enough"
        )
    order = np.argsort(ids[good])
    return Detection(
        BoardView(
            ids=ids[good][order],
            pixels=fit.pixels[good][order],
            sigma_px=fit.sigma_px[good][order],
            blur_px=float(np.median(fit.blur_px[good])),
            contrast=float(np.median(4.0 * np.abs(fit.amplitude[good]) / fit.noise[good])),
        ),
        method=method,
    )
