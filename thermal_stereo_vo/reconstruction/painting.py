"""Temperatures of one camera on the points of another, where that camera really sees them.

Points are drawn into the camera with a depth buffer; those behind another surface keep no colour.
(The overlay of Dai et al. 2019, Fig. 10.)
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import Matrix, transform_points

_LARGEST_RADIUS_PX = 12
FARTHEST_PROJECTION = 2.0
"""Tangent beyond which lens models are not trusted."""


def painted(
    xyz_m: NDArray[np.floating],
    image: NDArray[Any],
    camera: Camera,
    T_camera_points: Matrix,
    *,
    point_size_m: float = 0.05,
    tolerance: float = 0.03,
) -> NDArray[np.float32]:
    """(N,) float32 values of the image at the points (N, 3), NaN where the camera sees none.

    ``image`` (H, W) are raw counts or temperatures as ``camera``, distortion included, shows them.
    Each point covers ``point_size_m`` when it hides others; one is hidden when it lies farther
    behind the nearest than ``tolerance`` of its own distance.
    """
    seen = transform_points(T_camera_points, xyz_m)
    values = np.full(len(seen), np.nan, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangent = np.linalg.norm(seen[:, :2], axis=1) / seen[:, 2]
    front = np.nonzero((seen[:, 2] > 0.0) & (tangent < FARTHEST_PROJECTION))[0]
    pixels = camera.project(seen[front])
    inside = np.all((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5), axis=1)
    front, pixels = front[inside], pixels[inside]
    if len(front) == 0:
        return values
    depth_m = seen[front, 2]
    nearest_m = depth_buffer(pixels, depth_m, camera, point_size_m)
    x, y = np.rint(pixels).astype(np.intp).T
    visible = depth_m <= nearest_m[y, x] * (1.0 + tolerance)
    values[front[visible]] = _interpolated(image, pixels[visible])
    return values


def _interpolated(image: NDArray[Any], pixels: NDArray[np.floating]) -> NDArray[np.float32]:
    """(N,) bilinear; the rim of the image goes on outside."""
    height, width = image.shape
    x = np.clip(pixels[:, 0], 0.0, width - 1.0)
    y = np.clip(pixels[:, 1], 0.0, height - 1.0)
    left = np.minimum(x.astype(np.intp), max(width - 2, 0))
    above = np.minimum(y.astype(np.intp), max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(above + 1, height - 1)
    u, v = x - left, y - above
    upper = (1.0 - u) * image[above, left] + u * image[above, right]
    lower = (1.0 - u) * image[below, left] + u * image[below, right]
    return np.asarray((1.0 - v) * upper + v * lower, np.float32)


def depth_buffer(
    pixels: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    camera: Camera,
    point_size_m: float,
) -> NDArray[np.float64]:
    """(H, W) distance of the nearest point in each pixel, inf where there is none.

    ``pixels`` (N, 2) lie in the image; a point is a square of ``point_size_m``.
    """
    buffer = np.full((camera.height, camera.width), np.inf)
    radius = np.ceil(0.5 * point_size_m * camera.fx / depth_m).astype(np.intp)
    x, y = np.rint(pixels).astype(np.intp).T
    for size in np.unique(np.minimum(radius, _LARGEST_RADIUS_PX)):
        chosen = np.minimum(radius, _LARGEST_RADIUS_PX) == size
        layer = np.full_like(buffer, np.inf)
        np.minimum.at(layer, (y[chosen], x[chosen]), depth_m[chosen])
        square = np.ones((2 * size + 1, 2 * size + 1), np.uint8)
        # Erosion is the minimum over the square.
        spread = cv2.erode(layer.astype(np.float32), square, borderType=cv2.BORDER_REPLICATE)
        np.minimum(buffer, spread, out=buffer)
    return buffer
