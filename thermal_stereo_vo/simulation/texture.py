"""Texture of a surface: octaves, patches, cracks and tiles, band-limited to the pixel.

Every octave finer than the pixel is faded out, so that nothing aliases into noise that moves with
the camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.noise import (
    LATTICE,
    NOISE_SIGMA,
    NOISE_SLOPE,
    OCTAVE_COS,
    OCTAVE_SIN,
    value_noise,
)
from thermal_stereo_vo.simulation.thermal_field import Column

# Plain numbers: older numba does not index with an enumeration.
_AMPLITUDE, _SPACING = int(Column.AMPLITUDE), int(Column.SPACING)
_OCTAVES, _PERSISTENCE = int(Column.OCTAVES), int(Column.PERSISTENCE)
_CRACKS, _PATCHES = int(Column.CRACKS), int(Column.PATCHES)
_CELL_ALONG, _CELL_UP = int(Column.CELL_ALONG), int(Column.CELL_UP)
_CELLS, _JOINTS = int(Column.CELLS), int(Column.JOINTS)

_LINE_HALF_WIDTH_M = 0.015
_CRACKS_SEEN_M = 20 * _LINE_HALF_WIDTH_M


class Patches(NamedTuple):
    """What ``vary`` must know of N points, float64 but for the material.

    ``material`` (N,) int32 row of the table, or -1 for none.  ``a`` and ``b`` are metres along the
    surface; the pixel covers ``along_m`` in the unit direction (``way_a``, ``way_b``) and
    ``across_m`` in the other.
    """

    material: NDArray[np.int32]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    way_a: NDArray[np.float64]
    way_b: NDArray[np.float64]
    across_m: NDArray[np.float64]
    along_m: NDArray[np.float64]


def empty_patches(count: int) -> Patches:
    """Room for ``count`` points."""
    return Patches(np.empty(count, np.int32), *(np.empty(count) for _ in range(6)))


@njit(cache=True, nogil=True, error_model="numpy")
def vary(
    lattice: NDArray[np.float32],
    table: NDArray[np.float64],
    patches: Patches,
    count: int,
    out: NDArray[np.float64],
) -> None:
    """Variation (count,) of the materials at those points, in the unit of their amplitudes."""
    materials, places_a, places_b = patches.material, patches.a, patches.b
    ways_a, ways_b = patches.way_a, patches.way_b
    acrosses, alongs = patches.across_m, patches.along_m
    for n in range(count):
        m = materials[n]
        value = 0.0
        if m < 0:
            out[n] = value
            continue
        a, b, across_m, along_m = places_a[n], places_b[n], acrosses[n], alongs[n]
        spacing = table[m, _SPACING]
        pa = a / spacing
        pb = b / spacing
        line_m = max(_LINE_HALF_WIDTH_M, across_m)
        if table[m, _CRACKS] != 0.0 and across_m < _CRACKS_SEEN_M:
            noise = value_noise(lattice, pa + 7.7, pb + 40.9)
            off = abs(noise) * spacing / NOISE_SLOPE / line_m
            if off < 1.0:
                value += table[m, _CRACKS] * _LINE_HALF_WIDTH_M / line_m * (1.0 - off)
        if table[m, _PATCHES] != 0.0:
            noise = value_noise(lattice, 0.4 * pa + 29.3, 0.4 * pb + 11.9)
            border_m = max(2.0 * _LINE_HALF_WIDTH_M, across_m)
            step = 0.5 + noise * 2.5 * spacing / NOISE_SLOPE / border_m
            value += table[m, _PATCHES] * (min(max(step, 0.0), 1.0) - 0.5)

        if table[m, _CELL_ALONG] > 0.0:  # tiles that differ from each other, and their joints
            size = table[m, _CELL_ALONG]
            up = table[m, _CELL_UP]
            ib = 0.0
            edge_m = 1e9
            if up > 0.0:
                cb = b / up
                ib = np.floor(cb)
                edge_m = min(cb - ib, ib + 1.0 - cb) * up
                size = min(size, up)
            fade = min(max(size / across_m - 1.0, 0.0), 1.0)
            if fade > 0.0:
                ca = a / table[m, _CELL_ALONG] + 0.5 * (int(ib) & 1)
                ia = np.floor(ca)
                edge_m = min(edge_m, min(ca - ia, ia + 1.0 - ca) * table[m, _CELL_ALONG])
                number = ((int(ia) * 73856093) ^ (int(ib) * 19349663)) & (LATTICE**2 - 1)
                value += table[m, _CELLS] * lattice[number] * fade
                if edge_m < line_m:
                    joint = _LINE_HALF_WIDTH_M / line_m * (1.0 - edge_m / line_m)
                    value += table[m, _JOINTS] * joint * fade

        amplitude = table[m, _AMPLITUDE] / NOISE_SIGMA
        persistence = table[m, _PERSISTENCE]
        da = ways_a[n] * along_m / spacing
        db = ways_b[n] * along_m / spacing
        for _ in range(int(table[m, _OCTAVES])):
            samples = 1
            footprint_m = along_m
            if along_m > 0.5 * spacing:
                samples = min(4, int(2.0 * along_m / spacing) + 1)
                footprint_m = along_m / samples
            weight = min(spacing / max(across_m, footprint_m) - 1.0, 1.0)
            if weight <= 0.0:
                break
            weight *= amplitude * weight * (3.0 - 2.0 * weight)
            if samples == 1:
                value += weight * value_noise(lattice, pa, pb)
            else:
                total = 0.0
                for i in range(samples):
                    f = (i + 0.5) / samples - 0.5
                    total += value_noise(lattice, pa + f * da, pb + f * db)
                value += weight * total / samples
            amplitude *= persistence
            spacing *= 0.5
            pa, pb = (
                2.0 * (OCTAVE_COS * pa - OCTAVE_SIN * pb) + 17.31,
                2.0 * (OCTAVE_SIN * pa + OCTAVE_COS * pb) + 5.77,
            )
            da, db = (
                2.0 * (OCTAVE_COS * da - OCTAVE_SIN * db),
                2.0 * (OCTAVE_SIN * da + OCTAVE_COS * db),
            )
        out[n] = value
