"""How large a window is, and how surely that is handed on."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry.direct.map_size import (
    SolvedWindow,
    size_of,
    slopes_of_size,
    variance_of_newest,
)

STEP_M = 0.1


def window(rng, keyframes=5):
    """(K, 4, 4) keyframes along a way, somewhere in the world."""
    T = [exp_se3(rng.normal(size=6))]
    for _ in range(keyframes - 1):
        T.append(exp_se3(rng.normal(scale=STEP_M, size=6)) @ T[-1])
    return np.stack(T)


def moved(T, shifts):
    return np.stack([exp_se3(d) @ T_k for d, T_k in zip(shifts, T, strict=True)])


def test_slopes_are_those_of_the_size(rng):
    T = window(rng)
    slopes = slopes_of_size(T)
    small = 1e-6
    for k in range(len(T)):
        for i in range(6):
            shift = np.zeros((len(T), 6))
            shift[k, i] = small
            there, back = size_of(moved(T, shift)), size_of(moved(T, -shift))
            numeric = (np.log(there) - np.log(back)) / (2.0 * small)
            assert numeric == pytest.approx(slopes[k, i] if i < 3 else 0.0, abs=1e-4)


def test_what_is_handed_on_errs_as_claimed(rng):
    T = window(rng)
    root = 1e-3 * rng.normal(size=(24, 24))
    solved = SolvedWindow((4, 0, 2, 3, 1), T, root @ root.T)
    kept = [1, 2, 3]
    shares = []
    for _ in range(4000):
        shifts = np.concatenate([np.zeros(6), root @ rng.normal(size=24)]).reshape(5, 6)
        found = moved(T, shifts)
        shares.append(np.log(size_of(found[[2, 3, 4]]) / size_of(found)))
    claimed = np.sqrt(solved.variance_of_rest(kept))
    assert claimed == pytest.approx(np.std(shares), rel=0.1)


def test_the_whole_hands_on_all_and_a_small_part_little(rng):
    T = window(rng)
    T[3] = exp_se3(np.array([0.003, 0.0, 0.0, 0.0, 0.0, 0.0])) @ T[2]
    solved = SolvedWindow((0, 1, 2, 3, 4), T, 1e-6 * np.eye(24))
    assert solved.variance_of_rest([0, 1, 2, 3, 4]) == pytest.approx(0.0, abs=1e-12)
    # Errors of 1 mm in both ends of a way of 3 mm.
    assert np.sqrt(solved.variance_of_rest([2, 3])) == pytest.approx(np.sqrt(2.0) / 3.0, rel=0.05)
    assert solved.variance_of_rest([3]) == 0.0


@pytest.mark.parametrize("away_m", [0.05, 0.5])
def test_the_newest_is_as_unsure_as_its_step(away_m):
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, 0, 3] = away_m
    covariance = np.diag([1e-6, 4e-6, 9e-6, 1.0, 1.0, 1.0])
    assert np.sqrt(variance_of_newest(T, covariance)) == pytest.approx(1e-3 / away_m)
