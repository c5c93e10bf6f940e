from __future__ import annotations

import pytest

from thermal_stereo_vo.core.cameras import Camera, DistortionModel

from .board_pictures import BoardStage, held, spread_poses

LENS = Camera(
    320, 240, 261.2, 260.0, 158.7, 122.4,
    DistortionModel.RADIAL_TANGENTIAL, (-0.285, 0.086, -0.0033, 0.0011),
)  # fmt: skip


@pytest.fixture(scope="session")
def stage():
    """A small camera with the lens of the paper, before which boards are held."""
    return BoardStage(LENS)


@pytest.fixture(scope="session")
def hold():
    return held


@pytest.fixture(scope="session")
def poses_over_the_picture():
    return spread_poses
