"""Random fields of several octaves along a surface.

Value noise after Perlin (1985): random numbers on a square lattice with a smooth blend between, and
each octave turned against the one before so that no lattice shows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

LATTICE_BITS = 8
LATTICE = 1 << LATTICE_BITS
_MASK = LATTICE - 1

OCTAVE_COS, OCTAVE_SIN = 0.6, 0.8
"""Turn from one octave to the next."""

NOISE_SIGMA = 0.45
"""Standard deviation of ``value_noise``."""

NOISE_SLOPE = 1.14
"""Mean slope of ``value_noise`` where it crosses zero, per lattice cell."""


def random_lattice(rng: np.random.Generator) -> NDArray[np.float32]:
    """(256 * 256,) float32 values, uniform in -1..1, first coordinate fastest."""
    return rng.uniform(-1.0, 1.0, LATTICE * LATTICE).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def value_noise(lattice: NDArray[np.float32], a: float, b: float) -> float:
    """Noise in -1..1 at a point given in lattice cells; repeats after 256 cells."""
    fa = np.floor(a)
    fb = np.floor(b)
    u = a - fa
    v = b - fb
    u = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    v = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    i0 = int(fa) & _MASK
    i1 = (i0 + 1) & _MASK
    j0 = (int(fb) & _MASK) << LATTICE_BITS
    j1 = ((int(fb) + 1) & _MASK) << LATTICE_BITS
    low = lattice[j0 + i0] + u * (lattice[j0 + i1] - lattice[j0 + i0])
    high = lattice[j1 + i0] + u * (lattice[j1 + i1] - lattice[j1 + i0])
    return float(low + v * (high - low))


def value_noise_reference(
    lattice: NDArray[np.float32], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``value_noise`` at (N, 2) points, in plain numpy."""
    grid = lattice.reshape(LATTICE, LATTICE).astype(np.float64)
    cell = np.floor(points).astype(np.int64)
    f = points - cell
    fade = f**3 * (f * (f * 6.0 - 15.0) + 10.0)
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2):
        a, b = ((cell + corner) & _MASK).T
        total += np.where(np.array(corner) == 1, fade, 1.0 - fade).prod(axis=1) * grid[b, a]
    return total
