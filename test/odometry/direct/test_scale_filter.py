"""How large a map is, and how well that is known."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.direct.scale_filter import ScaleFilter

WORTH = 56.0
"""Variance of a window over what it claims: 16 for what it is worth, 3.5 for its neighbours."""


def filter_of(variance, drift):
    found = ScaleFilter(drift, 0.0)
    found.update(0.0, np.sqrt(variance / WORTH))
    assert found.sigma == pytest.approx(np.sqrt(variance))
    return found


def test_before_the_first_window_nothing_is_known():
    found = ScaleFilter(0.001, 0.0)
    assert np.isinf(found.sigma)
    found.update(0.7, np.inf)
    assert (found.count, found.log_scale) == (0, 0.0)
    assert np.isinf(found.sigma)


def test_windows_that_tell_nothing_leave_the_drift():
    found = filter_of(0.01**2, 0.001)
    for _ in range(100):
        found.update(3.0, np.inf)
    assert found.sigma == pytest.approx(np.sqrt(0.01**2 + 100 * 0.001**2))
    assert found.count == 1


def test_what_a_window_hands_on_weighs_as_what_it_says():
    found = filter_of(0.01**2, 0.0)
    found.carry(0.0014**2)
    assert found.sigma == pytest.approx(np.sqrt(0.01**2 + 8.0 * WORTH * 0.0014**2))
    assert found.hold == pytest.approx(found.sigma / np.sqrt(WORTH))
    found.update(0.0, 0.01)
    assert found.sigma < 0.03


def test_a_young_map_drifts_more():
    found = ScaleFilter(0.001, 0.05)
    variances = []
    found.update(0.0, 1e-9)
    for _ in range(100):
        variances.append(found.sigma**2)
        found.update(0.0, np.inf)
    grown = np.sqrt(np.diff(variances))
    assert grown[0] == pytest.approx(np.hypot(0.001, 0.05 * np.exp(-1 / 12)))
    assert grown[11] == pytest.approx(np.hypot(0.001, 0.05 * np.exp(-1)))
    assert grown[-1] == pytest.approx(0.001, rel=0.01)


def test_without_drift_windows_are_averaged_as_they_weigh():
    found = ScaleFilter(0.0, 0.0)
    for log_scale, sigma in [(1.0, 0.01), (1.3, 0.02), (1.1, 0.01), (0.9, 0.02)]:
        found.update(log_scale, sigma)
    assert found.log_scale == pytest.approx((4 * 1.0 + 1.3 + 4 * 1.1 + 0.9) / 10)
    assert found.sigma == pytest.approx(0.01 * np.sqrt(WORTH / 2.5))
    assert found.count == 4


def test_one_window_far_off_moves_little():
    found, calm = filter_of(0.02**2, 0.0), filter_of(0.02**2, 0.0)
    found.update(2.0, 0.005)
    calm.update(0.02, 0.005)
    assert 0.0 < found.log_scale < 0.1
    assert found.sigma > calm.sigma


@pytest.mark.parametrize(("scatter", "agrees"), [(1.0, True), (10.0, False)])
def test_windows_that_scatter_more_than_they_claim_do_not_agree(rng, scatter, agrees):
    found = ScaleFilter(0.003, 0.0)
    assert not found.agrees
    for _ in range(40):
        found.update(1.0 + scatter * rng.normal(0.0, 0.02 * 4.0), 0.02)
    assert found.agrees is agrees
    for _ in range(16):
        found.update(found.log_scale, 0.02)
    assert found.agrees


def test_the_variance_is_that_of_errors_of_the_map(rng):
    drift, claimed = 0.002, 0.004
    off = np.zeros(4000)
    found = filter_of(1e-8, drift)
    found.settle()
    for _ in range(200):
        seen = off + rng.normal(0.0, np.sqrt(WORTH) * claimed, len(off))
        share = found.hold**2 / (found.hold**2 + claimed**2)
        off = off - share * seen + rng.normal(0.0, drift, len(off))
        found.update(0.0, claimed)
    assert 0.9 < float(np.std(off)) / found.sigma < 1.1


def test_it_finds_the_size_and_says_how_well(rng):
    errors = []
    for _ in range(200):
        found, true = ScaleFilter(0.003, 0.0), 1.2
        for _ in range(40):
            true += rng.normal(0.0, 0.003)
            found.update(true + rng.normal(0.0, 0.02 * np.sqrt(WORTH)), 0.02)
        errors.append((found.log_scale - true) / found.sigma)
    assert 0.8 < float(np.std(errors)) < 1.2
    assert abs(float(np.mean(errors))) < 0.3
