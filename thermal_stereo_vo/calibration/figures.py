"""The figures by which a calibration is judged.

P1 judges by the mean reprojection error (equation 1) and the epipolar error (Table III).  The
epipolar error is blind to a turn of the rig about its vertical axis and to the scale: both only
shift disparity.  Hence the third kind: distances between neighbouring corners and to the board,
measured with both eyes and compared with the board itself and with each eye alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.initial import board_pose
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardShot, BoardView
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import inverse, skew, transform_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelErrors:
    """Reprojection: mean of the norms (P1 equation 1) and their root mean square, px."""

    mean_px: float
    rms_px: float
    points: int
    views: int


@dataclass(frozen=True)
class StereoErrors:
    """What a pair of cameras gets wrong on a set of board views.

    ``epipolar_12_px`` is the mean distance of second-image points to the epipolar lines of their
    first-image partners, ``epipolar_21_px`` the other way, on undistorted points.
    ``spacing_error_percent`` is the mean of triangulated neighbour distances against the board's
    (a scale error, or a wrong square size); ``spacing_rms_m`` their scatter about that mean.  Both
    are measured along the board's own direction, as the depth noise of a far board would make the
    plain distance of two points too long.
    ``plane_rms_m`` is the scatter of triangulated points about a plane.
    ``distance_error_percent`` compares the distance of the board by triangulation with that by the
    first eye alone; ``yaw_error_rad`` is the relative yaw that would explain how this difference
    grows with distance.  ``in_front`` is the share of points in front of both cameras.
    """

    epipolar_12_px: float
    epipolar_21_px: float
    spacing_error_percent: float
    spacing_rms_m: float
    plane_rms_m: float
    distance_error_percent: float
    yaw_error_rad: float
    in_front: float
    points: int
    views: int

    def as_dict(self) -> dict[str, float]:
        """Plain numbers for a file."""
        return asdict(self)


@dataclass(frozen=True)
class PairView:
    """The points that both cameras saw in one shot: ``ids`` (K,), pixels (K, 2) each."""

    name: str
    ids: NDArray[np.int64]
    first: Array
    second: Array


def paired(name: str, first: BoardView, second: BoardView) -> PairView | None:
    """What two views of one shot have in common, or None when that is less than four points."""
    ids, i, j = np.intersect1d(first.ids, second.ids, return_indices=True)
    if len(ids) < 4:
        return None
    return PairView(name, ids, first.pixels[i], second.pixels[j])


def pair_views(
    shots: Sequence[BoardShot], roles: Sequence[str], indices: Sequence[int] | None = None
) -> list[PairView]:
    """What both cameras saw in each of the shots."""
    chosen = range(len(shots)) if indices is None else indices
    found = []
    for v in chosen:
        views = shots[v].views
        if all(role in views for role in roles):
            both = paired(shots[v].name, views[roles[0]], views[roles[1]])
            if both is not None:
                found.append(both)
    return found


def pixel_errors(residuals: Sequence[Array]) -> PixelErrors:
    """Figures of residuals, one (K, 2) array a view."""
    norms = np.concatenate([np.linalg.norm(r, axis=1) for r in residuals])
    return PixelErrors(
        float(norms.mean()), float(np.sqrt(np.mean(norms**2))), len(norms), len(residuals)
    )


def fundamental(first: Camera, second: Camera, T_second_first: Array) -> Array:
    """(3, 3) F with x_second' F x_first = 0 for undistorted homogeneous pixels."""
    R, t = T_second_first[:3, :3], T_second_first[:3, 3]
    return np.asarray(np.linalg.inv(second.matrix).T @ skew(t) @ R @ np.linalg.inv(first.matrix))


def undistorted(camera: Camera, pixels: Array) -> Array:
    """(N, 2) pixels to the pixels (N, 2) of the same camera with an ideal lens."""
    return np.asarray((camera.unproject(pixels) @ camera.matrix.T)[:, :2])


def epipolar_errors(
    first: Camera, second: Camera, T_second_first: Array, view: PairView
) -> tuple[Array, Array]:
    """(K,) distances in px: second points to lines of the first, and the other way round."""
    F = fundamental(first, second, T_second_first)
    ones = np.ones((len(view.ids), 1))
    x1 = np.hstack([undistorted(first, view.first), ones])
    x2 = np.hstack([undistorted(second, view.second), ones])
    lines2, lines1 = x1 @ F.T, x2 @ F
    product = np.abs(np.sum(x2 * lines2, axis=1))
    return (
        product / np.maximum(np.linalg.norm(lines2[:, :2], axis=1), 1e-30),
        product / np.maximum(np.linalg.norm(lines1[:, :2], axis=1), 1e-30),
    )


