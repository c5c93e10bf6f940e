"""Board views without pictures: projected points with noise, for estimators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermal_stereo_vo.calibration.bundle import Observation
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardShot, BoardView
from thermal_stereo_vo.core.cameras import Camera, DistortionModel
from thermal_stereo_vo.core.transforms import exp_so3, make_transform

LEFT = Camera(
    640, 480, 522.336, 520.021, 317.889, 261.055,
    DistortionModel.RADIAL_TANGENTIAL, (-0.2851, 0.0864, -0.0033, 0.0011),
)  # fmt: skip
RIGHT = Camera(
    640, 480, 521.756, 518.796, 319.770, 248.446,
    DistortionModel.RADIAL_TANGENTIAL, (-0.2901, 0.0966, -0.0032, 0.0011),
)  # fmt: skip
T_RIGHT_LEFT = make_transform(
    exp_so3([-0.0145, -0.0121, 0.0037]), np.array([-0.2678441, 0.0004702, 0.000585])
)


def view_of(
    camera: Camera,
    target: Target,
    T_camera_board: np.ndarray,
    rng: np.random.Generator,
    noise_px: float,
) -> BoardView | None:
    """The points of the board inside the image, with noise; None below half of them."""
    points = target.points_m @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    pixels = camera.project(points)
    ids = np.flatnonzero(((pixels >= 0) & (pixels <= np.array(camera.size) - 1.0)).all(1))
    if len(ids) < 0.5 * target.count:
        return None
    noisy = pixels[ids] + rng.normal(0.0, noise_px, (len(ids), 2))
    return BoardView(ids, noisy, np.full(len(ids), max(noise_px, 0.01)))


def made_up_shots(
    target: Target,
    count: int,
    rng: np.random.Generator,
    *,
    noise_px: float = 0.1,
    left: Camera = LEFT,
    right: Camera = RIGHT,
    T_right_left: np.ndarray = T_RIGHT_LEFT,
    tilt_deg: float = 30.0,
) -> tuple[list[BoardShot], list[np.ndarray]]:
    """Shots of both cameras, and T_left_board of each."""
    middle = target.points_m.mean(0)
    shots, poses = [], []
    for k in range(count):
        a, b = np.radians(tilt_deg) * np.array([np.sin(2.4 * k), np.cos(2.4 * k)])
        R = exp_so3([0.0, b, 0.0]) @ exp_so3([a, 0.0, 0.0]) @ exp_so3([0, 0, 0.3 * np.sin(k)])
        z = rng.uniform(0.9, 1.3)
        place = [0.25 * ((k % 3) - 1) + 0.12, 0.2 * ((k // 3 % 3) - 1), 1.0]
        T = make_transform(R, z * np.array(place) - R @ middle)
        views = {
            "left": view_of(left, target, T, rng, noise_px),
            "right": view_of(right, target, T_right_left @ T, rng, noise_px),
        }
        shots.append(BoardShot(f"{k:02d}", {r: v for r, v in views.items() if v is not None}))
        poses.append(T)
    return shots, poses


def observations_of(target: Target, shots: Sequence[BoardShot]) -> list[Observation]:
    """All views of the left (camera 0) and the right eye (camera 1) for ``solve``."""
    points = target.points_m
    return [
        Observation(v, c, points[view.ids], view.pixels, np.ones(len(view)))
        for v, shot in enumerate(shots)
        for c, role in enumerate(("left", "right"))
        if (view := shot.views.get(role)) is not None
    ]
