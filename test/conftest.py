"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from .textured_room import TexturedRoom

REPOSITORY = Path(__file__).resolve().parent.parent
SHARED_DATA = REPOSITORY.parent / "shared" / "data"

# No deadline: the first call of a kernel compiles it, and a machine may be busy.
settings.register_profile(
    "thermal_stereo_vo",
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("thermal_stereo_vo")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260214)


@pytest.fixture(scope="session")
def recording():
    """``recording("kitti_residential")``: the folder of a real recording, or skip."""

    def find(name: str) -> Path:
        folder = SHARED_DATA / name
        if not folder.exists():
            pytest.skip(f"the recording '{name}' is not on this machine (looked in {SHARED_DATA})")
        return folder

    return find


@pytest.fixture(scope="session")
def room() -> TexturedRoom:
    """A small world that is drawn exactly, for tests that need images of a moving stereo rig."""
    return TexturedRoom()
