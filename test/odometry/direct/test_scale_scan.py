"""The scan over all sizes of a map."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.direct.scale_scan import scan_scales

from .test_photometric_bundle import two_bands


@pytest.mark.parametrize("unit", [0.5, 1.0, 2.0])
def test_the_cheapest_size_is_the_true_one(rng, unit):
    """Depths 10 % off and brightness that nobody knows do no harm."""
    problem = two_bands(rng, unit)
    mine = np.flatnonzero(problem.host_cameras == 1)
    rhos = problem.rhos[mine] * rng.uniform(0.9, 1.1, len(mine))
    patches = problem.patches[mine] + rng.normal(size=(len(mine), 1)) * 30
    log_scales = np.arange(np.log(0.2), np.log(5.0), 0.1)
    costs = np.zeros(len(log_scales))
    count = scan_scales(
        problem.images[1], problem.slots, problem.T_k_w, np.tile(np.eye(4), (3, 1, 1)),
        problem.cameras[1], problem.T_rig_camera[1], problem.hosts[mine], problem.bearings[mine],
        rhos, rhos, np.full(len(mine), 1e-3), patches, problem.trusts[mine],
        np.ascontiguousarray(problem.seen[mine][:, :, 1]), np.exp(-log_scales), 14.0, costs,
    )  # fmt: skip
    assert count == 2 * len(mine)
    # A unit of the map is 1 / unit metres.
    assert log_scales[np.argmin(costs)] == pytest.approx(-np.log(unit), abs=0.11)
    assert costs.max() > 5.0 * costs.min()
