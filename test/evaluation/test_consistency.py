from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from thermal_stereo_vo.core.transforms import exp_se3, exp_so3
from thermal_stereo_vo.evaluation.consistency import nees, nees_band, pose_errors


def disturbed(rng, covariances, scale=1.0):
    """True poses and estimates whose errors are drawn from the covariances times ``scale``."""
    true, estimated = [], []
    for P in covariances:
        T = exp_se3(rng.normal(size=6) * (9, 9, 9, 1, 1, 1))
        e = rng.multivariate_normal(np.zeros(6), scale * P)
        T_true = T.copy()
        T_true[:3, 3] += e[:3]
        T_true[:3, :3] = exp_so3(e[3:]) @ T[:3, :3]
        true.append(T_true)
        estimated.append(T)
    return np.array(true), np.array(estimated)


def covariances(rng, n):
    roots = rng.normal(size=(n, 6, 6)) * np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])[:, None]
    return roots @ roots.transpose(0, 2, 1) + 1e-8 * np.eye(6)


def test_errors_drawn_from_the_covariance_fall_into_the_band(rng):
    P = covariances(rng, 3000)
    values = nees(*disturbed(rng, P), P)
    low, high = nees_band(3000, 6, 0.999)
    assert 5.7 < low < np.mean(values) < high < 6.3
    # The whole distribution is chi-squared, not only its mean.
    inside = np.mean(values < chi2.ppf(0.9, 6))
    assert 0.88 < inside < 0.92


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_too_proud_and_too_modest_covariances_fall_out_of_it(scale, rng):
    P = covariances(rng, 3000)
    mean = np.mean(nees(*disturbed(rng, P, scale), P))
    low, high = nees_band(3000, 6, 0.999)
    assert mean < low if scale < 1 else mean > high
    assert mean == pytest.approx(6 * scale, rel=0.05)


def test_errors_are_those_the_covariance_speaks_of():
    T = exp_se3([1, 2, 3, 0.5, 0.2, -0.4])
    T_true = T.copy()
    T_true[:3, 3] += (0.1, 0.2, 0.3)
    T_true[:3, :3] = exp_so3([0.01, -0.02, 0.03]) @ T[:3, :3]
    np.testing.assert_allclose(
        pose_errors(T_true[None], T[None]), [[0.1, 0.2, 0.3, 0.01, -0.02, 0.03]], atol=1e-12
    )


def test_a_pose_that_is_certain_has_no_nees():
    values = nees(np.eye(4)[None], np.eye(4)[None], np.zeros((1, 6, 6)))
    assert np.isnan(values).all()


def test_band_of_one_value_is_the_chi_squared_interval():
    low, high = nees_band(1, 6, 0.95)
    assert low == pytest.approx(1.237, abs=1e-3)  # tables of the distribution
    assert high == pytest.approx(14.449, abs=1e-3)
