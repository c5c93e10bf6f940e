"""Constant velocity, and what coasting costs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry.motion_prior import (
    ConstantVelocity,
    coasting_covariance,
    coasting_twist_covariance,
)

durations = st.floats(1e-3, 2.0)


def test_nothing_known_is_no_motion():
    prior = ConstantVelocity()
    assert prior.twist is None
    np.testing.assert_array_equal(prior.predict(0.5), np.eye(4))


def test_the_measured_motion_goes_on_in_proportion():
    prior = ConstantVelocity()
    xi = np.array([0.2, -0.1, 1.0, 0.05, 0.2, -0.1])
    prior.update(exp_se3(xi), 0.5)
    np.testing.assert_allclose(prior.twist, 2.0 * xi, atol=1e-9)
    np.testing.assert_allclose(prior.predict(0.5), exp_se3(xi), atol=1e-9)
    np.testing.assert_allclose(prior.predict(1.0), exp_se3(xi) @ exp_se3(xi), atol=1e-9)
    prior.forget()
    assert prior.twist is None


@pytest.mark.parametrize(("step_s", "averaged"), [(0.1, 1), (0.05, 2), (1.0 / 30.0, 3), (0.5, 1)])
def test_a_gap_begins_with_the_mean_of_the_last_tenth_of_a_second(step_s, averaged):
    prior = ConstantVelocity()
    rates = np.arange(1.0, 8.0)
    for rate in rates:
        prior.update(exp_se3(np.array([0, 0, rate, 0, 0.1 * rate, 0]) * step_s), step_s)
    assert prior.twist[2] == pytest.approx(7.0, abs=1e-6)
    for _ in range(2):  # once is enough
        prior.coast()
        np.testing.assert_allclose(prior.twist[2], rates[-averaged:].mean(), atol=1e-6)
        np.testing.assert_allclose(prior.twist[4], 0.1 * rates[-averaged:].mean(), atol=1e-6)
    prior.forget()
    prior.coast()
    assert prior.twist is None


def test_noise_moves_the_twist_no_further_than_an_acceleration_could():
    """Of 100 noisy steps at constant speed the twist is surer than any one of them."""
    rng, step_s, sigma_m = np.random.default_rng(1), 0.05, 0.03
    covariance = np.diag([sigma_m**2] * 3 + [1e-10] * 3)
    places = 2.0 * step_s * np.arange(101) + sigma_m * rng.standard_normal(101)
    prior, found, measured = ConstantVelocity(), [], np.diff(places) / step_s
    for way in np.diff(places):
        prior.update(exp_se3([0, 0, way, 0, 0.01, 0]), step_s, covariance)
        found.append(prior.twist.copy())
    assert np.std(measured[20:]) > 0.7
    assert np.std(np.array(found)[20:, 2]) < 0.35 * np.std(measured[20:])
    assert np.mean(np.array(found)[20:, 2]) == pytest.approx(2.0, abs=0.1)
    np.testing.assert_allclose(np.array(found)[:, 4], 0.2, atol=1e-3)
    sure = np.diag([1e-10] * 6)
    prior.update(exp_se3([0, 0, 0.4, 0, 0, 0]), step_s, sure)
    assert prior.twist[2] == pytest.approx(8.0, abs=0.01)


def test_coasting_costs_what_the_accelerations_may_do():
    """0.5 s at 3 m/s^2 and 2 rad/s^2: 0.375 m, 0.25 rad, 1.5 m/s and 1 rad/s (one sigma)."""
    sigma = np.sqrt(np.diag(coasting_covariance(0.0, 0.5)))
    np.testing.assert_allclose(sigma, [0.375] * 3 + [0.25] * 3)
    sigma = np.sqrt(np.diag(coasting_twist_covariance(0.5)))
    np.testing.assert_allclose(sigma, [1.5] * 3 + [1.0] * 3)


@given(durations, st.lists(st.floats(0.01, 1.0), min_size=1, max_size=8))
def test_many_short_gaps_cost_as_much_as_one_long(total_s, shares):
    """However many frames fall into a gap, the covariance at its end is the same."""
    steps = np.array(shares) / sum(shares) * total_s
    covariance, unseen_s = np.zeros((6, 6)), 0.0
    for step_s in steps:
        covariance += coasting_covariance(unseen_s, step_s)
        unseen_s += step_s
    np.testing.assert_allclose(covariance, coasting_covariance(0.0, total_s), rtol=1e-9)


@given(durations, durations)
def test_longer_is_never_surer(a_s, b_s):
    short, long = sorted((a_s, b_s))
    assert np.all(np.diag(coasting_covariance(0.0, long) - coasting_covariance(0.0, short)) >= 0)
    assert coasting_covariance(short, long)[0, 0] > 0
    assert coasting_twist_covariance(long)[0, 0] >= coasting_twist_covariance(short)[0, 0]


def test_nothing_unseen_costs_nothing():
    assert coasting_covariance(0.3, 0.0) == pytest.approx(np.zeros((6, 6)))


def test_another_unit_changes_lengths_and_no_angles():
    prior = ConstantVelocity()
    prior.rescale(3.0)  # nothing known yet
    prior.update(exp_se3([0.1, 0.2, 0.0, 0.0, 0.3, 0.0]), 0.5)
    before = prior.twist.copy()
    prior.rescale(3.0)
    np.testing.assert_allclose(prior.twist[:3], 3.0 * before[:3])
    np.testing.assert_allclose(prior.twist[3:], before[3:])
    prior.coast()  # on what was measured before, in the same unit
    np.testing.assert_allclose(prior.twist[:3], 3.0 * before[:3])
