"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
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


@pytest.fixture
def ros_domain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The number of a ROS domain on this machine that no other test has meanwhile."""
    folder = Path(tempfile.gettempdir(), f"thermal_stereo_vo_ros_domains_{os.getuid()}")
    folder.mkdir(exist_ok=True)
    # 101 is the last that is free on every system; the measurement of the onboard node takes it.
    for domain in range(1, 101):
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
            monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
            yield domain
            return
    pytest.fail(f"all ROS domains are taken: see {folder}")