def triangulated(first: Camera, second: Camera, T_second_first: Array, view: PairView) -> Array:
    """(K, 3) points in first-camera axes: midpoints of the two rays."""
    T_first_second = inverse(T_second_first)
    a = first.unproject(view.first)
    b = second.unproject(view.second) @ T_first_second[:3, :3].T
    c = T_first_second[:3, 3]
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    ac, bc = a @ c, b @ c
    determinant = np.where(np.abs(aa * bb - ab**2) < 1e-15, np.nan, aa * bb - ab**2)
    s = (bb * ac - ab * bc) / determinant
    t = (ab * ac - aa * bc) / determinant
    return np.asarray(0.5 * (s[:, None] * a + c + t[:, None] * b))


def stereo_errors(
    first: Camera,
    second: Camera,
    T_second_first: Array,
    target: Target,
    views: Sequence[PairView],
) -> StereoErrors:
    """All figures of a pair on some views (``views`` must not be empty)."""
    board = target.points_m
    columns, _ = target.grid
    e12, e21, ratios, nominal, planes, apart, front = [], [], [], [], [], [], []
    for view in views:
        forward, backward = epipolar_errors(first, second, T_second_first, view)
        e12.append(forward)
        e21.append(backward)
        points = triangulated(first, second, T_second_first, view)
        in_second = transform_points(T_second_first, points)
        front.append((points[:, 2] > 0) & (in_second[:, 2] > 0))
        directions = board[view.ids] @ _alignment(board[view.ids], points).T
        index = {int(p): k for k, p in enumerate(view.ids)}
        for p, k in index.items():
            neighbours = [p + 1] if (p + 1) % columns else []
            for q in (*neighbours, p + columns):
                if q in index:
                    step = directions[index[q]] - directions[k]
                    length = float(np.linalg.norm(step))
                    nominal.append(length)
                    ratios.append(float((points[index[q]] - points[k]) @ step) / length**2)
        centred = points - points.mean(0)
        planes.append(np.linalg.svd(centred, compute_uv=False)[2] / np.sqrt(len(points)))
        alone = transform_points(board_pose(first, board[view.ids], view.first), board[view.ids])
        z, z_alone = float(points[:, 2].mean()), float(alone[:, 2].mean())
        apart.append((z, z / z_alone - 1.0))
    z, relative = np.array(apart).T
    ratio, lengths = np.array(ratios), np.array(nominal)
    scale = float(ratio.mean())
    baseline_m = float(np.linalg.norm(T_second_first[:3, 3]))
    # dz / z = z yaw / baseline: the slope through the origin of the relative error over z.
    yaw_rad = float(z @ (relative - (scale - 1.0)) / max(z @ z, 1e-30)) * baseline_m
    return StereoErrors(
        epipolar_12_px=float(np.concatenate(e12).mean()),
        epipolar_21_px=float(np.concatenate(e21).mean()),
        spacing_error_percent=100.0 * (scale - 1.0),
        spacing_rms_m=float(np.sqrt(np.mean(((ratio - scale) * lengths) ** 2))),
        plane_rms_m=float(np.sqrt(np.mean(np.square(planes)))),
        distance_error_percent=100.0 * float(relative.mean()),
        yaw_error_rad=yaw_rad,
        in_front=float(np.concatenate(front).mean()),
        points=int(sum(len(v.ids) for v in views)),
        views=len(views),
    )


def merged(parts: Sequence[StereoErrors]) -> StereoErrors | None:
    """Means over folds weighted by points; root mean squares combine as such."""
    if not parts:
        return None
    weights = np.array([p.points for p in parts], dtype=np.float64)
    weights /= weights.sum()

    def mean(name: str) -> float:
        return float(weights @ [getattr(p, name) for p in parts])

    def rms(name: str) -> float:
        return float(np.sqrt(weights @ [getattr(p, name) ** 2 for p in parts]))

    return StereoErrors(
        epipolar_12_px=mean("epipolar_12_px"),
        epipolar_21_px=mean("epipolar_21_px"),
        spacing_error_percent=mean("spacing_error_percent"),
        spacing_rms_m=rms("spacing_rms_m"),
        plane_rms_m=rms("plane_rms_m"),
        distance_error_percent=mean("distance_error_percent"),
        yaw_error_rad=mean("yaw_error_rad"),
        in_front=mean("in_front"),
        points=sum(p.points for p in parts),
        views=sum(p.views for p in parts),
    )


def _alignment(board: Array, points: Array) -> Array:
    """(3, 3) rotation that turns the board (K, 3) nearest to the points (Kabsch)."""
    a, b = board - board.mean(0), points - points.mean(0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
