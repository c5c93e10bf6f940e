"""A second camera that is mounted otherwise than the calibration says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, inverse, make_transform
from thermal_stereo_vo.odometry.direct.rig_check import RigCheck, Turn
from thermal_stereo_vo.odometry.direct.rig_kernel import linearise_rig, one_minus_adjoint
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry

from .test_photometric_bundle import two_bands
from .two_band_room import T_RIG_CAMERA, Room, swaying

FRAMES = 52
SETTINGS = (
    "method=multispectral",
    "status.bolometer_lag_ms=0",
    "multispectral.selection.points=250",
    "multispectral.keyframes.flow_px=25",
    "threads=1",
)


@pytest.fixture(scope="module")
def frames():
    """2.6 s of turning and moving."""
    room, rng = Room(3), np.random.default_rng(5)
    return [room.frame(i, T, rng) for i, T in enumerate(swaying(FRAMES))]


def fly(frames, T_rig_thermal):
    """Results with the thermal camera said to be somewhere."""
    odometry = create_odometry(with_overrides(OdometryConfig(), SETTINGS))
    results = []
    for frame in frames:
        view = replace(frame.views[THERMAL], T_rig_camera=T_rig_thermal.copy())
        results.append(odometry.process(replace(frame, views={**frame.views, THERMAL: view})))
    return results


def never_doubted(results):
    """It may wait for the scale, and says so, but blames nobody."""
    return all(
        result.status is TrackingStatus.TRACKING
        and (result.scale_converged or "move sideways and turn" in result.reason)
        and "camera" not in result.reason
        for result in results[1:]
    )


def turned(degrees, axis):
    T = T_RIG_CAMERA[THERMAL]
    return T @ make_transform(exp_so3(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))


def test_a_right_rig_is_never_doubted(frames):
    results = fly(frames, T_RIG_CAMERA[THERMAL])
    assert never_doubted(results)
    assert results[-1].scale_converged
    assert results[-1].reason == ""


def test_straight_ahead_a_right_rig_is_not_doubted():
    """A turn about the way shows in no picture."""
    room, rng = Room(3), np.random.default_rng(5)
    poses = [make_transform(np.eye(3), [0.0, 0.0, -1.5 + 0.03 * i]) for i in range(60)]
    results = fly([room.frame(i, T, rng) for i, T in enumerate(poses)], T_RIG_CAMERA[THERMAL])
    assert never_doubted(results)
    assert not any(result.scale_converged for result in results)


@pytest.mark.parametrize(("degrees", "axis"), [(2.0, 0), (-2.0, 2), (8.0, 1)])
def test_a_turned_camera_is_told_with_its_angle(frames, degrees, axis):
    results = fly(frames, turned(degrees, axis))
    told = [result for result in results if "thermal camera does not move as" in result.reason]
    assert len(told) > 5  # by 2.3 s at the latest
    assert told[-1] is results[-1]
    assert all(result.status is TrackingStatus.DEGRADED for result in told)
    assert not any(result.scale_converged for result in results)
    angle = float(told[-1].reason.split("about ")[1].split(" deg")[0])
    assert 0.5 * abs(degrees) < angle < 1.2 * abs(degrees)
    if abs(degrees) < 3.0:  # beyond it is told, but found in part only
        assert angle == pytest.approx(abs(degrees), rel=0.15)


@pytest.mark.parametrize("wrong", ["swapped", "mirrored"])
def test_cameras_that_are_swapped_or_mirrored_are_told(frames, wrong):
    T = inverse(T_RIG_CAMERA[THERMAL])
    if wrong == "mirrored":
        T = T_RIG_CAMERA[THERMAL]
        flipped = []
        for frame in frames:
            view = frame.views[THERMAL]
            image = np.ascontiguousarray(view.image[:, ::-1])
            flipped.append(
                replace(frame, views={**frame.views, THERMAL: replace(view, image=image)})
            )
        frames = flipped
    results = fly(frames, T)
    assert "thermal camera does not move as" in results[-1].reason
    assert not any(result.scale_converged for result in results)


def test_the_pull_is_the_slope_of_the_cost(rng):
    """By every way that the camera may move, depths held."""
    problem = two_bands(rng, 1.0)
    mine = np.flatnonzero(problem.host_cameras == 1)
    seen = np.ascontiguousarray(problem.seen[mine][:, :, 1])
    rhos = problem.rhos[mine]

    def look(T_camera_rig):
        out = (
            np.zeros((6, 6)), np.zeros(6), np.zeros((len(mine), 6)), np.zeros(len(mine)),
            np.zeros(len(mine)), np.zeros(seen.shape),
        )  # fmt: skip
        # So sure of the depths that eliminating them changes nothing, and a gate out of sight.
        linearise_rig(
            problem.images[1], problem.slots, problem.T_k_w, problem.cameras[1], T_camera_rig,
            rhos, problem.hosts[mine], problem.bearings[mine], rhos, np.full(len(mine), 1e12),
            problem.patches[mine], problem.trusts[mine], seen, 1e6, *out,
        )  # fmt: skip
        weight = np.repeat(problem.trusts[mine].sum(axis=1)[:, None], seen.shape[1], axis=1)
        return float(np.nansum(weight * out[5])), out[1]

    T = exp_se3([0.01, -0.02, 0.01, 0.004, -0.006, 0.005]) @ inverse(problem.T_rig_camera[1])
    _, pull = look(T)
    for way in np.eye(6):
        step = 1e-5 * way
        slope = (look(exp_se3(step) @ T)[0] - look(exp_se3(-step) @ T)[0]) / 2e-5
        assert -0.5 * slope == pytest.approx(
            float(pull @ way), rel=0.03, abs=0.02 * np.abs(pull).max()
        )


def test_a_motion_changes_by_where_it_is_seen_from(rng):
    M, xi = exp_se3(rng.normal(size=6)), 1e-6 * rng.normal(size=6)
    out = np.empty((6, 6))
    one_minus_adjoint(M, out)
    np.testing.assert_allclose(
        exp_se3(out @ xi) @ M, exp_se3(xi) @ M @ exp_se3(-xi), rtol=0.0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("degrees", "sigma_deg", "windows", "off"),
    [
        (2.5, 0.05, 4, True),
        (2.5, 0.05, 3, False),  # too few
        (2.5, 0.4, 4, False),  # too unsure
        (1.9, 0.01, 15, False),  # twice as much is allowed to the first ones
        (1.1, 0.01, 16, True),
        (0.9, 0.01, 16, False),  # within what is allowed
    ],
)
def test_only_what_is_sure_is_told(degrees, sigma_deg, windows, off):
    check = RigCheck(np.radians(1.0))
    information = np.eye(3) / np.radians(sigma_deg) ** 2
    for _ in range(windows):
        check.add(Turn(np.radians([0.0, degrees, 0.0]), information))
    assert (check.off_rad is not None) == off
    if off:
        assert check.off_rad == pytest.approx(np.radians(degrees))


@pytest.mark.parametrize(("degrees", "stays"), [(0.7, True), (0.3, False)])
def test_what_is_told_stays_told_until_it_is_much_less(degrees, stays):
    check = RigCheck(np.radians(1.0))
    for _ in range(4):
        check.add(Turn(np.radians([0.0, 3.0, 0.0]), 1e6 * np.eye(3)))
    assert check.off_rad == pytest.approx(np.radians(3.0))
    for _ in range(12):
        check.add(Turn(np.radians([0.0, degrees, 0.0]), 1e6 * np.eye(3)))
    assert check.off_rad == (pytest.approx(np.radians(degrees)) if stays else None)


def test_one_wild_window_tells_nothing():
    check = RigCheck(np.radians(1.0))
    for degrees in (0.1, -0.1, 0.05, 0.0, 6.0):
        check.add(Turn(np.radians([degrees, 0.0, 0.0]), 1e6 * np.eye(3)))
    assert check.off_rad is None


@pytest.mark.parametrize("has_told_scale", [False, True])
def test_a_camera_that_has_told_the_scale_is_not_upside_down(has_told_scale):
    check = RigCheck(np.radians(1.0))
    for _ in range(4):
        check.add(Turn(np.zeros(3), np.eye(3), is_half=True), has_told_scale=has_told_scale)
    assert check.off_rad == (None if has_told_scale else np.pi)
