"""Where slender things pass: a coarse grid of rays would miss them now and then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.sampling import CORNERS, DETAILED, SIMPLE


class LensModel(NamedTuple):
    """Pinhole with radial-tangential distortion, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float


@njit(cache=True, nogil=True, error_model="numpy")
def mark_slender(
    thin: NDArray[np.float32],
    T_camera_map: NDArray[np.float64],
    lens: LensModel,
    limits_px: tuple[float, float, float],
    mask: NDArray[np.uint8],
) -> None:
    """Raise the blocks of ``mask`` (H / 2, W / 2) that slender parts (K, 7) cross.

    ``limits_px``: parts narrower than the first are invisible, below the second they ask for
    DETAILED, below the third for CORNERS, and wider ones for nothing.
    """
    near_m, side = 0.3, 1.3
    rows, columns = mask.shape
    R = T_camera_map
    ends = np.empty((2, 3))
    for n in range(len(thin)):
        w = lens.fx * thin[n, 6]
        for e in range(2):
            for k in range(3):
                ends[e, k] = R[k, 3]
                for m in range(3):
                    ends[e, k] += R[k, m] * thin[n, 3 * e + m]
        far = max(ends[0, 2], ends[1, 2])
        near = max(min(ends[0, 2], ends[1, 2]), near_m)
        if far < near_m or w > limits_px[2] * far or w < limits_px[0] * near:
            continue
        for e in range(2):
            if ends[e, 2] < near_m:
                f = (near_m - ends[e, 2]) / (ends[1 - e, 2] - ends[e, 2])
                for k in range(3):
                    ends[e, k] += f * (ends[1 - e, k] - ends[e, k])
        ax, ay = ends[0, 0] / ends[0, 2], ends[0, 1] / ends[0, 2]
        bx, by = ends[1, 0] / ends[1, 2], ends[1, 1] / ends[1, 2]
        if min(ax, bx) > side or max(ax, bx) < -side or min(ay, by) > side or max(ay, by) < -side:
            continue
        steps = int(0.5 * max(abs(bx - ax) * lens.fx, abs(by - ay) * lens.fy)) + 1
        for i in range(steps + 1):
            # Straight on the plane z = 1; the width belongs to the depth there.
            f = i / steps
            x = ax + f * (bx - ax)
            y = ay + f * (by - ay)
            if abs(x) > side or abs(y) > side:
                continue
            z = 1.0 / ((1.0 - f) / ends[0, 2] + f / ends[1, 2])
            level = SIMPLE
            if w < limits_px[1] * z:
                level = DETAILED
            elif w < limits_px[2] * z:
                level = CORNERS
            if level == SIMPLE or w < limits_px[0] * z:
                continue
            r = x * x + y * y
            radial = 1.0 + r * (lens.k1 + r * (lens.k2 + r * lens.k3))
            u = lens.fx * (x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r + 2.0 * x * x))
            v = lens.fy * (y * radial + lens.p1 * (r + 2.0 * y * y) + 2.0 * lens.p2 * x * y)
            # The block that holds the point, and the nearest one in either direction.
            u = 0.5 * (u + lens.cx + 0.5)
            v = 0.5 * (v + lens.cy + 0.5)
            j, i0 = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            for row in range(max(i0, 0), min(i0 + 2, rows)):
                for column in range(max(j, 0), min(j + 2, columns)):
                    if mask[row, column] < level:
                        mask[row, column] = level
