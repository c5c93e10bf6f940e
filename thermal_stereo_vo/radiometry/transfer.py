"""Transfer functions of an automatic gain control: a histogram of counts to a curve of grey levels.

A curve is (65536,) float32: the grey level (0..255) of every 16-bit count; it never falls.  Each
kernel has a plain numpy twin that the tests hold it to.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

COUNTS = 65536
WHITE = 255.0
PLATEAU_PIXELS = 640 * 512
"""FLIR states the plateau in pixels per count of this array."""

Curve = NDArray[np.float32]
Histogram = NDArray[np.int64]


@njit(cache=True, nogil=True)
def add_to_histogram(
    image: NDArray[Any], roi: NDArray[np.bool_], mask: NDArray[np.bool_], step: int, out: Histogram
) -> int:
    """Count every ``step``-th pixel of every ``step``-th row that roi and mask allow into ``out``.

    Args:
        image: (H, W) uint8, uint16 or float32 counts; what is no number is left out.
        roi: (H, W) bool.
        mask: (H, W) bool.
        step: sampling distance in pixels.
        out: (65536,) int64, added to.

    Returns:
        How many pixels were counted.
    """
    added = 0
    for y in range(step // 2, image.shape[0], step):
        for x in range(step // 2, image.shape[1], step):
            if roi[y, x] and mask[y, x]:
                value = image[y, x]
                if value == value:
                    out[int(min(max(value, 0), COUNTS - 1) + 0.5)] += 1
                    added += 1
    return added


def histogram_reference(
    image: NDArray[Any], roi: NDArray[np.bool_], mask: NDArray[np.bool_], step: int
) -> Histogram:
    """Plain numpy twin of ``add_to_histogram``."""
    part = (slice(step // 2, None, step), slice(step // 2, None, step))
    values = image[part][roi[part] & mask[part]].astype(np.float64)
    values = values[~np.isnan(values)]
    counts = np.floor(np.clip(values, 0, COUNTS - 1) + 0.5).astype(np.int64)
    return np.bincount(counts, minlength=COUNTS)


@njit(cache=True, nogil=True)
def tails(histogram: Histogram, tail: float) -> tuple[int, int]:
    """The lowest and highest count left once the fraction ``tail`` is rejected at either end."""
    total = 0
    for count in range(COUNTS):
        total += histogram[count]
    rejected = tail * total
    low, below = 0, histogram[0]
    while low < COUNTS - 1 and below <= rejected:
        low += 1
        below += histogram[low]
    high, above = COUNTS - 1, histogram[COUNTS - 1]
    while high > low and above <= rejected:
        high -= 1
        above += histogram[high]
    return low, high


def tails_reference(histogram: Histogram, tail: float) -> tuple[int, int]:
    """Plain numpy twin of ``tails``."""
    rejected = tail * histogram.sum()
    low = int(np.argmax(np.cumsum(histogram) > rejected))
    high = COUNTS - 1 - int(np.argmax(np.cumsum(histogram[::-1]) > rejected))
    return low, max(low, high)


@njit(cache=True, nogil=True)
def linear_curve(
    histogram: Histogram, tail: float, max_gain: float, midpoint: float, out: Curve
) -> None:
    """A straight line between the tails, the middle of both at ``midpoint``.

    FLIR 102-PS242-100-01: ``m = 255 / (p(100 - tail) - p(tail))``, never above ``max_gain`` grey
    levels per count; clipped to 0..255.
    """
    low, high = tails(histogram, tail)
    gain = max_gain
    if high > low:
        gain = min(max_gain, WHITE / (high - low))
    middle = 0.5 * (low + high)
    for count in range(COUNTS):
        out[count] = min(max(midpoint + gain * (count - middle), 0.0), WHITE)


def linear_reference(histogram: Histogram, tail: float, max_gain: float, midpoint: float) -> Curve:
    """Plain numpy twin of ``linear_curve``."""
    low, high = tails_reference(histogram, tail)
    gain = min(max_gain, WHITE / (high - low)) if high > low else max_gain
    counts = np.arange(COUNTS, dtype=np.float64)
    return np.clip(midpoint + gain * (counts - 0.5 * (low + high)), 0, WHITE).astype(np.float32)


@njit(cache=True, nogil=True)
def plateau_curve(
    histogram: Histogram,
    plateau: float,
    tail: float,
    max_gain: float,
    midpoint: float,
    out: Curve,
) -> None:
    """Histogram equalisation with each bin capped, between the tails.

    A low ``plateau`` tends to a straight line over the counts that occur, a high one to full
    equalisation.  A step between neighbouring occupied counts never exceeds ``max_gain`` grey
    levels per count; a curve that then spans less than 0..255 lies around ``midpoint``.

    Args:
        histogram: (65536,) int64.
        plateau: cap in pixels per count of a 640x512 image.
        tail: fraction rejected at either end.
        max_gain: grey levels per count.
        midpoint: grey level of the middle of a narrow curve.
        out: (65536,) float32, written.
    """
    low, high = tails(histogram, tail)
    total = 0
    for count in range(COUNTS):
        total += histogram[count]
    cap = max(plateau * total / PLATEAU_PIXELS, 1.0)
    mass = 0.0
    for count in range(low, high + 1):
        mass += min(float(histogram[count]), cap)
    level, last = 0.0, low - 1
    for count in range(COUNTS):
        rise = 0.0
        if low <= count <= high and histogram[count] > 0 and mass > 0.0:
            rise = WHITE * min(float(histogram[count]), cap) / mass
            rise = min(rise, max_gain * (count - last))
            last = count
        # A count lies at the middle of its own bin.
        out[count] = level + 0.5 * rise
        level += rise
    offset = min(max(midpoint - 0.5 * level, 0.0), WHITE - level)
    # Beyond the tails the curve goes on at full gain, so that a narrow curve clips nothing.
    for count in range(COUNTS):
        value = out[count] + offset
        if count < low:
            value -= max_gain * (low - count)
        elif count > high:
            value += max_gain * (count - high)
        out[count] = min(max(value, 0.0), WHITE)


def plateau_reference(
    histogram: Histogram, plateau: float, tail: float, max_gain: float, midpoint: float
) -> Curve:
    """Plain numpy twin of ``plateau_curve``."""
    low, high = tails_reference(histogram, tail)
    cap = max(plateau * histogram.sum() / PLATEAU_PIXELS, 1.0)
    capped = np.minimum(histogram, cap).astype(np.float64)
    capped[:low] = 0.0
    capped[high + 1 :] = 0.0
    occupied = np.flatnonzero(capped)
    rise = np.zeros(COUNTS)
    distance = np.diff(occupied, prepend=low - 1)
    rise[occupied] = np.minimum(WHITE * capped[occupied] / capped.sum(), max_gain * distance)
    curve = np.cumsum(rise) - 0.5 * rise
    offset = min(max(midpoint - 0.5 * rise.sum(), 0.0), WHITE - rise.sum())
    counts = np.arange(COUNTS)
    beyond = np.minimum(counts - low, 0) + np.maximum(counts - high, 0)
    levels: Curve = np.clip(curve + offset + max_gain * beyond, 0.0, WHITE).astype(np.float32)
    return levels


@njit(cache=True, nogil=True)
def saturated_fraction(histogram: Histogram, curve: Curve) -> float:
    """Which part of the counted pixels a curve shows as plain black or white."""
    total, saturated = 0, 0
    for count in range(COUNTS):
        total += histogram[count]
        if curve[count] < 0.5 or curve[count] > WHITE - 0.5:
            saturated += histogram[count]
    return saturated / total if total else 0.0


@njit(cache=True, nogil=True)
def apply_curve(image: NDArray[Any], curve: Curve, out: NDArray[np.uint8]) -> None:
    """Show an (H, W) image of counts through a curve; what is no number becomes black."""
    levels = np.empty(COUNTS, np.uint8)
    for count in range(COUNTS):
        levels[count] = np.uint8(curve[count] + 0.5)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            value = image[y, x]
            if value == value:
                out[y, x] = levels[int(min(max(value, 0), COUNTS - 1) + 0.5)]
            else:
                out[y, x] = 0


def apply_reference(image: NDArray[Any], curve: Curve) -> NDArray[np.uint8]:
    """Plain numpy twin of ``apply_curve``."""
    values = image.astype(np.float64)
    counts = np.floor(np.clip(np.nan_to_num(values, nan=0.0), 0, COUNTS - 1) + 0.5).astype(np.int64)
    levels = (curve + np.float32(0.5)).astype(np.uint8)
    shown: NDArray[np.uint8] = np.where(np.isnan(values), np.uint8(0), levels[counts])
    return shown
