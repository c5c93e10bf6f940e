"""The equations of the window against a dense, plain form; and what they solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3
from thermal_stereo_vo.odometry.direct.photometric import take_patches
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    _Equations,
    _linearise,
    adjust_photometrically,
    noise_of,
    residuals_of_window,
)

from .smooth_world import window_problem

HUBER, GATE = 15.0, 1e4
SIZE = 10  # unknowns of a keyframe with two cameras


def moved(problem, step):
    """The problem after a step of all keyframes, then of all inverse depths."""
    K = len(problem.T_k_w)
    frames, depths = step[: K * SIZE].reshape(K, SIZE), step[K * SIZE :]
    return replace(
        problem,
        T_k_w=np.stack([exp_se3(d[:6]) @ T for d, T in zip(frames, problem.T_k_w, strict=True)]),
        brightness=problem.brightness + frames[:, 6:].reshape(K, 2, 2),
        rhos=problem.rhos + depths,
    )


def test_reduced_equations_are_those_of_the_dense_problem(rng):
    problem = window_problem(rng)
    K, N = len(problem.T_k_w), len(problem.rhos)
    residuals = residuals_of_window(problem)
    valid = np.isfinite(residuals)
    r = residuals[valid]
    unknowns = K * SIZE + N
    J = np.empty((len(r), unknowns))
    for i in range(unknowns):
        h = 1e-3 * np.eye(unknowns)[i]
        J[:, i] = (
            residuals_of_window(moved(problem, h)) - residuals_of_window(moved(problem, -h))
        )[valid] / 2e-3
    trust = np.broadcast_to(problem.trusts[:, None, None, :], residuals.shape)[valid]
    w = trust * np.minimum(1.0, HUBER / np.abs(r))
    H, b = J.T @ (w[:, None] * J), -J.T @ (w * r)
    f = K * SIZE
    Hff, Hfd, Hdd = H[:f, :f], H[:f, f:], np.diag(H)[f:]
    expected_A = Hff - Hfd @ (Hfd / Hdd).T
    expected_g = b[:f] - Hfd @ (b[f:] / Hdd)
    found = _Equations.of(problem)
    _linearise(problem, problem.T_k_w, problem.brightness, problem.rhos, HUBER, GATE, found)
    scale = np.sqrt(np.outer(np.diag(Hff), np.diag(Hff)))
    np.testing.assert_allclose(found.A / scale, expected_A / scale, atol=0.02)
    np.testing.assert_allclose(found.h_rho, Hdd, rtol=0.05)
    np.testing.assert_allclose(
        found.g / np.sqrt(np.diag(Hff)), expected_g / np.sqrt(np.diag(Hff)), atol=3.0
    )
    assert np.abs(expected_g / np.sqrt(np.diag(Hff))).max() > 50.0
    size = np.abs(r)
    cost = np.sum(trust * np.where(size <= HUBER, r**2, HUBER * (2 * size - HUBER)))
    np.testing.assert_allclose(found.cost, cost, rtol=1e-4)


def one_world(rng):
    """Keyframes of one and the same plane at 3 m, drawn by shifting one smooth image."""
    problem = window_problem(rng, points=60, keyframes=3)
    y, x = np.mgrid[:120, :160].astype(float)
    waves = [
        (rng.uniform(0.05, 0.11), *rng.uniform(0, 7, 2), rng.uniform(20, 30)) for _ in range(6)
    ]

    def draw(u, v):
        out = np.zeros((*np.shape(u), 3))
        for k, angle, phase, size in waves:
            kx, ky = k * np.cos(angle), k * np.sin(angle)
            out[..., 0] += size * np.sin(kx * u + ky * v + phase)
            out[..., 1] += size * kx * np.cos(kx * u + ky * v + phase)
            out[..., 2] += size * ky * np.cos(kx * u + ky * v + phase)
        return out.astype(np.float32)

    depth_m, offsets_m = 3.0, np.array([[0, 0], [0.15, 0.05], [0.05, -0.12]])
    T_w_camera1 = np.eye(4)
    T_w_camera1[0, 3] = 0.2
    cameras = np.array([[150.0, 150.0, 80.0, 60.0]] * 2)
    stacks = []
    for eye in range(2):
        shift_m = offsets_m + np.array([0.2 * eye, 0.0])
        stacks.append(
            np.stack([draw(x + 150 * s[0] / depth_m, y + 150 * s[1] / depth_m) for s in shift_m])
        )
    T_k_w = np.stack([np.eye(4)] * 3)
    T_k_w[:, :2, 3] = -offsets_m
    rng_px = np.column_stack([rng.uniform(50, 120, 60), rng.uniform(30, 90, 60)])
    bearings = np.column_stack([(rng_px[:, 0] - 80) / 150, (rng_px[:, 1] - 60) / 150, np.ones(60)])
    patches, trusts = np.zeros((60, 8)), np.zeros((60, 8))
    for n in range(60):
        take_patches(
            stacks[0][problem.hosts[n]], rng_px[n : n + 1], 1.0, 50.0, patches[n : n + 1],
            trusts[n : n + 1],
        )  # fmt: skip
    seen = np.ones((60, 3, 2), bool)
    seen[np.arange(60), problem.hosts, 0] = False
    return replace(
        problem, images=tuple(stacks), T_k_w=T_k_w, brightness=np.zeros((3, 2, 2)),
        cameras=cameras, T_rig_camera=np.stack([np.eye(4), T_w_camera1]),
        host_cameras=np.zeros(60, np.int64), bearings=bearings, rhos=np.full(60, 1 / depth_m),
        patches=patches, trusts=trusts, seen=seen,
    )  # fmt: skip


def test_it_finds_poses_depths_and_brightness(rng):
    truth = one_world(rng)
    wrong = replace(
        truth,
        T_k_w=np.stack(
            [truth.T_k_w[0], *(exp_se3(rng.normal(size=6) * 0.004) @ T for T in truth.T_k_w[1:])]
        ),
        rhos=truth.rhos * rng.uniform(0.95, 1.05, 60),
        brightness=np.concatenate([np.zeros((1, 2, 2)), rng.normal(size=(2, 2, 2)) * [0.02, 1.0]]),
    )
    solution = adjust_photometrically(wrong, huber=9.0, gate=14.0, iterations=15)
    for found, true, start in zip(solution.T_k_w, truth.T_k_w, wrong.T_k_w, strict=True):
        error = np.linalg.norm(log_se3(found @ inverse(true)))
        assert error <= 0.4 * np.linalg.norm(log_se3(start @ inverse(true))) + 1e-12
    np.testing.assert_allclose(solution.rhos, truth.rhos, rtol=0.01)
    np.testing.assert_allclose(solution.brightness, 0.0, atol=0.2)
    assert 1e-3 < solution.sigma < 1.0
    assert np.nanmax(solution.energies) < 4.0
    values = np.linalg.eigvalsh(solution.covariance)
    assert values[0] > 0.0
    assert solution.covariance.shape == (12, 12)
    # Without the other eye the scale is open: the same equations must be much less sure.
    seen = truth.seen.copy()
    seen[..., 1] = False
    mono = adjust_photometrically(replace(wrong, seen=seen), huber=9.0, gate=14.0, iterations=2)
    assert mono is None or np.linalg.eigvalsh(mono.covariance)[-1] > 100 * values[-1]


def test_a_patch_that_does_not_fit_pulls_nothing(rng):
    truth = one_world(rng)
    patches = truth.patches.copy()
    patches[:5] += 80.0 * rng.normal(size=(5, 8))
    spoilt = replace(truth, patches=patches)
    solution = adjust_photometrically(spoilt, huber=9.0, gate=14.0, iterations=6)
    for found, true in zip(solution.T_k_w, truth.T_k_w, strict=True):
        assert np.linalg.norm(log_se3(found @ inverse(true))) < 3e-3
    assert np.nanmin(solution.energies[:5]) > 14.0**2
    assert np.nanmax(solution.energies[5:]) < 14.0**2


def test_noise_is_that_of_the_patches_that_are_believed():
    energies = np.array([[4.0, 4.0], [np.nan, 1e6]])
    assert noise_of(energies, 14.0) == 2.0
    assert noise_of(np.full((2, 2), np.nan), 14.0) == 14.0
