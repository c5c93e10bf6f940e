"""Grids of dots: heated pads, holes, painted discs; bright or dark."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.normalisation import local_normalisation, noise_counts, stretch
from thermal_stereo_vo.calibration.targets import Target, TargetKind
from thermal_stereo_vo.calibration.views import BoardView, Detection

_BEND = 0.2
_MIN_CONTRAST = 2.0
_CENTRE_SIGMA_PX = 0.1
"""What blob centres are worth; the perspective shift of a disc's centre is not corrected."""


def detect_circles(image: NDArray[Any], target: Target) -> Detection:
    """Find all dots of a symmetric or asymmetric grid in an (H, W) image of any depth."""
    asymmetric = target.kind is TargetKind.ASYMMETRIC_CIRCLES
    flags = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    # Clustering forgives clutter and perspective, but only works for evenly spaced dots.
    attempts = [flags, flags | cv2.CALIB_CB_CLUSTERING]
    detector = _blob_detector(image.shape)
    views = [("plain", stretch(image)), ("local 24 px", local_normalisation(image, 24.0))]
    for name, view in views:
        for polarity, shown in (("dark", view), ("bright", 255 - view)):
            for attempt in attempts:
                found, centres = cv2.findCirclesGrid(
                    shown, target.grid, flags=attempt, blobDetector=detector
                )
                if not found:
                    continue
                pixels = centres.reshape(-1, 2).astype(np.float64)
                if _is_grid(pixels, target) and _stands_out(image, pixels, target):
                    if not asymmetric:
                        pixels = _canonical(pixels, target.grid)
                    return Detection(
                        BoardView(
                            ids=np.arange(target.count),
                            pixels=pixels,
                            sigma_px=np.full(target.count, _CENTRE_SIGMA_PX),
                        ),
                        method=f"{polarity} dots, {name}",
                    )
    return Detection(None, "no grid of dots seen: is the whole board in view and sharp?")


def _blob_detector(shape: tuple[int, ...]) -> Any:
    parameters = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    parameters.minArea = 12.0
    parameters.maxArea = 0.02 * shape[0] * shape[1]
    parameters.minDistBetweenBlobs = 4.0
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 20, 235, 10
    return cv2.SimpleBlobDetector_create(parameters)  # type: ignore[attr-defined]


def _is_grid(pixels: NDArray[np.float64], target: Target) -> bool:
    """Whether (count, 2) centres are a flat grid seen in perspective, as specks of noise are not.

    A distorting lens bends a grid by less than the tolerance, a fifth of the pitch.
    """
    homography, _ = cv2.findHomography(target.points_m[:, :2], pixels)
    if homography is None:
        return False
    ideal = cv2.perspectiveTransform(target.points_m[:, None, :2], homography)[:, 0]
    return bool(np.linalg.norm(ideal - pixels, axis=1).max() < _BEND * _pitch_px(pixels))


def _stands_out(image: NDArray[Any], pixels: NDArray[np.float64], target: Target) -> bool:
    """Whether all dots are brighter, or all darker, than the gaps between them."""
    raw = image.astype(np.float32)
    # Without the wide blur a hot spot would be brighter than dots elsewhere.
    counts = cv2.GaussianBlur(raw, (0, 0), 1.0) - cv2.GaussianBlur(raw, (0, 0), _pitch_px(pixels))
    rows = pixels.reshape(target.rows, target.columns, 2)
    if target.kind is TargetKind.ASYMMETRIC_CIRCLES:
        gaps = 0.5 * (rows[:, 1:] + rows[:, :-1])
    else:
        gaps = 0.25 * (rows[1:, 1:] + rows[1:, :-1] + rows[:-1, 1:] + rows[:-1, :-1])
    between = float(np.median(_values(counts, gaps.reshape(-1, 2))))
    step = _values(counts, pixels) - between
    return bool(np.abs(np.sign(step).sum()) == len(step)) and bool(
        np.median(np.abs(step)) > _MIN_CONTRAST * noise_counts(image)
    )


def _pitch_px(pixels: NDArray[np.float64]) -> float:
    """Median distance of a dot to its nearest neighbour."""
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(1)))


def _values(counts: NDArray[np.float32], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    height, width = counts.shape
    x = np.clip(np.rint(pixels[:, 0]).astype(int), 0, width - 1)
    y = np.clip(np.rint(pixels[:, 1]).astype(int), 0, height - 1)
    return np.asarray(counts[y, x], dtype=np.float64)


def _canonical(pixels: NDArray[np.float64], grid: tuple[int, int]) -> NDArray[np.float64]:
    """Board z away from the viewer, rows running to the right in the image."""
    columns, rows = grid
    lattice = pixels.reshape(rows, columns, 2)
    right = np.diff(lattice, axis=1).mean((0, 1))
    down = np.diff(lattice, axis=0).mean((0, 1))
    if right[0] * down[1] - right[1] * down[0] < 0.0:
        lattice = lattice[::-1]
    if right[0] < 0.0:
        lattice = lattice[::-1, ::-1]
    return np.ascontiguousarray(lattice).reshape(-1, 2)
