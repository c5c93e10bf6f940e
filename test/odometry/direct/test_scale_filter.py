"""How well the size of a map is known."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.direct.scale_filter import ScaleFilter


def test_windows_that_tell_nothing_leave_the_drift():
    known = ScaleFilter(0.01**2, 0.001)
    for _ in range(100):
        known.update(np.inf)
    assert known.sigma == pytest.approx(np.sqrt(0.01**2 + 100 * 0.001**2))


def test_without_drift_windows_are_averaged():
    known = ScaleFilter(1e6, 0.0)
    for _ in range(56 * 4):
        known.update(0.01)
    # 56 = 8 * 7 of them are worth one that told the truth about itself.
    assert known.sigma == pytest.approx(0.01 / 2.0, rel=1e-6)


def test_the_variance_is_that_of_errors_of_the_filter(rng):
    drift, claimed = 0.002, 0.004
    off = np.zeros(4000)
    known = ScaleFilter(1e-8, drift)
    for _ in range(200):
        # A window that claims 0.004 is worth sqrt(56) times that; the map moves by its own share.
        seen = off + rng.normal(0.0, np.sqrt(56) * claimed, len(off))
        share = known.hold**2 / (known.hold**2 + claimed**2)
        off = off - share * seen + rng.normal(0.0, drift, len(off))
        known.update(claimed)
    assert 0.9 < float(np.std(off)) / known.sigma < 1.1
