"""Dense points on a calibration board, which is a plane where its corners say it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.detection import detect
from thermal_stereo_vo.calibration.image_sources import ImageShot
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.frames import RadiometricFrame
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.stereo.dense import DenseConfig, DenseStereo, DisparityMap
from thermal_stereo_vo.stereo.dense_cloud import points_of
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier, assemble

Array = NDArray[np.float64]

LEAST_POINTS = 100
STRAY_M = 0.02
_SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class BoardPlane:
    """The dense points inside the corners of one board.

    ``coverage`` is the share of pixels with a point; ``distance_m`` that of the fitted plane along
    the ray through the middle of the board, ``corner_distance_m`` that of the plane of the
    triangulated corners; ``residual_m`` the standard deviation of the points about their own plane,
    as the median tells it, ``strays`` the share of those more than 2 cm off, ``angle_deg`` between
    both planes.
    """

    name: str
    points: int
    coverage: float
    distance_m: float
    corner_distance_m: float
    residual_m: float
    strays: float
    angle_deg: float


def board_planes(
    shots: Sequence[ImageShot], target: Target, calibration: RigCalibration, config: DenseConfig
) -> Iterator[BoardPlane]:
    """A plane for each pair whose board is found by both eyes and seen densely."""
    rectifier = Rectifier(calibration, RectificationConfig())
    stereo = DenseStereo(config)
    for shot in shots:
        if LEFT not in shot.load or RIGHT not in shot.load:
            continue
        corners = _rectified_corners(shot, target, calibration, rectifier)
        if corners is None:
            continue
        plane = _plane(shot.name, _seen(shot, rectifier, stereo), *corners)
        if plane is not None:
            yield plane


def shot_map(shot: ImageShot, calibration: RigCalibration, config: DenseConfig) -> DisparityMap:
    """The disparities of one pair."""
    return _seen(shot, Rectifier(calibration, RectificationConfig()), DenseStereo(config))


def _seen(shot: ImageShot, rectifier: Rectifier, stereo: DenseStereo) -> DisparityMap:
    left, right = (RadiometricFrame(shot.load[role](), 0, role) for role in (LEFT, RIGHT))
    disparities = stereo.process(assemble(rectifier, left, right, 0))
    assert disparities is not None
    return disparities


def _rectified_corners(
    shot: ImageShot, target: Target, calibration: RigCalibration, rectifier: Rectifier
) -> tuple[Array, Array] | None:
    """Corners seen by both eyes, (N, 2) each, in the rectified images."""
    found = {role: detect(shot.load[role](), target).view for role in (LEFT, RIGHT)}
    left, right = found[LEFT], found[RIGHT]
    if left is None or right is None:
        return None
    _, first, second = np.intersect1d(left.ids, right.ids, return_indices=True)
    if len(first) < 4:
        return None
    new = rectifier.rectified_calibration
    rotations = {
        # Both rectified cameras are turned alike.
        role: rectifier.T_rig_rectified[:3, :3].T @ calibration[role].T_rig_camera[:3, :3]
        for role in (LEFT, RIGHT)
    }
    pixels = []
    for role, view, rows in ((LEFT, left, first), (RIGHT, right, second)):
        rays = calibration[role].camera.unproject(view.pixels[rows])
        pixels.append(new[role].camera.project(rays @ rotations[role].T))
    return pixels[0], pixels[1]


def _plane(name: str, disparities: DisparityMap, left: Array, right: Array) -> BoardPlane | None:
    camera = disparities.camera
    inside = np.zeros(disparities.disparity_px.shape, np.uint8)
    hull = cv2.convexHull(np.rint(left).astype(np.int32))
    cv2.fillConvexPoly(inside, hull, 1)
    rows, columns, depth_m = points_of(disparities)
    on_board = inside[rows, columns] > 0
    if on_board.sum() < LEAST_POINTS:
        return None
    pixels = np.column_stack([columns, rows])[on_board].astype(np.float64)
    dense = _points(camera.unproject(pixels), depth_m[on_board])
    parallax = left[:, 0] - right[:, 0] - (camera.cx - disparities.right_cx)
    corners = _points(camera.unproject(left), camera.fx * disparities.baseline_m / parallax)
    middle = camera.unproject(left.mean(axis=0)[None])[0]
    normal, offset = fitted_plane(dense)
    corner_normal, corner_offset = fitted_plane(corners)
    off_m = dense @ normal - offset
    return BoardPlane(
        name=name,
        points=int(on_board.sum()),
        coverage=float(on_board.sum() / inside.sum()),
        distance_m=float(np.linalg.norm(middle) * offset / (normal @ middle)),
        corner_distance_m=float(np.linalg.norm(middle) * corner_offset / (corner_normal @ middle)),
        residual_m=float(_SIGMA_OF_MEDIAN * np.median(np.abs(off_m))),
        strays=float(np.mean(np.abs(off_m) > STRAY_M)),
        angle_deg=float(np.degrees(np.arccos(min(1.0, abs(float(normal @ corner_normal)))))),
    )


def _points(rays: Array, depth_m: NDArray[np.floating]) -> Array:
    return np.asarray(rays * np.asarray(depth_m, np.float64)[:, None])


def fitted_plane(points_m: Array) -> tuple[Array, float]:
    """Unit normal (3,) and offset (m) with ``normal . p = offset``, offset positive.

    Least squares, again without what lies farther off than three standard deviations (of the
    median), three times.
    """
    chosen = points_m
    for _ in range(4):
        centre = chosen.mean(axis=0)
        normal = np.linalg.svd(chosen - centre, full_matrices=False)[2][2]
        off = points_m @ normal - centre @ normal
        limit = max(3.0 * _SIGMA_OF_MEDIAN * float(np.median(np.abs(off))), 1e-9)
        chosen = points_m[np.abs(off) <= limit]
    offset = float(centre @ normal)
    return (normal, offset) if offset >= 0.0 else (-normal, -offset)


def plane_report(planes: Sequence[BoardPlane]) -> str:
    """A row for each board."""
    header = ["pair", "points", "covered (%)", "distance (m)", "by corners (m)",
              "residual (mm)", "strays (%)", "angle (deg)"]  # fmt: skip
    rows = [
        [
            plane.name,
            str(plane.points),
            f"{100 * plane.coverage:.0f}",
            f"{plane.distance_m:.4f}",
            f"{plane.corner_distance_m:.4f}",
            f"{1e3 * plane.residual_m:.2f}",
            f"{100 * plane.strays:.1f}",
            f"{plane.angle_deg:.2f}",
        ]
        for plane in planes
    ]
    return format_table(header, rows)
