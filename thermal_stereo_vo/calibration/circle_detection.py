"""Grids of dots: heated pads, holes, painted discs; bright or dark."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.normalisation import local_normalisation, stretch
from thermal_stereo_vo.calibration.targets import Target, TargetKind
from thermal_stereo_vo.calibration.views import BoardView, Detection

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
                if found:
                    pixels = centres.reshape(-1, 2).astype(np.float64)
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
