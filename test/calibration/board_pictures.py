"""Pictures of flat boards through a distorted lens, by supersampling; nothing of the package's own
detectors or estimators is used."""

from __future__ import annotations

import cv2
import numpy as np

from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform

_SAMPLES = 13


class BoardStage:
    """A camera before which boards are held."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        # A Fibonacci lattice: 13 samples a pixel at 13 different x and 13 different y, so that no
        # edge along rows or columns is placed in coarse steps.
        k = np.arange(_SAMPLES)
        dx, dy = (k + 0.5) / _SAMPLES - 0.5, (8 * k % _SAMPLES + 0.5) / _SAMPLES - 0.5
        y, x = np.mgrid[: camera.height, : camera.width]
        x, y = x[:, :, None] + dx, y[:, :, None] + dy
        self._rays = camera.unproject(np.column_stack([x.ravel(), y.ravel()]))

    def picture(
        self,
        target: Target,
        T_camera_board: np.ndarray,
        rng: np.random.Generator,
        *,
        coated: float = 3400.0,
        plain: float = 3000.0,
        background: float = 3100.0,
        noise: float = 2.0,
        blur_px: float = 0.7,
        hot_spot: float = 0.0,
        thickness_m: float = 0.0,
        wall: float = 0.3,
    ) -> np.ndarray:
        """(H, W) uint16 counts.

        ``hot_spot`` counts are added at the middle of the board, falling off over half its width.
        A mask of ``thickness_m`` shows hole walls, ``wall`` of the way from mask to panel.
        """
        xy, far = self._on_plane(T_camera_board, 0.0)
        low, high = target.outline_m[0], target.outline_m[2]
        on_board = np.all((xy > low) & (xy < high), axis=1) & ~far
        marked = target.marked(xy)
        share = marked.astype(float)
        if thickness_m:
            behind, _ = self._on_plane(T_camera_board, thickness_m)
            share = np.where(marked, np.where(target.marked(behind), 1.0, wall), 0.0)
        counts = np.where(on_board, plain + (coated - plain) * share, background)
        middle = 0.5 * (low + high)
        radius = 0.3 * np.linalg.norm(high - low)
        distance = np.sum((xy - middle) ** 2, axis=1) / radius**2
        counts = counts + np.where(on_board, hot_spot * np.exp(-0.5 * distance), 0.0)
        width, height = self.camera.size
        image = counts.reshape(height, width, _SAMPLES).mean(2)
        image = cv2.GaussianBlur(image, (0, 0), blur_px) + rng.normal(0.0, noise, image.shape)
        return np.clip(np.rint(image), 0, 16383).astype(np.uint16)

    def pixels(self, target: Target, T_camera_board: np.ndarray) -> np.ndarray:
        """(count, 2) where the points of the board really are."""
        points = target.points_m @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
        return self.camera.project(points)

    def _on_plane(self, T_camera_board: np.ndarray, depth_m: float):
        T_board_camera = inverse(T_camera_board)
        directions = self._rays @ T_board_camera[:3, :3].T
        origin = T_board_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (depth_m - origin[2]) / directions[:, 2]
        far = ~(s > 0)
        s = np.where(far, 0.0, s)
        return origin[:2] + s[:, None] * directions[:, :2], far


def held(target: Target, tilt_deg, place, distance_m: float) -> np.ndarray:
    """(4, 4) T_camera_board of a board turned by ``tilt_deg`` (x, y, z) about its own middle.

    ``place`` (x, y) is where the middle lies, in units of distance.
    """
    points = target.points_m
    middle = 0.5 * (points.min(0) + points.max(0))
    x, y, z = np.radians(tilt_deg)
    R = exp_so3([0.0, y, 0.0]) @ exp_so3([x, 0.0, 0.0]) @ exp_so3([0.0, 0.0, z])
    centre = distance_m * np.array([place[0], place[1], 1.0])
    return make_transform(R, centre - R @ middle)


def spread_poses(target: Target, count: int, distance_m: float, rng: np.random.Generator):
    """Boards over the whole picture, tilted in all directions."""
    poses = []
    for k in range(count):
        tilt = [28.0 * np.sin(2.4 * k), 30.0 * np.cos(2.4 * k), 12.0 * np.sin(1.1 * k + 1.0)]
        place = (0.22 * ((k % 3) - 1), 0.16 * ((k // 3 % 3) - 1))
        poses.append(held(target, tilt, place, distance_m * rng.uniform(0.85, 1.2)))
    return poses
