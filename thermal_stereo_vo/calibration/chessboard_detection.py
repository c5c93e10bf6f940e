"""Chessboards in thermal and visible images: either polarity, weak contrast, hot spots.

OpenCV's detectors look at locally normalised views of the counts; every corner is then proved and
placed by a fit on the counts themselves (``corner_fit``).  Where no detector sees the whole board,
because it mirrors something hot in one corner or its seams disturb them, a piece of it is taken
and grown line by line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.corner_fit import fit_corners
from thermal_stereo_vo.calibration.normalisation import local_normalisation, stretch
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardView, Detection

Array = NDArray[np.float64]
Image8 = NDArray[np.uint8]
Finder = Callable[[NDArray[np.uint8], tuple[int, int]], NDArray[np.float64] | None]

_SEARCH_WIDTH_PX = 800
_RADII_PX = (8.0, 14.0, 24.0)
_SEED = (4, 4)
_MIN_SPACING_PX = 5.0
_MAX_SIGMA_PX = 0.35
_MIN_LINE_FRACTION = 0.5
_MIN_GOOD_FRACTION = 0.6

_UNSEEN = "no chessboard seen: is the whole board in view, sharp and with contrast?"


@dataclass(frozen=True)
class Lattice:
    """Corners in rows and columns: ``pixels`` (R, C, 2), the rest (R, C)."""

    pixels: Array
    good: NDArray[np.bool_]
    sigma_px: Array
    amplitude: Array
    blur_px: Array
    noise: Array

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.good.shape[0], self.good.shape[1]

    @property
    def share(self) -> float:
        """Fraction of good corners."""
        return float(self.good.mean())


def detect_chessboard(image: NDArray[Any], target: Target) -> Detection:
    """Find the inner corners in an (H, W) image of any depth.

    Corners that are covered or have lost their contrast are left out; with less than 60 % of them
    the view is refused.
    """
    shrink = min(1.0, _SEARCH_WIDTH_PX / image.shape[1])
    small = image
    if shrink < 1.0:
        small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    views = _views(small)
    wanted = (target.rows, target.columns)
    refused = Detection(None, _UNSEEN)
    for method, corners in _whole_boards(views, target.grid, _quads):
        lattice = _fitted(image, _enlarged(corners, shrink).reshape(*wanted, 2))
        refused = _judged(_oriented(lattice, wanted), target, method)
        if refused.found:
            return replace(refused, beyond=_goes_on(image, lattice))
    seeds = [(name, seed) for name, view in views if (seed := _piece(view)) is not None]
    if not seeds:
        return refused
    pieces = [(name, _grown(image, _enlarged(seed, shrink), wanted)) for name, seed in seeds]
    for _, piece in pieces:
        if piece is not None and _is_cut(image, piece, wanted):
            return _judged(piece, target, "")
    for method, corners in _whole_boards(views, target.grid, _radon):
        lattice = _fitted(image, _enlarged(corners, shrink).reshape(*wanted, 2))
        refused = _judged(_oriented(lattice, wanted), target, method)
        if refused.found:
            return replace(refused, beyond=_goes_on(image, lattice))
    for name, piece in pieces:
        if piece is not None:
            detection = _judged(_oriented(piece, wanted), target, f"{name}, grown")
            if detection.found:
                return replace(detection, beyond=_goes_on(image, piece))
            if refused.reason == _UNSEEN:
                refused = detection
    return refused


def _views(image: NDArray[Any]) -> list[tuple[str, Image8]]:
    """Mappings to 8 bit in which detectors may see the board."""
    local = [(f"local {radius:g} px", local_normalisation(image, radius)) for radius in _RADII_PX]
    return [*local, ("plain", stretch(image))]


def _whole_boards(
    views: list[tuple[str, Image8]], grid: tuple[int, int], finder: Finder
) -> Iterator[tuple[str, Array]]:
    """(rows * columns, 2) corners of complete boards that an OpenCV detector finds."""
    local, plain = views[:-1], views[-1]
    attempts = [plain]
    for name, view in local:
        if finder is _quads:
            # It links dark squares and wants the polarity with dark outer corners.
            attempts.append((f"{name}, inverted", 255 - view))
        attempts.append((name, view))
    for name, view in attempts:
        corners = finder(view, grid)
        if corners is not None:
            yield name if finder is _quads else f"{name}, radon", corners


def _quads(view: Image8, grid: tuple[int, int]) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(view, grid, flags=flags)
    return corners.reshape(-1, 2).astype(np.float64) if found else None


def _radon(view: Image8, grid: tuple[int, int]) -> Array | None:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(view, grid, flags=flags)
    return corners.reshape(-1, 2).astype(np.float64) if found else None


def _piece(view: Image8) -> Array | None:
    """Some piece of some chessboard, (R, C, 2) pixels; fast also where there is none."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(view, _SEED, flags)
    if not found:
        return None
    return np.asarray(corners.reshape(*meta.shape[:2], 2), dtype=np.float64)


