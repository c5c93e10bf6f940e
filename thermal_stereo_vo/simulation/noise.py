"""Random fields of several octaves, evaluated at points in space.

Value noise after Perlin (1985): random numbers on a cubic lattice with a smooth blend between, and
each octave turned against the one before so that no lattice shows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

LATTICE_BITS = 6
LATTICE = 1 << LATTICE_BITS
_MASK = LATTICE - 1

ROTATION = np.array(
    [[0.36, 0.48, -0.80], [-0.80, 0.60, 0.00], [0.48, 0.64, 0.60]], dtype=np.float64
)
"""(3, 3) turn from one octave to the next."""

SHIFT = np.array([17.31, 5.77, 31.13], dtype=np.float64)
"""(3,) shift from one octave to the next, in lattice cells."""


def random_lattice(rng: np.random.Generator) -> NDArray[np.float32]:
    """(64 * 64 * 64,) float32 values, uniform in -1..1, x fastest: the source of all octaves."""
    return rng.uniform(-1.0, 1.0, LATTICE**3).astype(np.float32)


@njit(cache=True, nogil=True, inline="always")
def value_noise(lattice: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Noise in -1..1 at a point given in lattice cells; repeats after 64 cells."""
    fx = np.floor(x)
    fy = np.floor(y)
    fz = np.floor(z)
    u = x - fx
    v = y - fy
    w = z - fz
    u = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    v = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    w = w * w * w * (w * (w * 6.0 - 15.0) + 10.0)
    i0 = int(fx) & _MASK
    i1 = (i0 + 1) & _MASK
    j0 = (int(fy) & _MASK) << LATTICE_BITS
    j1 = ((int(fy) + 1) & _MASK) << LATTICE_BITS
    k0 = (int(fz) & _MASK) << (2 * LATTICE_BITS)
    k1 = ((int(fz) + 1) & _MASK) << (2 * LATTICE_BITS)
    a = lattice[k0 + j0 + i0] * (1.0 - u) + lattice[k0 + j0 + i1] * u
    b = lattice[k0 + j1 + i0] * (1.0 - u) + lattice[k0 + j1 + i1] * u
    c = lattice[k1 + j0 + i0] * (1.0 - u) + lattice[k1 + j0 + i1] * u
    d = lattice[k1 + j1 + i0] * (1.0 - u) + lattice[k1 + j1 + i1] * u
    return (a * (1.0 - v) + b * v) * (1.0 - w) + (c * (1.0 - v) + d * v) * w


def value_noise_reference(
    lattice: NDArray[np.float32], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``value_noise`` at (N, 3) points, in plain numpy."""
    grid = lattice.reshape(LATTICE, LATTICE, LATTICE).astype(np.float64)
    cell = np.floor(points).astype(np.int64)
    f = points - cell
    fade = f**3 * (f * (f * 6.0 - 15.0) + 10.0)
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        x, y, z = ((cell + corner) & _MASK).T
        weight = np.where(np.array(corner) == 1, fade, 1.0 - fade).prod(axis=1)
        total += weight * grid[z, y, x]
    return total


def octave_weight(spacing_m: float, footprint_m: float) -> float:
    """How much of an octave of this lattice spacing survives a pixel of this footprint, 0..1.

    An octave finer than the pixel is averaged away by it; leaving it in would alias into noise that
    moves with the camera.
    """
    fraction = min(max(spacing_m / max(footprint_m, 1e-9) - 1.0, 0.0), 1.0)
    return fraction * fraction * (3.0 - 2.0 * fraction)
