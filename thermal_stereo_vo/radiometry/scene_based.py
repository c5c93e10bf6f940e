"""Scene-based refinement: the fixed pattern that is left is learnt from the scene in flight.

Where the scene has moved on, a pixel should look like its surroundings; what it keeps of its own is
pattern.  Gated LMS after Hardie et al., Opt. Express 17(17) 14918 (2009), with three changes: it
learns only from views that differ enough from the last one learnt from, as keyframes do, so that
hover and vibration teach nothing; errors are clipped, which steers to the median and not to the
mean of what passed; columns, rows and smooth shading are learnt as such, far faster than pixels.

Two patterns are learnt by turns, each from every second view.  What both agree on is pattern, where
they differ the scene has left its traces: only the agreed share is taken from the image, so that an
even sensor is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.radiometry.flat_field import subtract

Map = NDArray[np.float32]

COARSE_SIDE = 16
UNSEEN = np.float32(1e9)
ERROR_LIMIT = 1.5
"""Errors count up to this multiple of the median error."""


@dataclass(frozen=True)
class SceneBasedConfig:
    """How the fixed pattern is learnt in flight."""

    enabled: bool = setting(False, "Learn and remove the fixed pattern that is left in flight.")
    rate: float = setting(
        0.05,
        "Part of a pixel's error taken over at each view; the first views count for more.",
        minimum=0.0,
        maximum=1.0,
    )
    stripe_rate: float = setting(
        0.08,
        "Part of a column's or row's error taken over at each view; the first count for more.",
        minimum=0.0,
        maximum=1.0,
    )
    shading_rate: float = setting(
        0.01, "Part of the smooth shading taken over at each view.", minimum=0.0, maximum=1.0
    )
    window_px: int = setting(
        11, "Side of the surroundings a pixel is compared with.", unit="px", minimum=3, maximum=63
    )
    stripe_window_px: int = setting(
        31,
        "Length of the surroundings across a column or row.",
        unit="px",
        minimum=3,
        maximum=127,
    )
    gate_counts: float = setting(
        1.5,
        "A pixel learns only where its surroundings changed by this much since it last did.",
        unit="counts",
        minimum=0.0,
        maximum=1000.0,
    )
    min_change: float = setting(
        0.08,
        "A view teaches only when it differs from the last one that did by this part of its "
        "contrast; hover and vibration stay below.",
        minimum=0.0,
        maximum=1.0,
    )
    min_contrast_counts: float = setting(
        6.0,
        "A view with less contrast (10th to 90th percentile) is bland and teaches nothing.",
        unit="counts",
        minimum=0.0,
        maximum=10_000.0,
    )


@dataclass
class _Pattern:
    """A learnt pattern in parts: (H, W) pixels, (W,) columns, (H,) rows, (P,) weights of shading.

    ``seen`` (H, W) holds the surroundings, less their level, when each pixel last learnt.
    """

    pixels: Map
    columns: NDArray[np.float64]
    rows: NDArray[np.float64]
    shading: NDArray[np.float64]
    seen: Map

    @classmethod
    def empty(cls, shape: tuple[int, int], planes: int) -> _Pattern:
        return cls(
            np.zeros(shape, np.float32),
            np.zeros(shape[1]),
            np.zeros(shape[0]),
            np.zeros(planes),
            np.full(shape, UNSEEN, np.float32),
        )

    def sort(self) -> None:
        """Move what whole columns and rows have in common from the pixels to those."""
        columns = self.pixels.mean(axis=0)
        self.pixels -= columns
        rows = self.pixels.mean(axis=1)
        self.pixels -= rows[:, None]
        self.columns += columns
        self.rows += rows

    def total(self, planes: list[Map]) -> Map:
        """(H, W) sum of all parts."""
        total = self.pixels + self.columns.astype(np.float32)
        total += self.rows.astype(np.float32)[:, None]
        for weight, plane in zip(self.shading, planes, strict=True):
            total += np.float32(weight) * plane
        return total


class SceneBasedCorrection:
    """Learns and removes the fixed pattern of one camera.

    ``views`` counts the views learnt from.
    """

    def __init__(self, config: SceneBasedConfig | None = None) -> None:
        self._config = config if config is not None else SceneBasedConfig()
        self._epoch: int | None = None
        self.views = 0
        self._offset: Map = np.zeros((0, 0), np.float32)

    @property
    def offset(self) -> Map:
        """(H, W) counts that are subtracted; a copy."""
        return self._offset.copy()

    def reset(self) -> None:
        """Forget the pattern."""
        self._offset = np.zeros((0, 0), np.float32)

    def process(self, image: NDArray[Any], *, settled: bool, epoch: int) -> NDArray[Any]:
        """Correct a good frame, and learn from it where it teaches something.

        Args:
            image: (H, W) uint8 or uint16 counts, not changed.
            settled: False while the gate lets nothing be learnt (after a correction).
            epoch: count of the camera's own corrections; when it rises the pattern is forgotten,
                unless it still makes the image smoother.

        Returns:
            (H, W) of the same type, rounded and clipped to its range.
        """
        image = np.ascontiguousarray(image)
        known = image.shape == self._offset.shape
        if not known or (epoch != self._epoch and not self._still_fits(image)):
            self._begin((image.shape[0], image.shape[1]))
        self._epoch = epoch
        out = np.empty(image.shape, image.dtype)
        subtract(image, self._offset, float(np.iinfo(image.dtype).max), out)
        if settled and self._teaches(image):
            self._learn(image)
        return out

    def _begin(self, shape: tuple[int, int]) -> None:
        self.views = 0
        self._offset = np.zeros(shape, np.float32)
        self._reference: Map | None = None
        one, *self._planes = shading_basis(shape)
        self._patterns = [_Pattern.empty(shape, len(self._planes)) for _ in range(2)]
        self._coarse_size = (max(1, shape[1] // COARSE_SIDE), max(1, shape[0] // COARSE_SIDE))
        design = np.column_stack([self._coarse(plane).ravel() for plane in (one, *self._planes)])
        self._fit = np.linalg.pinv(design.astype(np.float64))

    def _still_fits(self, image: NDArray[Any]) -> bool:
        raw = image.astype(np.float32)
        return _graininess(raw - self._offset) < _graininess(raw)

    def _coarse(self, image: NDArray[Any]) -> Map:
        small: Map = cv2.resize(image, self._coarse_size, interpolation=cv2.INTER_AREA)
        return small.astype(np.float32)

    def _teaches(self, image: NDArray[Any]) -> bool:
        """Whether the view has contrast and differs enough from the last one learnt from."""
        coarse = self._coarse(image)
        coarse -= np.median(coarse)
        low, high = np.percentile(coarse, (10, 90))
        if high - low < self._config.min_contrast_counts:
            return False
        if self._reference is not None:
            change = float(np.mean(np.abs(coarse - self._reference))) / float(high - low)
            if change < self._config.min_change:
                return False
        self._reference = coarse
        return True

    def _learn(self, image: NDArray[Any]) -> None:
        pattern = self._patterns[self.views % 2]
        corrected = image.astype(np.float32)
        corrected -= pattern.total(self._planes)
        self._learn_pattern(corrected, pattern)
        coarse = self._coarse(corrected).ravel().astype(np.float64)
        pattern.shading += self._config.shading_rate * (self._fit @ coarse)[1:]
        self.views += 1
        if self.views >= 2:
            self._offset = _agreed(*self._patterns).total(self._planes)

    def _learn_pattern(self, corrected: Map, pattern: _Pattern) -> None:
        config = self._config
        around = cv2.blur(corrected, (config.window_px, config.window_px))
        across = cv2.blur(corrected, (config.stripe_window_px, 1))
        along = cv2.blur(corrected, (1, config.stripe_window_px))
        sample = np.abs(corrected[::4, ::4] - around[::4, ::4])
        limit = ERROR_LIMIT * float(np.median(sample)) + 0.2
        level = float(np.median(around[::8, ::8]))
        columns = np.zeros((2, corrected.shape[1]))
        rows = np.zeros((2, corrected.shape[0]))
        learn_pixels(
            corrected,
            around,
            across,
            along,
            pattern.seen,
            level,
            config.gate_counts,
            limit,
            self._rate(config.rate),
            pattern.pixels,
            columns,
            rows,
        )
        stripe_rate = self._rate(config.stripe_rate)
        pattern.columns += stripe_rate * _means(columns, corrected.shape[0])
        pattern.rows += stripe_rate * _means(rows, corrected.shape[1])
        pattern.sort()

    def _rate(self, lasting: float) -> float:
        """A running mean over the first views of a pattern, then the lasting rate."""
        return max(lasting, 1.0 / (self.views // 2 + 3)) if lasting > 0 else 0.0


def _agreed(first: _Pattern, second: _Pattern) -> _Pattern:
    """The mean of two patterns, each part scaled by the share of its variance they agree on.

    With independent errors the covariance of the two is the variance of the truth (Wiener).
    """

    def share(name: str) -> NDArray[Any]:
        a, b = getattr(first, name), getattr(second, name)
        mean = 0.5 * (a + b)
        power = float(np.mean(mean * mean))
        common = float(np.mean(a * b))
        scaled: NDArray[Any] = mean * min(max(common / power, 0.0), 1.0) if power > 0 else mean
        return scaled

    return _Pattern(
        share("pixels").astype(np.float32),
        share("columns"),
        share("rows"),
        0.5 * (first.shading + second.shading),
        first.seen,
    )


@njit(cache=True, nogil=True)
def learn_pixels(
    corrected: Map,
    around: Map,
    across: Map,
    along: Map,
    seen: Map,
    level: float,
    gate: float,
    limit: float,
    rate: float,
    offset: Map,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
) -> None:
    """One gated LMS step.

    Args:
        corrected: (H, W) counts as they are corrected now.
        around: (H, W) their mean over the surroundings.
        across: (H, W) their mean along the row, for the error of the column.
        along: (H, W) their mean along the column, for the error of the row.
        seen: (H, W) surroundings, less their level, when each pixel last learnt; updated.
        level: level of this view.
        gate: smallest change of the surroundings from which a pixel learns.
        limit: largest error that counts.
        rate: part of the error taken over.
        offset: (H, W) learnt pattern; updated.
        columns: (2, W) sum and number of the errors of each column; added to.
        rows: (2, H) the same of each row.
    """
    for y in range(corrected.shape[0]):
        for x in range(corrected.shape[1]):
            now = around[y, x] - level
            if abs(now - seen[y, x]) <= gate:
                continue
            seen[y, x] = now
            value = corrected[y, x]
            offset[y, x] += rate * min(max(value - around[y, x], -limit), limit)
            columns[0, x] += min(max(value - across[y, x], -limit), limit)
            columns[1, x] += 1.0
            rows[0, y] += min(max(value - along[y, x], -limit), limit)
            rows[1, y] += 1.0


def learn_reference(
    corrected: Map,
    around: Map,
    across: Map,
    along: Map,
    seen: Map,
    level: float,
    gate: float,
    limit: float,
    rate: float,
) -> tuple[Map, Map, NDArray[np.float64], NDArray[np.float64]]:
    """Plain numpy twin of ``learn_pixels``: what to add to offset; seen, columns and rows after."""
    now = around - np.float32(level)
    moved = np.abs(now - seen) > gate
    step = np.where(moved, rate * np.clip(corrected - around, -limit, limit), 0)
    by_column = np.where(moved, np.clip(corrected - across, -limit, limit), 0)
    by_row = np.where(moved, np.clip(corrected - along, -limit, limit), 0)
    columns = np.array([by_column.sum(axis=0), moved.sum(axis=0)], np.float64)
    rows = np.array([by_row.sum(axis=1), moved.sum(axis=1)], np.float64)
    return step.astype(np.float32), np.where(moved, now, seen), columns, rows


def shading_basis(shape: tuple[int, int]) -> list[Map]:
    """Planes (H, W) of smooth shading: a constant, then even powers about the centre.

    Lens and housing shade alike on both sides of the axis; what is odd (sky above, ground below)
    belongs to the scene.
    """
    y = np.linspace(-1, 1, shape[0], dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, shape[1], dtype=np.float32)[None, :]
    one = np.ones(shape, np.float32)
    planes = [one, one * x**2, one * y**2, one * x**4, x**2 * y**2, one * y**4]
    return [planes[0], *(np.ascontiguousarray(plane - plane.mean()) for plane in planes[1:])]


def _means(sums: NDArray[np.float64], pixels: int) -> NDArray[np.float64]:
    """Mean error of each column or row; 0 where fewer than a tenth of its pixels took part."""
    enough = sums[1] >= 0.1 * pixels
    means: NDArray[np.float64] = np.where(enough, sums[0] / np.maximum(sums[1], 1.0), 0.0)
    return means


def _graininess(image: Map) -> float:
    """Mean absolute difference of neighbouring pixels."""
    return float(np.mean(np.abs(np.diff(image, axis=0))) + np.mean(np.abs(np.diff(image, axis=1))))