def _enlarged(pixels: Array, shrink: float) -> Array:
    return (pixels + 0.5) / shrink - 0.5


def _edges(pixels: Array) -> Array:
    """(R, C, 2, 2) vectors to the next corner along the row and along the column."""
    return np.stack([np.gradient(pixels, axis=1), np.gradient(pixels, axis=0)], axis=2)


def _fitted(image: NDArray[Any], pixels: Array) -> Lattice:
    """Fit every corner of an (R, C, 2) lattice of first guesses."""
    shape = pixels.shape[:2]
    fit = fit_corners(image, pixels.reshape(-1, 2), _edges(pixels).reshape(-1, 2, 2), convex=False)
    amplitude, sigma_px = fit.amplitude.reshape(shape), fit.sigma_px.reshape(shape)
    good = (fit.good & (fit.sigma_px < _MAX_SIGMA_PX)).reshape(shape)
    if good.any():
        # Light and dark squares alternate, hence so do the signs of the crossings.
        parity = np.add.outer(np.arange(shape[0]), np.arange(shape[1])) % 2 * 2 - 1
        sign = np.sign(amplitude) * parity
        good &= sign == np.sign(sign[good].sum())
    if good.any():
        good &= sigma_px < 6.0 * np.median(sigma_px[good])
    return Lattice(
        pixels=np.where(good[:, :, None], fit.pixels.reshape(*shape, 2), pixels),
        good=good,
        sigma_px=sigma_px,
        amplitude=amplitude,
        blur_px=fit.blur_px.reshape(shape),
        noise=fit.noise.reshape(shape),
    )


def _judged(lattice: Lattice, target: Target, method: str) -> Detection:
    wanted = (target.rows, target.columns)
    if lattice.shape != wanted:
        rows, columns = lattice.shape
        return Detection(
            None,
            f"partial view: {columns}x{rows} inner corners seen where the board has "
            f"{wanted[1]}x{wanted[0]} (if every view says so, the board size given is wrong)",
        )
    spacing_px = float(np.linalg.norm(_edges(lattice.pixels), axis=3).min())
    if spacing_px < _MIN_SPACING_PX:
        return Detection(
            None, f"squares of {spacing_px:.1f} px are too small: bring the board nearer"
        )
    if lattice.share < _MIN_GOOD_FRACTION:
        lost = int((~lattice.good).sum())
        return Detection(
            None,
            f"{lost} of {target.count} corners are no sharp crossings of two edges: blurred, "
            "covered, or the board mirrors something hot",
        )
    good = lattice.good
    view = BoardView(
        ids=np.flatnonzero(good.ravel()),
        pixels=lattice.pixels[good],
        sigma_px=lattice.sigma_px[good],
        blur_px=float(np.median(lattice.blur_px[good])),
        contrast=float(np.median(2.0 * np.abs(lattice.amplitude[good]) / lattice.noise[good])),
    )
    return Detection(view, method=method)


