"""Views of a raw image in which a board detector can see something.

A thermal board image holds little contrast on top of large gradients: a hot spot, a warm body, a
sky.  A plain shift or stretch to 8 bit loses the board; these mappings work from the counts.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_BAD_SIGMAS = 8.0
_BAD_RANGE = 0.05


def stretch(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Linear map of the 0.5 and 99.5 percentile of an (H, W) image to 0 and 255."""
    counts = image.astype(np.float32)
    low, high = np.percentile(counts, (0.5, 99.5))
    scaled = (counts - low) * np.float32(255.0 / max(high - low, 1e-6))
    return np.asarray(np.clip(scaled, 0.0, 255.0), np.uint8)


def local_normalisation(image: NDArray[Any], sigma_px: float) -> NDArray[np.uint8]:
    """Each pixel against mean and spread of its neighbourhood, mid-grey at 128.

    ``sigma_px`` is the radius (standard deviation) of the neighbourhood: about a third of a board
    square.  The spread is held above the image's own noise, so that bland areas stay grey.
    """
    counts = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    mean = cv2.GaussianBlur(counts, (0, 0), sigma_px)
    residual = counts - mean
    variance = cv2.GaussianBlur(residual * residual, (0, 0), sigma_px)
    floor = max(float(np.median(variance)) * 1e-3, (0.5 * noise_counts(image)) ** 2, 1e-6)
    normalised = residual / np.sqrt(variance + np.float32(floor))
    return np.asarray(np.clip(128.0 + 51.0 * normalised, 0.0, 255.0), np.uint8)


def without_bad_pixels(image: NDArray[Any]) -> NDArray[Any]:
    """The (H, W) image with dead and hot pixels replaced by the median of their surroundings.

    Bad is what lies far beyond all eight neighbours: no edge or corner of a board does, but a
    single such pixel tears an orientation mark apart and spoils the corners beside it.
    """
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    counts = image if image.dtype in (np.uint8, np.uint16) else image.astype(np.float32)
    low = cv2.erode(counts, ring).astype(np.float32)
    high = cv2.dilate(counts, ring).astype(np.float32)
    beyond = np.maximum(counts - high, low - counts)
    p_low, p_high = np.percentile(counts, (0.5, 99.5))
    bad = beyond > max(_BAD_SIGMAS * noise_counts(image), _BAD_RANGE * (p_high - p_low))
    if not bad.any():
        return image
    return np.where(bad, cv2.medianBlur(counts, 3), counts)


def noise_counts(image: NDArray[Any]) -> float:
    """Standard deviation of the pixel noise of an (H, W) image, in counts.

    Median absolute response to Immerkaer's mask, which is blind to planes and edges' first order
    (Fast noise variance estimation, CVIU 1996).
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = cv2.filter2D(image.astype(np.float32), cv2.CV_32F, mask)[1:-1, 1:-1]
    return float(np.median(np.abs(response)) / 0.6745 / 6.0)
