"""Holes in a mask that is not infinitely thin.

A mask of some millimetres shows the wall of each hole on the side away from the camera, neither as
cold as the mask nor as warm as the panel behind.  The fitted edge then lies between front and back
edge, at an effective depth behind the front; and warm edges make all holes a little wider.  Both
numbers are the same in all views and are estimated with the cameras: without them a 6 mm mask
costs half a percent of focal length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.initial import board_pose
from thermal_stereo_vo.calibration.targets import Target, TargetKind
from thermal_stereo_vo.calibration.views import BoardView
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import inverse, transform_points

Array = NDArray[np.float64]

WIDENING, DEPTH = 0, 1


def hole_sides(target: Target) -> Array | None:
    """(count, 2) which sides of its hole meet in each corner: -1 left or upper, +1 right or lower.

    None for boards without holes.
    """
    if target.kind is not TargetKind.MASK:
        return None
    columns, rows = target.grid
    j, i = np.mgrid[:rows, :columns]
    return np.stack([i % 2 * 2 - 1, j % 2 * 2 - 1], axis=-1).reshape(-1, 2).astype(np.float64)


def prior_sigma_m(target: Target) -> Array:
    """(2,) how wide and how deep holes may reasonably be: a tenth and a quarter of their side."""
    if target.kind is not TargetKind.MASK:
        return np.zeros(0)
    return np.array([0.1, 0.25]) * target.spacing_m


def seen_corners(
    points_m: Array, sides: Array, board: Array, camera_m: Array
) -> tuple[Array, Array]:
    """Hole corners (K, 3) as seen on the front plane from ``camera_m`` (3,), in board axes.

    ``board`` holds widening and depth in m.  A side whose wall faces the camera is seen at the
    effective depth, projected onto the front plane.  Also the derivatives (K, 3, 2).
    """
    widening, depth = board
    seen = points_m.copy()
    derivative = np.zeros((len(points_m), 3, 2))
    height = -camera_m[2]
    share = depth / (depth + height)
    by_depth = height / (depth + height) ** 2
    for axis in range(2):
        edge = points_m[:, axis] + 0.5 * widening * sides[:, axis]
        towards = camera_m[axis] - edge
        # The wall of a left side is seen by a camera to its right, and so on.
        wall = sides[:, axis] * towards < 0.0
        seen[:, axis] = edge + np.where(wall, share * towards, 0.0)
        derivative[:, axis, WIDENING] = 0.5 * sides[:, axis] * np.where(wall, 1.0 - share, 1.0)
        derivative[:, axis, DEPTH] = np.where(wall, by_depth * towards, 0.0)
    return seen, derivative


def flattened(view: BoardView, camera: Camera, target: Target, board: Array) -> BoardView:
    """The view as it would be of a mask without thickness; other boards stay as they are."""
    sides = hole_sides(target)
    if sides is None or len(board) == 0:
        return view
    points = target.points_m[view.ids]
    pixels = view.pixels
    for _ in range(2):
        T_camera_board = board_pose(camera, points, pixels)
        camera_m = inverse(T_camera_board)[:3, 3]
        seen, _ = seen_corners(points, sides[view.ids], board, camera_m)
        thick = camera.project(transform_points(T_camera_board, seen))
        flat = camera.project(transform_points(T_camera_board, points))
        pixels = view.pixels - (thick - flat)
    return BoardView(view.ids, pixels, view.sigma_px, view.blur_px, view.contrast)
