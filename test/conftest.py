"""Fixtures shared by all tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
SHARED_DATA = REPOSITORY.parent / "shared" / "data"


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
