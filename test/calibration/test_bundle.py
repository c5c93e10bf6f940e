from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.calibration.bundle import Prior, Rig, place_covariance, solve
from thermal_stereo_vo.calibration.lenses import Lens, from_camera
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, log_so3

from .made_up_views import LEFT, RIGHT, T_RIGHT_LEFT, made_up_shots, observations_of

TARGET = parse_target("chessboard:9x6:0.04")


def true_rig(poses):
    lens = Lens.RADTAN4
    return Rig(
        (lens, lens),
        (from_camera(lens, LEFT), from_camera(lens, RIGHT)),
        (np.eye(4), T_RIGHT_LEFT),
        tuple(poses),
    )


def shaken(rig, rng):
    return replace(
        rig,
        parameters=tuple(
            p * (1.0 + 0.02 * rng.normal(size=len(p))) for p in rig.parameters
        ),
        T_camera_reference=(
            np.eye(4), exp_se3(rng.normal(0, 0.01, 6)) @ rig.T_camera_reference[1]
        ),
        T_reference_board=tuple(
            exp_se3(rng.normal(0, 0.02, 6)) @ T for T in rig.T_reference_board
        ),
    )  # fmt: skip


def test_recovers_the_truth_without_noise(rng):
    shots, poses = made_up_shots(TARGET, 8, rng, noise_px=0.0)
    solution = solve(shaken(true_rig(poses), rng), observations_of(TARGET, shots))
    for found, true in zip(solution.rig.parameters, true_rig(poses).parameters, strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(solution.rig.T_camera_reference[1], T_RIGHT_LEFT, atol=1e-7)
    assert solution.sigma_px < 1e-4


def test_uncertainty_is_honest(rng):
    """Normalised errors of 25 calibrations: chi2 of 22 unknowns, mean 22."""
    scores, sigmas = [], []
    for _ in range(25):
        shots, poses = made_up_shots(TARGET, 7, rng, noise_px=0.2)
        rig = true_rig(poses)
        solution = solve(rig, observations_of(TARGET, shots))
        step = np.concatenate(
            [
                *(f - t for f, t in zip(solution.rig.parameters, rig.parameters, strict=True)),
                log_se3(solution.rig.T_camera_reference[1] @ inverse(T_RIGHT_LEFT)),
            ]
        )
        scores.append(step @ np.linalg.solve(solution.covariance, step))
        sigmas.append(solution.sigma_px)
    assert 15.0 < np.mean(scores) < 31.0
    assert np.mean(sigmas) == pytest.approx(0.2, rel=0.06)


def test_eliminating_the_boards_equals_the_whole_system(rng):
    """Schur complement against the dense normal equations from numeric derivatives."""
    shots, poses = made_up_shots(TARGET, 3, rng, noise_px=0.05)
    observations = observations_of(TARGET, shots)
    solution = solve(true_rig(poses), observations)
    rig = solution.rig

    def residuals(step):
        moved = rig.moved(step[: rig.shared_count])
        twists = step[rig.shared_count :].reshape(-1, 6)
        boards = tuple(exp_se3(t) @ T for t, T in zip(twists, rig.T_reference_board, strict=True))
        moved = replace(moved, T_reference_board=boards)
        from thermal_stereo_vo.calibration.bundle import _all_residuals

        return np.concatenate([r.ravel() for r in _all_residuals(moved, observations)])

    size = rig.shared_count + 18
    h = 1e-6
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(size)], axis=1)
    scale = 1.0 / np.linalg.norm(J, axis=0)
    dense = np.linalg.inv((J * scale).T @ (J * scale)) * np.outer(scale, scale)
    ours = solution.covariance / solution.sigma_px**2
    sigma = np.sqrt(np.diag(dense)[: rig.shared_count])
    # Robust weights of a few points make the only difference.
    np.testing.assert_allclose(np.sqrt(np.diag(ours)), sigma, rtol=0.05)


def test_views_of_one_camera_help_its_lens_only(rng):
    shots, poses = made_up_shots(TARGET, 12, rng, noise_px=0.2)
    few = [o for o in observations_of(TARGET, shots) if o.view < 5]
    more = few + [o for o in observations_of(TARGET, shots) if o.view >= 5 and o.camera == 0]
    a, b = solve(true_rig(poses), few).covariance, solve(true_rig(poses), more).covariance
    rig = true_rig(poses)
    left, right = rig.lens_slice(0), rig.lens_slice(1)
    assert np.sqrt(b[left, left][0, 0] / a[left, left][0, 0]) < 0.8
    assert np.sqrt(b[right, right][0, 0] / a[right, right][0, 0]) < 1.1


def test_one_wrong_corner_does_not_matter(rng):
    shots, poses = made_up_shots(TARGET, 8, rng, noise_px=0.1)
    observations = observations_of(TARGET, shots)
    clean = solve(true_rig(poses), observations).rig.parameters[0]
    spoilt = observations[0].pixels.copy()
    spoilt[7] += (15.0, -9.0)
    observations[0] = replace(observations[0], pixels=spoilt)
    dirty = solve(true_rig(poses), observations).rig.parameters[0]
    assert abs(dirty[0] - clean[0]) < 0.2
    assert abs(dirty[2] - clean[2]) < 0.3


def test_prior_holds_a_lens_that_views_do_not_determine(rng):
    shots, poses = made_up_shots(TARGET, 5, rng, noise_px=0.2, tilt_deg=1.0)
    rig = true_rig(poses)
    mean = rig.parameters[0]
    covariance = np.diag(np.array([0.5, 0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4]) ** 2)
    prior = Prior(((mean, covariance), None), np.zeros(0))
    held = solve(shaken(rig, rng), observations_of(TARGET, shots), prior=prior)
    free = solve(rig, observations_of(TARGET, shots))
    left = rig.lens_slice(0)
    assert np.sqrt(held.covariance[left, left][0, 0]) < 0.6
    assert np.sqrt(free.covariance[left, left][0, 0]) > 2.0
    assert abs(held.rig.parameters[0][0] - mean[0]) < 2.0


def test_place_covariance_in_translation_and_rotation_vector(rng):
    """The change of (t, rotation vector) under small left perturbations, by sampling."""
    rig = true_rig([])
    size = rig.shared_count
    A = 1e-4 * rng.normal(size=(6, 6))
    covariance = np.zeros((size, size))
    covariance[rig.pose_slice(1), rig.pose_slice(1)] = A @ A.T
    _, chart = place_covariance(rig, covariance, 1)

    def values(T):
        return np.concatenate([T[:3, 3], log_so3(T[:3, :3])])

    samples = [values(exp_se3(A @ rng.normal(size=6)) @ T_RIGHT_LEFT) for _ in range(4000)]
    np.testing.assert_allclose(
        np.sqrt(np.diag(np.cov(np.array(samples).T))), np.sqrt(np.diag(chart)), rtol=0.06
    )