def _grown(image: NDArray[Any], seed: Array, wanted: tuple[int, int]) -> Lattice | None:
    """Fit a piece of the board and add the best-proved line of corners again and again.

    Ends with as many lines as the board has, or where no side can be continued.
    """
    lattice = _fitted(image, seed)
    if lattice.share < _MIN_GOOD_FRACTION:
        return None
    for _ in range(sum(wanted)):
        if lattice.shape in (wanted, wanted[::-1]):
            break
        best, proved = None, _MIN_LINE_FRACTION
        for side in range(4):
            # Turn the lattice so that the side becomes the right one.
            pixels, good = np.rot90(lattice.pixels, side), np.rot90(lattice.good, side)
            line = _next_line(pixels, good)
            if line is None or not _fits(pixels.shape[1] + 1, pixels.shape[0], wanted):
                continue
            ahead = np.concatenate([pixels[:, -2:], line[:, None]], axis=1)
            share = float(_fitted(image, ahead).good[:, -1].mean())
            if share >= proved:
                whole = np.concatenate([pixels, line[:, None]], axis=1)
                best, proved = np.rot90(whole, -side), share + 1e-9
        if best is None:
            break
        lattice = _fitted(image, best)
    return lattice


def _goes_on(image: NDArray[Any], lattice: Lattice) -> bool:
    """Whether one more line of corners follows on some side: a larger board than was said."""
    for side in range(4):
        pixels, good = np.rot90(lattice.pixels, side), np.rot90(lattice.good, side)
        line = _next_line(pixels, good)
        if line is None:
            continue
        ahead = _fitted(image, np.concatenate([pixels[:, -2:], line[:, None]], axis=1))
        strength = np.abs(ahead.amplitude)
        as_strong = strength[:, -1] > 0.6 * strength[:, -2]
        if (ahead.good[:, -1] & as_strong).mean() > 0.8:
            return True
    return False


def _is_cut(image: NDArray[Any], lattice: Lattice, wanted: tuple[int, int]) -> bool:
    """Whether a piece of a board goes on beyond the image border."""
    if lattice.shape in (wanted, wanted[::-1]) or lattice.share < 0.9:
        return False
    height, width = image.shape
    for side in range(4):
        pixels, good = np.rot90(lattice.pixels, side), np.rot90(lattice.good, side)
        if not _fits(pixels.shape[1] + 1, pixels.shape[0], wanted):
            continue
        line = _next_line(pixels, good)
        if line is not None:
            outside = (line < 2.0).any(1) | (line > (width - 3.0, height - 3.0)).any(1)
            if outside.mean() > 0.4:
                return True
    return False


def _fits(longer: int, other: int, wanted: tuple[int, int]) -> bool:
    """Whether so many lines still fit on the board, lying or standing."""
    return any(longer <= a and other <= b for a, b in (wanted, wanted[::-1]))


def _next_line(pixels: Array, good: NDArray[np.bool_]) -> Array | None:
    """(R, 2) where the column after the last one should be, by a homography of the last three."""
    rows, columns = good.shape
    first = max(0, columns - 3)
    row, column = np.nonzero(good[:, first:])
    if len(set(row)) < 2 or len(set(column)) < 2 or len(row) < 6:
        return None
    board = np.stack([column + first, row], axis=1).astype(np.float64)
    homography, _ = cv2.findHomography(board, pixels[row, column + first])
    if homography is None:
        return None
    ahead = np.stack([np.full(rows, float(columns)), np.arange(rows, dtype=np.float64)], axis=1)
    return np.asarray(cv2.perspectiveTransform(ahead[:, None], homography)[:, 0])


def _oriented(lattice: Lattice, wanted: tuple[int, int]) -> Lattice:
    """Rows and columns as in the target, board z away from the viewer, rows to the right.

    A chessboard in a thermal image looks the same after half a turn, since either shade may be the
    warm one: a stereo pair has to settle that together.
    """
    right, down = np.moveaxis(_edges(lattice.pixels).mean((0, 1)), 0, 0)
    upright = right[0] * down[1] - right[1] * down[0] > 0.0

    def arranged(array: NDArray[Any], turn: int) -> NDArray[Any]:
        return np.rot90(array if upright else array[::-1], turn)

    turns = [turn for turn in range(4) if arranged(lattice.good, turn).shape == wanted]
    if turns:
        rightward = [_edges(arranged(lattice.pixels, turn)).mean((0, 1))[0, 0] for turn in turns]
        turn = turns[int(np.argmax(rightward))]
    else:
        turn = 0
    return Lattice(
        **{
            name: np.ascontiguousarray(arranged(getattr(lattice, name), turn))
            for name in Lattice.__dataclass_fields__
        }
    )
