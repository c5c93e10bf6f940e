"""Take the memory out of a bolometer's image: what it would show without its time constant.

A first-order pixel y follows the scene x by tau dy/dt = x - y, so that x = y + tau dy/dt.  Where
the scene stands still and the camera moves, brightness moves with the optical flow v of its pixels,
dy/dt = -grad(y) v, and one image is enough: x = y - tau grad(y) v.  The smear, its delay, and the
contrast that it takes from edges across the motion go together.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def camera_twist(
    twist: NDArray[np.float64], T_camera_rig: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(6,) linear and angular velocity of a camera in its own axes, from those (6,) of its rig."""
    R, T_rig_camera = T_camera_rig[:3, :3], -T_camera_rig[:3, :3].T @ T_camera_rig[:3, 3]
    return np.concatenate([R @ (twist[:3] + np.cross(twist[3:], T_rig_camera)), R @ twist[3:]])


@njit(cache=True, nogil=True)
def without_memory(image, tau_s, twist, rho, camera, out):  # type: ignore[no-untyped-def]
    """Write ``image`` (H, W) as a camera without time constant would have taken it.

    ``twist`` (6,) velocity of the camera (m/s, rad/s) in its own axes; ``rho`` inverse depth of the
    scene (1/m), for flow by translation; ``camera`` (4,) fx fy cx cy; ``out`` (H, W) float32.
    """
    height, width = image.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    a, b, c = rho * twist[0], rho * twist[1], rho * twist[2]
    p, q, s = twist[3], twist[4], twist[5]
    half = 0.5 * tau_s
    # Flow is a polynomial of the column: at + by * x + of * x^2.  Single precision is that of out.
    x = ((np.arange(width) - cx) / fx).astype(np.float32)
    for i in range(height):
        y = (i - cy) / fy
        x0, x1, x2 = (
            np.float32(half * fx * (y * s - a - q)),
            np.float32(half * fx * (c + y * p)),
            (np.float32(-half * fx * q)),
        )
        y0, y1 = (
            np.float32(half * fy * (y * c - b + (1.0 + y * y) * p)),
            np.float32(half * fy * (-y * q - s)),
        )
        row, up, down = image[i], image[max(i - 1, 0)], image[min(i + 1, height - 1)]
        to = out[i]
        for j in range(1, width - 1):
            dx = np.float32(row[j + 1]) - np.float32(row[j - 1])
            dy = np.float32(down[j]) - np.float32(up[j])
            flow_x, flow_y = x0 + x[j] * (x1 + x[j] * x2), y0 + x[j] * y1
            to[j] = np.float32(row[j]) - dx * flow_x - dy * flow_y
        for j in (0, width - 1):
            left, right = max(j - 1, 0), min(j + 1, width - 1)
            dx = np.float32(row[right]) - np.float32(row[left])
            dy = np.float32(down[j]) - np.float32(up[j])
            flow_x, flow_y = x0 + x[j] * (x1 + x[j] * x2), y0 + x[j] * y1
            to[j] = np.float32(row[j]) - dx * flow_x - dy * flow_y
