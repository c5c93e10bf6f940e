"""Nearest binary descriptor within a window of the image: XOR, popcount, coarse to fine."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

CELL_PX = 32


@intrinsic
def popcount(typing_context, word):  # type: ignore[no-untyped-def]
    """Number of set bits of a uint64: the POPCNT instruction."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        function = builder.module.declare_intrinsic("llvm.ctpop", [ir.IntType(64)])
        return builder.call(function, arguments)

    return types.uint64(types.uint64), generate


@njit(cache=True, nogil=True)
def build_grid(pixels, width, height):  # type: ignore[no-untyped-def]
    """Bucket (N, 2) pixels into square cells of ``CELL_PX``.

    Returns ``start`` (cells + 1,) and ``order`` (N,): the points of cell c are
    ``order[start[c]:start[c + 1]]``, cells in reading order.
    """
    columns = width // CELL_PX + 1
    rows = height // CELL_PX + 1
    start = np.zeros(rows * columns + 1, np.int64)
    cells = np.empty(len(pixels), np.int64)
    for i in range(len(pixels)):
        cell = int(pixels[i, 1]) // CELL_PX * columns + int(pixels[i, 0]) // CELL_PX
        cells[i] = cell
        start[cell + 1] += 1
    for c in range(rows * columns):
        start[c + 1] += start[c]
    fill = start[:-1].copy()
    order = np.empty(len(pixels), np.int64)
    for i in range(len(pixels)):
        order[fill[cells[i]]] = i
        fill[cells[i]] += 1
    return start, order


@njit(cache=True, nogil=True)
def match_in_windows(  # type: ignore[no-untyped-def]
    descriptors,
    bright,
    windows,
    other_pixels,
    other_descriptors,
    other_bright,
    start,
    order,
    width,
    height,
    coarse_bits,
    ratio,
):
    """The best partner of each descriptor inside its window.

    ``windows`` (N, 4) float32: x_min, x_max, y_min, y_max in the other image.  A candidate whose
    first 16 bytes differ in more than ``coarse_bits`` is dropped without looking at the rest, as
    is one that cannot beat the best so far (FREAK's coarse-to-fine search).  With ``ratio`` < 1
    the best distance must be below ``ratio`` times the second best.  Returns ``partner`` (N,)
    int64, -1 where there is none, and ``distance`` (N,) int64 bits.
    """
    columns = width // CELL_PX + 1
    rows = height // CELL_PX + 1
    words = descriptors.shape[1]
    partner = np.full(len(descriptors), -1, np.int64)
    distance = np.full(len(descriptors), 64 * words, np.int64)
    for i in range(len(descriptors)):
        x_min, x_max, y_min, y_max = windows[i, 0], windows[i, 1], windows[i, 2], windows[i, 3]
        if not (x_min <= x_max and y_min <= y_max):
            continue
        c0 = min(max(int(x_min) // CELL_PX, 0), columns - 1)
        c1 = min(max(int(x_max) // CELL_PX, 0), columns - 1)
        r0 = min(max(int(y_min) // CELL_PX, 0), rows - 1)
        r1 = min(max(int(y_max) // CELL_PX, 0), rows - 1)
        best = second = np.uint64(64 * words)
        index = np.int64(-1)
        d0, d1 = descriptors[i, 0], descriptors[i, 1]
        for r in range(r0, r1 + 1):
            # The cells of one row follow each other: one run of candidates.
            for p in range(start[r * columns + c0], start[r * columns + c1 + 1]):
                j = order[p]
                x, y = other_pixels[j, 0], other_pixels[j, 1]
                if x < x_min or x > x_max or y < y_min or y > y_max:
                    continue
                if bright[i] != other_bright[j]:
                    continue
                bits = popcount(d0 ^ other_descriptors[j, 0])
                bits += popcount(d1 ^ other_descriptors[j, 1])
                if bits > coarse_bits or bits >= second:
                    continue
                for w in range(2, words):
                    bits += popcount(descriptors[i, w] ^ other_descriptors[j, w])
                if bits < best:
                    second = best
                    best = bits
                    index = j
                elif bits < second:
                    second = bits
        if index >= 0 and (ratio >= 1.0 or best < ratio * second):
            partner[i] = index
            distance[i] = best
    return partner, distance


def match_in_windows_reference(
    descriptors: NDArray[np.uint64],
    bright: NDArray[np.bool_],
    windows: NDArray[np.float32],
    other_pixels: NDArray[np.float32],
    other_descriptors: NDArray[np.uint64],
    other_bright: NDArray[np.bool_],
    coarse_bits: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Plain numpy form of ``match_in_windows`` without the ratio test, for tests."""
    partner = np.full(len(descriptors), -1, np.int64)
    distance = np.full(len(descriptors), 64 * descriptors.shape[1], np.int64)
    for i, (x_min, x_max, y_min, y_max) in enumerate(windows):
        x, y = other_pixels[:, 0], other_pixels[:, 1]
        inside = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        inside &= other_bright == bright[i]
        xor = (descriptors[i] ^ other_descriptors).view(np.uint8)
        bits = np.unpackbits(xor, axis=1)
        inside &= bits[:, :128].sum(axis=1) <= coarse_bits
        if not np.any(inside):
            continue
        total = np.where(inside, bits.sum(axis=1), np.iinfo(np.int64).max)
        partner[i] = int(np.argmin(total))
        distance[i] = int(total[partner[i]])
    return partner, distance
