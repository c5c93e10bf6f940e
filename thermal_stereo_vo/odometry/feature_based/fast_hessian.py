"""Fast-Hessian interest points (Bay, Ess, Tuytelaars, Van Gool, SURF, CVIU 110, 2008).

Our own, since OpenCV's SURF is left out of its free builds.  Conventions are OpenCV's: box filters
of side 9, 15, 21, 27, 39, 51 px, box sums divided by the box area, response
``Dxx Dyy - 0.81 Dxy^2`` in grey levels squared.  Deviations from the SURF paper: all layers are
evaluated at every pixel, and a top-k per image cell replaces the one global threshold, because the
contrast of a thermal image depends on gain and weather.

Speed comes from working on whole rows of the integral image: each output row is one loop over
contiguous slices, which the compiler turns into vector instructions.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting

FILTER_SIDES_PX = (9, 15, 21, 27, 39, 51)
# Two octaves of four layers share the full-resolution stack: (below, middle, above) of each
# triple that non-maximum suppression looks at.
_TRIPLES = np.array([[0, 1, 2], [1, 2, 3], [1, 3, 4], [3, 4, 5]], dtype=np.int64)


@dataclass(frozen=True)
class FastHessianConfig:
    """Which interest points are kept."""

    threshold: float = setting(
        5.0,
        "Least determinant of the box Hessian; thermal images need far less than visible ones.",
        unit="grey levels^2",
        minimum=0.0,
        maximum=1e6,
    )
    features: int = setting(1200, "Most interest points per image.", minimum=50, maximum=20000)
    cell_px: int = setting(
        64,
        "Side of the image cells that share the points evenly.",
        unit="px",
        minimum=16,
        maximum=1024,
    )


@dataclass(frozen=True)
class InterestPoints:
    """What the detector found.

    ``pixels`` (N, 2) float32, ``size_px`` (N,) float32 filter side, ``response`` (N,) float32
    determinant, ``bright`` (N,) bool: a blob brighter than its surround (negative trace).
    """

    pixels: NDArray[np.float32]
    size_px: NDArray[np.float32]
    response: NDArray[np.float32]
    bright: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.pixels)


class FastHessian:
    """The detector; keeps its work arrays from image to image."""

    def __init__(self, config: FastHessianConfig) -> None:
        self._config = config
        self._responses = np.zeros((len(FILTER_SIDES_PX), 0, 0), np.float32)
        # Read-only as the masks of frames are: to the compiler that is part of the type.
        self._no_mask = np.ones((1, 1), np.bool_)
        self._no_mask.flags.writeable = False

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> InterestPoints:
        """Interest points of an (H, W) 8-bit image, strongest first within each cell.

        Points whose pixel is False in ``mask`` (H, W) are dropped.
        """
        height, width = image.shape
        if self._responses.shape[1:] != (height, width):
            self._responses = np.zeros((len(FILTER_SIDES_PX), height, width), np.float32)
        integral = cv2.integral(image)
        for layer, side in enumerate(FILTER_SIDES_PX):
            hessian_determinant(integral, side // 3, self._responses[layer])
        config = self._config
        rows, columns = -(-height // config.cell_px), -(-width // config.cell_px)
        per_cell = max(1, -(-config.features // (rows * columns)))
        peaks = find_peaks(
            self._responses,
            _TRIPLES,
            np.float32(config.threshold),
            config.cell_px,
            per_cell,
            self._no_mask if mask is None else mask,
        )
        pixels, size_px, response = interpolate_peaks(
            self._responses, np.array(FILTER_SIDES_PX, np.float32), _TRIPLES, peaks
        )
        return InterestPoints(pixels, size_px, response, bright_blobs(integral, pixels, size_px))


@njit(cache=True, nogil=True)
def hessian_determinant(integral, lobe, out):  # type: ignore[no-untyped-def]
    """Determinant of the box-filter Hessian of side ``3 * lobe``, written to ``out``.

    ``integral`` (H + 1, W + 1) int32, ``out`` (H, W) float32; zero where the filter leaves the
    image.
    """
    height, width = out.shape
    half = (3 * lobe) // 2
    wide = lobe - 1  # half width of the 2 * lobe - 1 wide boxes
    mid = lobe // 2  # half height of the middle box
    n = width - 2 * half
    out[:half] = 0.0
    out[max(height - half, 0) :] = 0.0
    if n <= 0 or height <= 2 * half:
        out[:] = 0.0
        return
    second = np.float32(1.0 / (lobe * (2 * lobe - 1)))
    mixed = np.float32(1.0 / (lobe * lobe))
    weight = np.float32(0.81)  # 0.9 ** 2 makes up for the boxes (SURF paper, eq. 3)
    # Every box is a difference of two rows of the integral image, read at two columns; rows that
    # are read at the same columns are added up first.
    columns = integral.shape[1]
    tall = np.empty(columns, np.int32)  # for Dyy: full height - 3 * middle
    flat = np.empty(columns, np.int32)  # for Dxx
    cross = np.empty(columns, np.int32)  # for Dxy: above - below
    a, b = half - wide, half + wide + 1
    c, d, e = half - mid, half + mid + 1, 2 * half + 1
    f, g, h, i = half - lobe, half, half + 1, half + 1 + lobe
    tall_a, tall_b = tall[a : a + n], tall[b : b + n]
    flat_0, flat_c, flat_d, flat_e = flat[:n], flat[c : c + n], flat[d : d + n], flat[e : e + n]
    cross_f, cross_g = cross[f : f + n], cross[g : g + n]
    cross_h, cross_i = cross[h : h + n], cross[i : i + n]
    for y in range(half, height - half):
        top, bottom = integral[y - half], integral[y + half + 1]
        upper, lower = integral[y - mid], integral[y + mid + 1]
        x_top, x_bottom = integral[y - wide], integral[y + wide + 1]
        north_0, north_1 = integral[y - lobe], integral[y]
        south_0, south_1 = integral[y + 1], integral[y + 1 + lobe]
        for x in range(columns):
            tall[x] = (bottom[x] - top[x]) - 3 * (lower[x] - upper[x])
            flat[x] = x_bottom[x] - x_top[x]
            cross[x] = (north_1[x] - north_0[x]) - (south_1[x] - south_0[x])
        row = out[y]
        row[:half] = 0.0
        row[half + n :] = 0.0
        target = row[half : half + n]
        for x in range(n):
            xx = np.float32(np.int32((flat_e[x] - flat_0[x]) - 3 * (flat_d[x] - flat_c[x])))
            yy = np.float32(np.int32(tall_b[x] - tall_a[x]))
            xy = np.float32(np.int32((cross_g[x] - cross_f[x]) - (cross_i[x] - cross_h[x])))
            xx *= second
            yy *= second
            xy *= mixed
            target[x] = xx * yy - weight * xy * xy


@njit(cache=True, nogil=True)
def find_peaks(responses, triples, threshold, cell_px, per_cell, mask):  # type: ignore[no-untyped-def]
    """Local maxima of 3 x 3 x 3 neighbourhoods, the strongest ``per_cell`` of each cell.

    ``responses`` (L, H, W) float32, ``triples`` (K, 3) layers below, of and above each middle.
    Returns (N, 3) int64: triple, y, x; cells in reading order, strongest first within a cell.
    A ``mask`` of one element means that all pixels count.
    """
    _, height, width = responses.shape
    rows = (height + cell_px - 1) // cell_px
    columns = (width + cell_px - 1) // cell_px
    count = np.zeros(rows * columns, np.int64)
    best = np.zeros((rows * columns, per_cell), np.float32)
    where = np.zeros((rows * columns, per_cell, 3), np.int64)
    masked = mask.size > 1
    candidate = np.empty(width - 2, np.bool_)
    for k in range(len(triples)):
        below, middle, above = (
            responses[triples[k, 0]],
            responses[triples[k, 1]],
            responses[triples[k, 2]],
        )
        for y in range(1, height - 1):
            row, up, down = middle[y], middle[y - 1], middle[y + 1]
            # Vector instructions weed out all but about one pixel in ten.
            centre, west, east = row[1 : width - 1], row[: width - 2], row[2:]
            north, south = up[1 : width - 1], down[1 : width - 1]
            beneath, over = below[y][1 : width - 1], above[y][1 : width - 1]
            for i in range(width - 2):
                value = centre[i]
                candidate[i] = (
                    (value > threshold)
                    & (value > west[i])
                    & (value >= east[i])
                    & (value > north[i])
                    & (value >= south[i])
                    & (value > beneath[i])
                    & (value >= over[i])
                )
            for x in range(1, width - 1):
                if not candidate[x - 1]:
                    continue
                value = row[x]
                peak = value > up[x - 1] and value > up[x + 1]
                peak = peak and value >= down[x - 1] and value >= down[x + 1]
                if peak:
                    for dy in range(-1, 2):
                        low, high = below[y + dy], above[y + dy]
                        for dx in range(-1, 2):
                            peak = peak and value > low[x + dx] and value >= high[x + dx]
                if peak and (not masked or mask[y, x]):
                    cell = (y // cell_px) * columns + x // cell_px
                    slots = best[cell]
                    n = count[cell]
                    if n < per_cell or value > slots[n - 1]:
                        i = min(n, per_cell - 1)
                        while i > 0 and value > slots[i - 1]:
                            slots[i] = slots[i - 1]
                            where[cell, i] = where[cell, i - 1]
                            i -= 1
                        slots[i] = value
                        where[cell, i, 0] = k
                        where[cell, i, 1] = y
                        where[cell, i, 2] = x
                        if n < per_cell:
                            count[cell] = n + 1
    peaks = np.empty((count.sum(), 3), np.int64)
    n = 0
    for cell in range(rows * columns):
        for i in range(count[cell]):
            peaks[n] = where[cell, i]
            n += 1
    return peaks


@njit(cache=True, nogil=True)
def interpolate_peaks(responses, sides_px, triples, peaks):  # type: ignore[no-untyped-def]
    """Sub-pixel and sub-scale place of each peak: one Newton step on a 3-D quadratic.

    Brown & Lowe, BMVC 2002; a peak that would move by more than one sample is dropped, as in
    OpenCV.  Returns pixels (N, 2), filter side (N,) and response (N,), all float32.
    """
    pixels = np.empty((len(peaks), 2), np.float32)
    size_px = np.empty(len(peaks), np.float32)
    response = np.empty(len(peaks), np.float32)
    n = 0
    for p in range(len(peaks)):
        k, y, x = peaks[p, 0], peaks[p, 1], peaks[p, 2]
        a, b, c = responses[triples[k, 0]], responses[triples[k, 1]], responses[triples[k, 2]]
        value = b[y, x]
        gx = 0.5 * (b[y, x + 1] - b[y, x - 1])
        gy = 0.5 * (b[y + 1, x] - b[y - 1, x])
        gs = 0.5 * (c[y, x] - a[y, x])
        xx = b[y, x + 1] - 2.0 * value + b[y, x - 1]
        yy = b[y + 1, x] - 2.0 * value + b[y - 1, x]
        ss = c[y, x] - 2.0 * value + a[y, x]
        xy = 0.25 * (b[y + 1, x + 1] - b[y + 1, x - 1] - b[y - 1, x + 1] + b[y - 1, x - 1])
        xs = 0.25 * (c[y, x + 1] - c[y, x - 1] - a[y, x + 1] + a[y, x - 1])
        ys = 0.25 * (c[y + 1, x] - c[y - 1, x] - a[y + 1, x] + a[y - 1, x])
        # Cramer's rule for H offset = -g.
        m0, m1, m2 = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - yy * xs
        determinant = xx * m0 + xy * m1 + xs * m2
        if determinant == 0.0:
            continue
        n1, n2, n3 = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
        ox = -(m0 * gx + m1 * gy + m2 * gs) / determinant
        oy = -(m1 * gx + n1 * gy + n2 * gs) / determinant
        os = -(m2 * gx + n2 * gy + n3 * gs) / determinant
        if abs(ox) > 1.0 or abs(oy) > 1.0 or abs(os) > 1.0:
            continue
        middle = sides_px[triples[k, 1]]
        step = sides_px[triples[k, 2]] - middle if os > 0.0 else middle - sides_px[triples[k, 0]]
        pixels[n, 0] = x + ox
        pixels[n, 1] = y + oy
        size_px[n] = middle + os * step
        response[n] = value + 0.5 * (gx * ox + gy * oy + gs * os)
        n += 1
    return pixels[:n].copy(), size_px[:n].copy(), response[:n].copy()


@njit(cache=True, nogil=True)
def bright_blobs(integral, pixels, size_px):  # type: ignore[no-untyped-def]
    """(N,) bool: whether the middle box is brighter than the surround (sign of the Laplacian)."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    bright = np.zeros(len(pixels), np.bool_)
    for i in range(len(pixels)):
        x, y = int(pixels[i, 0] + 0.5), int(pixels[i, 1] + 0.5)
        inner = max(int(size_px[i]) // 6, 1)
        outer = min(3 * inner, x, y, width - 1 - x, height - 1 - y)
        inner = min(inner, outer)
        small = (
            integral[y + inner + 1, x + inner + 1]
            - integral[y + inner + 1, x - inner]
            - integral[y - inner, x + inner + 1]
            + integral[y - inner, x - inner]
        )
        large = (
            integral[y + outer + 1, x + outer + 1]
            - integral[y + outer + 1, x - outer]
            - integral[y - outer, x + outer + 1]
            + integral[y - outer, x - outer]
        )
        bright[i] = small * (2 * outer + 1) ** 2 > large * (2 * inner + 1) ** 2
    return bright
