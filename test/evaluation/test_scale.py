"""Runs that find their unit of length late, if ever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.evaluation.scale import scale_report

PERIOD_NS = 50_000_000
FRAMES = 200


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    t = np.linspace(0.0, 10.0, FRAMES)
    ways = [[np.sin(a), 0.3 * a, np.cos(2 * a), 0.1 * np.sin(a), 0.2, 0.0] for a in t]
    return Trajectory(np.arange(FRAMES) * PERIOD_NS, np.array([exp_se3(xi) for xi in ways]))


def run(truth, scale, converged, scale_before=3.0):
    """The true way in another world, ``scale`` times as long from frame ``converged`` on."""
    T_world_map = exp_se3([1.0, 2.0, -1.0, 0.3, 0.5, -0.2])
    for i, (stamp_ns, T) in enumerate(zip(truth.stamps_ns, truth.T_world_rig, strict=True)):
        known = converged is not None and i >= converged
        pose = T.copy()
        pose[:3, 3] *= scale if known else scale_before
        yield OdometryResult(
            int(stamp_ns),
            TrackingStatus.TRACKING,
            T_world_map @ pose,
            np.eye(6),
            scale_converged=known,
        )


def test_scale_error_and_time_are_those_of_the_metric_part(truth):
    report = scale_report(list(run(truth, 1.02, 60)), truth)
    assert report.converged_after_s == pytest.approx(3.0)
    assert report.scale_error_percent == pytest.approx(2.0, abs=1e-6)
    assert report.sim3_ate_m == pytest.approx(0.0, abs=1e-9)
    spread = truth.positions_m[60:] - truth.positions_m[60:].mean(axis=0)
    assert report.se3_ate_m == pytest.approx(0.02 * np.sqrt((spread**2).sum(1).mean()), rel=1e-3)
    assert "after 3.0 s, with an error of +2.00 %" in str(report)


def test_a_scale_never_found_leaves_figures_fitted_with_scale(truth):
    report = scale_report(list(run(truth, 1.0, None)), truth)
    assert report.converged_after_s is report.scale_error_percent is report.se3_ate_m is None
    assert report.sim3_ate_m == pytest.approx(0.0, abs=1e-9)
    assert "did not converge" in str(report)


def test_a_jump_is_the_worst_step(truth):
    results = list(run(truth, 1.0, 0))
    for i in range(120, FRAMES):
        moved = results[i].T_world_rig.copy()
        moved[:3, 3] += [0.0, 0.4, 0.3]
        results[i] = replace(results[i], T_world_rig=moved)
    assert scale_report(results, truth).worst_step_m == pytest.approx(0.5, abs=1e-6)
    assert scale_report(list(run(truth, 1.0, 0)), truth).worst_step_m < 1e-9


def test_poses_in_another_unit_are_no_jump(truth):
    """The world changes when the scale is found: the first metric pose continues nothing."""
    assert scale_report(list(run(truth, 1.0, 100)), truth).worst_step_m < 1e-9


def test_a_rig_that_stands_has_no_scale_error(truth):
    still = Trajectory(truth.stamps_ns, np.tile(np.eye(4), (FRAMES, 1, 1)))
    report = scale_report(list(run(still, 1.0, 20)), still)
    assert report.scale_error_percent is None
    assert report.se3_ate_m == pytest.approx(0.0, abs=1e-9)


def test_a_method_in_metres_has_no_such_report(truth):
    results = [replace(result, scale_converged=None) for result in run(truth, 1.0, 0)]
    assert scale_report(results, truth) is None


def test_a_run_without_any_pose_is_told_apart_from_nothing(truth):
    lost = [
        replace(r, T_world_rig=None, covariance=None, status=TrackingStatus.LOST)
        for r in run(truth, 1.0, None)
    ]
    report = scale_report(lost, truth)
    assert report.sim3_ate_m is None
    assert report.converged_after_s is None
