from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, make_transform
from thermal_stereo_vo.evaluation.alignment import (
    Alignment,
    Similarity,
    align,
    aligned,
    umeyama,
    up_axis,
)
from thermal_stereo_vo.evaluation.association import compare
from thermal_stereo_vo.evaluation.metrics import position_errors


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 20.0))
def test_umeyama_finds_the_similarity_that_was_put_in(seed, scale):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3)) * (5, 3, 1)
    truth = Similarity(exp_se3(rng.normal(size=6) * (9, 9, 9, 2, 2, 2)), scale)
    target = scale * source @ truth.T_true_est[:3, :3].T + truth.T_true_est[:3, 3]
    found = umeyama(source, target, with_scale=True)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.T_true_est, truth.T_true_est, atol=1e-7)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_umeyama_agrees_with_scipy_on_noisy_points(seed):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(20, 3)) * (5, 3, 1)
    target = source @ exp_so3(rng.normal(size=3)).T + 3 + rng.normal(size=(20, 3)) * 0.1
    found = umeyama(source, target)
    reference, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    np.testing.assert_allclose(found.T_true_est[:3, :3], reference.as_matrix(), atol=1e-6)
    assert found.scale == 1.0


def test_umeyama_of_a_mirror_image_is_still_a_rotation(rng):
    source = rng.normal(size=(20, 3))
    found = umeyama(source, source * (1, 1, -1))
    assert np.linalg.det(found.T_true_est[:3, :3]) == pytest.approx(1.0)


def test_umeyama_of_degenerate_points_is_finite():
    line = np.outer(np.arange(5.0), (1.0, 2.0, 0.5))
    turned = line @ exp_so3([0.3, 0.2, 0.1]).T
    found = umeyama(line, turned)
    mapped = line @ found.T_true_est[:3, :3].T + found.T_true_est[:3, 3]
    np.testing.assert_allclose(mapped, turned, atol=1e-12)
    still = umeyama(np.ones((5, 3)), 3 * np.ones((5, 3)), with_scale=True)
    assert still.scale == 1.0
    assert np.linalg.det(still.T_true_est[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(still.T_true_est[:3, :3] @ np.ones(3) + still.T_true_est[:3, 3], 3)


@pytest.mark.parametrize("alignment", list(Alignment))
def test_an_estimate_without_error_is_laid_exactly_over_the_truth(alignment, flight, rng):
    truth = flight(rng)
    moved = Trajectory(truth.stamps_ns, exp_se3([3, -2, 5, 0.4, 2.0, -1]) @ truth.T_world_rig)
    result = aligned(compare(moved, truth), alignment)
    np.testing.assert_allclose(result.T_world_est, truth.T_world_rig, atol=1e-9)


def z_up(n: int = 200) -> Trajectory:
    """A level flight of a forward-looking rig in a world whose z points up."""
    t = np.linspace(0, 4, n)
    poses = []
    for heading in 0.5 * np.sin(t):
        forward = exp_so3([0, 0, heading])
        # Optical axes of a level camera: x right, y down, z forward.
        poses.append(forward @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    positions = np.column_stack([10 * t, 3 * np.sin(t), 0.5 * np.cos(3 * t)])
    return Trajectory(
        np.arange(n) * 50_000_000,
        np.array([make_transform(R, p) for R, p in zip(poses, positions, strict=True)]),
    )


def test_up_is_found_whatever_the_axes_of_the_world_are():
    truth = z_up()
    assert up_axis(compare(truth, truth)).tolist() == [0, 0, 1]
    optical = np.linalg.inv(truth.T_world_rig[0]) @ truth.T_world_rig
    camera_world = Trajectory(truth.stamps_ns, optical)
    assert up_axis(compare(camera_world, camera_world)).tolist() == [0, -1, 0]


def test_yaw_corrects_heading_and_place_but_not_tilt(rng):
    truth = z_up()
    yawed = make_transform(exp_so3([0, 0, 0.7]), [1, 2, 3]) @ truth.T_world_rig
    # A wrong heading in the first pose alone spoils the origin alignment only.
    yawed[0, :3, :3] = exp_so3([0, 0, 0.2]) @ yawed[0, :3, :3]
    comparison = compare(Trajectory(truth.stamps_ns, yawed), truth)
    assert np.max(position_errors(aligned(comparison, Alignment.ORIGIN))) > 1.0
    assert np.max(position_errors(aligned(comparison, Alignment.YAW))) < 1e-9
    # A wrong tilt of the first pose remains, though SE(3) would hide it.
    tilted = truth.T_world_rig.copy()
    tilted[0, :3, :3] = tilted[0, :3, :3] @ exp_so3([0.1, 0, 0])
    comparison = compare(Trajectory(truth.stamps_ns, tilted), truth)
    assert np.max(position_errors(aligned(comparison, Alignment.YAW))) > 0.5
    assert np.max(position_errors(aligned(comparison, Alignment.SE3))) < 1e-9


def test_yaw_is_the_best_of_all_headings(flight, odometry, rng):
    truth = flight(rng)
    comparison = compare(odometry(truth, rng, noise=5.0), truth)
    best = align(comparison, Alignment.YAW)
    up = up_axis(comparison)

    def rms(similarity: Similarity) -> float:
        positions = similarity.apply(comparison.T_world_est)[:, :3, 3]
        return float(np.sqrt(np.mean(np.sum((positions - truth.positions_m) ** 2, axis=1))))

    centre = truth.positions_m.mean(axis=0)
    for angle in (-0.01, 0.01):
        R = exp_so3(angle * up)
        turned = make_transform(R, centre - R @ centre) @ best.T_true_est
        assert rms(Similarity(turned)) > rms(best)
    for axis in np.eye(3):
        shifted = make_transform(np.eye(3), 0.01 * axis) @ best.T_true_est
        assert rms(Similarity(shifted)) > rms(best)


def test_more_freedom_fits_better(flight, odometry, rng):
    truth = flight(rng)
    comparison = compare(odometry(truth, rng, scale=1.03, noise=3.0), truth)
    rms = [
        np.sqrt(np.mean(position_errors(aligned(comparison, alignment)) ** 2))
        for alignment in (Alignment.ORIGIN, Alignment.YAW, Alignment.SE3, Alignment.SIM3)
    ]
    assert rms[0] > rms[1] > rms[2] > rms[3] > 0.01


def test_alignment_leaves_lost_frames_lost(flight, odometry, rng):
    truth = flight(rng, n=100)
    estimate = odometry(truth, rng)
    kept = np.r_[0:40, 60:100]
    sparse = Trajectory(estimate.stamps_ns[kept], estimate.T_world_rig[kept])
    for alignment in Alignment:
        result = aligned(compare(sparse, truth), alignment)
        assert np.isnan(result.estimated_positions_m[40:60]).all()
        assert np.isfinite(result.T_world_est[kept]).all()
