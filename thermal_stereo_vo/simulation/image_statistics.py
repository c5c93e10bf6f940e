"""What a thermal image is like, in a few figures that do not depend on its subject.

All are taken from the 8-bit view behind one and the same gain control, so that frames of other
cameras can be compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class ImageStatistics:
    """Figures of one view.

    ``gradient_median`` and ``gradient_p95`` are of the Sobel magnitude in grey levels a pixel;
    ``flat_percent`` the part of the image with a gradient below 1; ``spectral_slope`` the exponent
    of the power spectrum between 0.02 and 0.2 cycles a pixel; ``fine_percent`` the part of its
    power above 0.25 cycles a pixel; ``features`` the Fast-Hessian points per 10 000 pixels.
    """

    gradient_median: float
    gradient_p95: float
    flat_percent: float
    spectral_slope: float
    fine_percent: float
    features: float


def names() -> tuple[str, ...]:
    """The figures in order."""
    return tuple(field.name for field in fields(ImageStatistics))


def gradient_magnitude(image: Image) -> NDArray[np.float32]:
    """(H, W) Sobel magnitude in grey levels a pixel."""
    grey = image.astype(np.float32)
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3) / 8.0
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3) / 8.0
    return np.asarray(np.hypot(dx, dy))


def power_spectrum(image: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequency (cycles a pixel) and mean power on rings, of the middle square under a window."""
    side = min(image.shape)
    y, x = ((n - side) // 2 for n in image.shape)
    part = image[y : y + side, x : x + side].astype(np.float64)
    window = np.outer(np.hanning(side), np.hanning(side))
    part = (part - np.average(part, weights=window)) * window
    power = np.abs(np.fft.fft2(part)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    edges = np.geomspace(4.0 / side, 0.5, 40)
    ring = np.digitize(frequency.ravel(), edges)
    total = np.bincount(ring, power.ravel(), len(edges) + 1)[1:-1]
    count = np.bincount(ring, minlength=len(edges) + 1)[1:-1]
    kept = count > 0
    centres = np.sqrt(edges[:-1] * edges[1:])
    return centres[kept], total[kept] / count[kept]


def statistics_of(image: Image, count_features: Callable[[Image], int]) -> ImageStatistics:
    """All figures of one view (H, W) uint8."""
    gradient = gradient_magnitude(image)
    frequency, power = power_spectrum(image)
    middle = (frequency > 0.02) & (frequency < 0.2)
    # A ring holds as many samples as it is long and wide: the spread falls with the frequency.
    slope = np.polyfit(
        np.log(frequency[middle]), np.log(power[middle] + 1e-9), 1, w=frequency[middle]
    )[0]
    # Rings are wider further out: power times circumference and width.
    weight = power * frequency * np.gradient(frequency)
    return ImageStatistics(
        gradient_median=float(np.median(gradient)),
        gradient_p95=float(np.percentile(gradient, 95)),
        flat_percent=float(100.0 * np.mean(gradient < 1.0)),
        spectral_slope=float(slope),
        fine_percent=float(100.0 * weight[frequency > 0.25].sum() / max(weight.sum(), 1e-9)),
        features=count_features(image) / image.size * 1e4,
    )
