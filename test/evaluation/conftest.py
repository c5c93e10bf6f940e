"""A flight with known truth, and estimates of it with known errors."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3

EPOCH_NS = 1_700_000_000_123_456_789


def make_flight(
    rng: np.random.Generator, n: int = 400, rate_hz: float = 20.0, step_m: float = 0.4
) -> Trajectory:
    """A winding way forwards along z of the rig, ``n`` frames, in an arbitrary world."""
    T = exp_se3(rng.normal(size=6) * (50, 50, 50, 1, 1, 1))
    turn = 0.06 * np.sin(np.arange(n) * 0.05 + rng.uniform(0, 6))
    poses = []
    for i in range(n):
        poses.append(T)
        T = T @ exp_se3([0.0, 0.02 * np.cos(0.1 * i), step_m, 0.01 * np.cos(0.03 * i), turn[i], 0])
    stamps_ns = EPOCH_NS + np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64)
    return Trajectory(stamps_ns, np.array(poses))


def make_odometry(
    truth: Trajectory, rng: np.random.Generator, scale: float = 1.0, noise: float = 1.0
) -> Trajectory:
    """Integrated motion from the identity: steps times ``scale``, with 5 mm and 0.5 mrad noise."""
    T = np.eye(4)
    poses = [T]
    for a, b in zip(truth.T_world_rig[:-1], truth.T_world_rig[1:], strict=True):
        step = np.linalg.inv(a) @ b
        step[:3, 3] *= scale
        xi = noise * rng.normal(size=6) * (0.005, 0.005, 0.005, 5e-4, 5e-4, 5e-4)
        T = T @ step @ exp_se3(xi)
        poses.append(T)
    return Trajectory(truth.stamps_ns, np.array(poses))


@pytest.fixture
def flight():
    return make_flight


@pytest.fixture
def odometry():
    return make_odometry
