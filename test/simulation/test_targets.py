from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.simulation.preset_targets import board_poses_of
from thermal_stereo_vo.simulation.presets import find_preset, plan_run
from thermal_stereo_vo.simulation.studio import Studio
from thermal_stereo_vo.simulation.targets import CHESSBOARD, MASK


def plan_of(preset: str):
    config = find_preset(preset).config
    return plan_run(preset, with_overrides(config, ("render.workers=0", "render.scale=0.5")))


def studio_of(preset: str):
    plan = plan_of(preset)
    return Studio(plan), plan


def projected(plan, role: str, T_rig_board: np.ndarray, points: np.ndarray) -> np.ndarray:
    T_camera_board = inverse(plan.rig[role].T_rig_camera) @ T_rig_board
    return plan.rig[role].camera.project(transform_points(T_camera_board, points))


@pytest.fixture(scope="module")
def aluminium():
    return studio_of("board_aluminium")


@pytest.mark.parametrize("role", [LEFT, RIGHT])
def test_chessboard_corners_lie_where_the_pose_says(aluminium, role: str) -> None:
    """Corners found in the picture agree with the projection through lens and pose to 0.06 px."""
    studio, plan = aluminium
    errors = []
    for index in (4, 12, 22):
        expected = projected(plan, role, board_poses_of(plan)[index], CHESSBOARD.corners_m())
        assert np.all((expected > 5) & (expected < [314, 234])), "the board leaves the picture"
        image = cv2.GaussianBlur(studio.render(role, float(index)).radiance, (0, 0), 0.7)
        low, high = np.percentile(image, (1, 99))
        grey = np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)
        found = cv2.cornerSubPix(
            grey, expected.astype(np.float32).reshape(-1, 1, 2), (5, 5), (-1, -1),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4),
        ).reshape(-1, 2)  # fmt: skip
        errors.append(found - expected)
    errors = np.concatenate(errors)
    assert np.all(np.abs(np.median(errors, axis=0)) < 0.03)
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.06


def test_aluminium_mirrors_the_cold_sky(aluminium) -> None:
    studio, plan = aluminium
    pose = board_poses_of(plan)[4]
    image = studio.render(LEFT, 4.0).radiance
    s = CHESSBOARD.square_m
    centres = np.array([[(j - 4) * s, (i - 3) * s, 0] for i in range(7) for j in range(9)])
    pixels = np.rint(projected(plan, LEFT, pose, centres)).astype(int)
    values = image[pixels[:, 1], pixels[:, 0]]
    paint = np.array([(i + j) % 2 == 1 for i in range(7) for j in range(9)])
    # 20 to 90 K of contrast, at some 25 counts a kelvin.
    assert 500 < np.median(values[paint]) - np.median(values[~paint]) < 1600


def test_the_mask_shows_warm_holes_where_the_pose_says() -> None:
    studio, plan = studio_of("board_mask")
    pose = board_poses_of(plan)[4]
    image = studio.render(LEFT, 4.0).radiance
    holes = MASK.holes_m()
    assert holes.shape == (24, 4, 3)
    inside = np.rint(projected(plan, LEFT, pose, holes.mean(axis=1))).astype(int)
    between = holes.mean(axis=1)[:-1] * 0.5 + holes.mean(axis=1)[1:] * 0.5
    beside = np.rint(projected(plan, LEFT, pose, between[np.arange(23) % 6 != 5])).astype(int)
    warm, cool = image[inside[:, 1], inside[:, 0]], image[beside[:, 1], beside[:, 0]]
    assert warm.min() > cool.max() + 200


def test_poses_cover_the_picture() -> None:
    plan = plan_of("board_mask")
    centres = np.array(
        [projected(plan, LEFT, T, np.zeros((1, 3)))[0] for T in board_poses_of(plan)]
    )
    assert len(centres) == 27
    assert np.ptp(centres[:, 0]) > 65
    assert np.ptp(centres[:, 1]) > 65
