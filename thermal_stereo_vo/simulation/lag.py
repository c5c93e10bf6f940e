"""Why a bolometer smears: each pixel remembers the radiance of the last few milliseconds.

A first-order pixel shows ``y(t) = int exp(-s / tau) x(t - s) ds / tau``.  The integral is a mean
over instants that all weigh the same.  Those pictures are rendered, or made from the picture at t
by moving it along the flow that the known depth and motion give.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def exponential_delays(count: int) -> NDArray[np.float64]:
    """(count,) delays in units of tau: the mean of each of ``count`` equal shares of exp(-s).

    Their mean is exactly 1, that of the exponential.

    >>> bool(abs(exponential_delays(8).mean() - 1.0) < 1e-12)
    True
    """
    edges = -np.log1p(-np.arange(count) / count)
    tail = np.exp(-edges) * (edges + 1.0)  # integral of s exp(-s) from the edge on
    return np.asarray(-np.diff(np.append(tail, 0.0)) * count)


def uniform_delays(count: int) -> NDArray[np.float64]:
    """(count,) delays in units of an exposure that ends now."""
    return (np.arange(count) + 0.5) / count


@njit(cache=True, nogil=True, error_model="numpy")
def backward_flow(
    centres: NDArray[np.float32],
    pixels_per_plane: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    owner: NDArray[np.int32],
    T_then_now: NDArray[np.float64],
    flow_px: NDArray[np.float32],
) -> float:
    """How far (px) what a pixel shows now lay from it then; fills (H, W, 2), returns the largest.

    ``T_then_now`` (1 + M, 4, 4) takes camera coordinates now to those then, for what stands still
    and for each mover.
    """
    height, width = depth_m.shape
    T, J = T_then_now, pixels_per_plane
    largest = 0.0
    for y in range(height):
        for x in range(width):
            m = owner[y, x] + 1
            u = np.float64(centres[y, x, 0])
            v = np.float64(centres[y, x, 1])
            inverse = 1.0 / depth_m[y, x]  # 0 for sky
            px = T[m, 0, 0] * u + T[m, 0, 1] * v + T[m, 0, 2] + inverse * T[m, 0, 3]
            py = T[m, 1, 0] * u + T[m, 1, 1] * v + T[m, 1, 2] + inverse * T[m, 1, 3]
            pz = T[m, 2, 0] * u + T[m, 2, 1] * v + T[m, 2, 2] + inverse * T[m, 2, 3]
            pz = max(pz, 0.05)
            du = px / pz - u
            dv = py / pz - v
            fx = J[y, x, 0, 0] * du + J[y, x, 0, 1] * dv
            fy = J[y, x, 1, 0] * du + J[y, x, 1, 1] * dv
            flow_px[y, x, 0] = fx
            flow_px[y, x, 1] = fy
            largest = max(largest, max(abs(fx), abs(fy)))
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def smear(
    image: NDArray[np.float32],
    flow_px: NDArray[np.float32],
    few: NDArray[np.float64],
    delays: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Mean of the image moved along its flow for each of the ``delays`` (in units of the flow).

    ``flow_px`` (H, W, 2) is where things came from; pixels beyond the border repeat the border.
    Where the flow is less than a pixel the ``few`` delays are enough.
    """
    height, width = image.shape
    for y in range(height):
        for x in range(width):
            fx = flow_px[y, x, 0]
            fy = flow_px[y, x, 1]
            if abs(fx) + abs(fy) < 0.01:
                out[y, x] = image[y, x]
                continue
            # What was in this pixel a delay ago has moved on, against the backward flow.
            chosen = delays if fx * fx + fy * fy > 1.0 else few
            total = 0.0
            for delay in chosen:
                px = min(max(x - delay * fx, 0.0), width - 1.001)
                py = min(max(y - delay * fy, 0.0), height - 1.001)
                j = int(px)
                i = int(py)
                u = px - j
                v = py - i
                total += (1.0 - v) * ((1.0 - u) * image[i, j] + u * image[i, j + 1]) + v * (
                    (1.0 - u) * image[i + 1, j] + u * image[i + 1, j + 1]
                )
            out[y, x] = total / len(chosen)
