"""Holes in a mask that is not infinitely thin.

A mask of some millimetres shows the wall of each hole on the side away from the camera, neither as
cold as the mask nor as warm as the panel behind.  The fitted edge then lies between front and back
edge, at an effective depth behind the front; and warm edges make all holes a little wider.  Both
numbers are the same in all views and are estimated with the cameras: without them a drawn mask of
6 mm costs 0.35 % of focal length and 4 % of a distance of 20 m.

Where the wall of only one side shows at a corner, the fit of a corner with equal edges also errs
along the other side, and where both show it errs along both, in proportion to the walls that are
seen.  These two ratios are estimated as well: the eyes of a pair see opposite walls, so that what
is left of this would pass for disparity.
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

WIDENING, DEPTH, SINGLE, DOUBLE = 0, 1, 2, 3


def hole_sides(target: Target) -> Array | None:
    """(count, 2) which sides of its hole meet in each corner: -1 left or upper, +1 right or lower.

    None for boards without holes.
    """
    if target.kind is not TargetKind.MASK:
        return None
    columns, rows = target.grid
    j, i = np.mgrid[:rows, :columns]
    return np.stack([i % 2 * 2 - 1, j % 2 * 2 - 1], axis=-1).reshape(-1, 2).astype(np.float64)


def prior_sigma(target: Target) -> Array:
    """(4,) what holes may reasonably be.

    As wide and as deep as a tenth and a quarter of their side (m); ratios of a tenth.
    """
    if target.kind is not TargetKind.MASK:
        return np.zeros(0)
    return np.array([0.1 * target.spacing_m, 0.25 * target.spacing_m, 0.1, 0.1])


def seen_corners(
    points_m: Array, sides: Array, board: Array, camera_m: Array
) -> tuple[Array, Array]:
    """Hole corners (K, 3) as seen on the front plane from ``camera_m`` (3,), in board axes.

    ``board`` (4,) holds widening and depth in m and the two ratios.  A side whose wall faces the
    camera is seen at the effective depth, projected onto the front plane.  Also the derivatives
    (K, 3, 4).
    """
    widening, depth, single, double = board
    seen = points_m.copy()
    derivative = np.zeros((len(points_m), 3, 4))
    walls, lengths = np.zeros((2, len(points_m)), bool), np.zeros((2, len(points_m)))
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
        walls[axis], lengths[axis] = wall, np.abs(camera_m[axis] - points_m[:, axis])
    for axis, other in ((0, 1), (1, 0)):
        alone = sides[:, axis] * np.where(walls[other] & ~walls[axis], lengths[other], 0.0)
        both = sides[:, axis] * np.where(walls.all(0), np.sqrt(lengths.prod(0)), 0.0)
        seen[:, axis] += share * (single * alone + double * both)
        derivative[:, axis, DEPTH] += by_depth * (single * alone + double * both)
        derivative[:, axis, SINGLE] = share * alone
        derivative[:, axis, DOUBLE] = share * both
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
