"""The equations of the window against a dense, plain form; and what they solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3
from thermal_stereo_vo.evaluation.consistency import nees_band
from thermal_stereo_vo.odometry.direct.photometric import PATTERN, take_patches
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    HOLD,
    _Equations,
    _linearise,
    adjust_photometrically,
    moved_by,
    noise_of,
    residuals_of_window,
    size_of,
)

from .smooth_world import window_problem

HUBER, GATE = 15.0, 1e4
SIZE = 10  # unknowns of a keyframe with two cameras
MIDDLE = 4  # the pixel of the pattern without offset


def moved(problem, step):
    """Residuals after a step of all keyframes, of scale and lag, and of all inverse depths."""
    K = len(problem.T_k_w)
    frames, depths = step[: K * SIZE].reshape(K, SIZE), step[K * SIZE + 2 :]
    return residuals_of_window(_moved(problem, frames, depths), *step[K * SIZE : K * SIZE + 2])


def _moved(problem, frames, depths):
    K = len(problem.T_k_w)
    return replace(
        problem,
        T_k_w=np.stack([exp_se3(d[:6]) @ T for d, T in zip(frames, problem.T_k_w, strict=True)]),
        brightness=problem.brightness + frames[:, 6:].reshape(K, 2, 2),
        rhos=problem.rhos + depths,
    )


def slopes_across(problem, n, t, J):
    """Derivatives (8, U) of what the other camera sees of a point of another band, at ``t``.

    Two images share the mean of their slopes; by brightness they are those of the residuals (J).
    """
    K, unknowns = len(problem.T_k_w), J.shape[1]
    h, hc = problem.hosts[n], problem.host_cameras[n]
    c = 1 - hc
    step = 1.0 / problem.cameras[hc, :2]

    def positions(frame, change, offset=(0.0, 0.0)):
        """(8, 2) normalised coordinates in the other camera at ``frame``."""
        frames, depths = change[: K * SIZE].reshape(K, SIZE), change[K * SIZE + 2 :]
        log_scale, lag_s = change[K * SIZE : K * SIZE + 2]
        now = _moved(problem, frames, depths)
        T_rig_camera = now.T_rig_camera.copy()
        T_rig_camera[:, :3, 3] *= np.exp(-log_scale)
        late = moved_by(now.twists, now.lags_s + lag_s * now.bolometers)
        T_h = late[h, hc] @ now.T_k_w[h]
        T = inverse(T_rig_camera[c]) @ late[frame, c] @ now.T_k_w[frame]
        T = T @ inverse(T_h) @ T_rig_camera[hc]
        rays = np.column_stack([problem.bearings[n, :2] + PATTERN * step + offset, np.ones(8)])
        q = rays @ T[:3, :3].T + now.rhos[n] * T[:3, 3]
        return q[:, :2] / q[:, 2:]

    def image_slopes(frame):
        at = positions(frame, np.zeros(unknowns)) * problem.cameras[c, :2] + problem.cameras[c, 2:]
        image = problem.images[c][frame].astype(np.float64)
        taken = [map_coordinates(image[..., k], at.T[::-1], order=1) for k in (1, 2)]
        return np.column_stack(taken) * problem.cameras[c, :2]

    small, zero = 1e-6, np.zeros(unknowns)
    warps = [
        np.stack([(positions(f, zero, e) - positions(f, zero, -e)) / (2 * small)
                  for e in small * np.eye(2)], axis=2)
        for f in (t, h)
    ]  # fmt: skip
    # A patch moves and is distorted as its middle.
    warp = warps[0][MIDDLE] @ np.linalg.inv(warps[1][MIDDLE])
    gain = np.exp(problem.brightness[t, c, 0] - problem.brightness[h, c, 0])
    home = image_slopes(h) @ np.linalg.inv(warp)
    shared = 0.5 * (image_slopes(t) + gain * home)
    out = J.copy()
    for i in range(unknowns):
        if i < K * SIZE and i % SIZE >= 6:
            continue
        e = small * np.eye(unknowns)[i]
        there = (positions(t, e) - positions(t, -e)) / (2 * small)
        at_home = (positions(h, e) - positions(h, -e)) / (2 * small)
        out[:, i] = shared @ (there[MIDDLE] - warp @ at_home[MIDDLE])
    return out


def information_of_guesses(problem):
    """(N, N) of depths alone: those of one host's camera err together, by 0.2 where each by 0.5."""
    known, guessed = problem.prior_information, problem.rho_priors
    out = np.diag(known)
    if not problem.guesses_err_together:
        return out
    for host, camera in {*zip(problem.hosts, problem.host_cameras, strict=True)}:
        mine = np.flatnonzero((problem.hosts == host) & (problem.host_cameras == camera))
        pull = known[mine] * guessed[mine]
        count, total = np.count_nonzero(pull), pull @ guessed[mine]
        if count > 0:
            out[np.ix_(mine, mine)] -= np.outer(pull, pull) / (total + 6.25 * total / count)
    return out


@pytest.mark.parametrize("looseness", [0.0, 1.7])
@pytest.mark.parametrize(("bands", "together"), [(False, True), (True, True), (True, False)])
def test_reduced_equations_are_those_of_the_dense_problem(rng, bands, together, looseness):
    problem = replace(
        window_problem(rng),
        bands=bands,
        guesses_err_together=together,
        bolometers=np.array([False, True]),
        looseness=np.array([0.0, looseness]),
    )
    if bands:  # a camera of another band has nothing to compare in the host itself
        problem.seen[np.arange(12), problem.hosts] = False
    K, N = len(problem.T_k_w), len(problem.rhos)
    residuals = residuals_of_window(problem)
    valid = np.isfinite(residuals)
    r = residuals[valid]
    unknowns = K * SIZE + 2 + N
    J = np.empty((len(r), unknowns))
    for i in range(unknowns):
        h = 1e-3 * np.eye(unknowns)[i]
        J[:, i] = (moved(problem, h) - moved(problem, -h))[valid] / 2e-3
    if bands:
        J_patches = J.reshape(-1, 8, unknowns)
        for m, (n, t, c) in enumerate(np.argwhere(valid[..., 0])):
            if c != problem.host_cameras[n]:
                J_patches[m] = slopes_across(problem, n, t, J_patches[m])
    trusts = np.broadcast_to(problem.trusts[:, None, None, :], residuals.shape).copy()
    if bands:  # trusts of patches that are sampled again are found there: here all the same
        trusts[problem.host_cameras == 0, :, 1] = trusts[problem.host_cameras == 1, :, 0] = 1.0
    trust = trusts[valid]
    w = trust * np.minimum(1.0, HUBER / np.abs(r))
    W, loose = np.diag(w), np.zeros(valid.shape)
    # Two views of another band's points by this camera have no patch that could be off.
    loose[..., 1, :] = looseness
    if bands:
        loose[problem.host_cameras == 0] = 0.0
    for i in range(0, len(w), 8):
        own, some = slice(i, i + 8), loose[valid][i]
        if some > 0.0:
            W[own, own] -= np.outer(w[own], w[own]) / (1.0 / some + w[own].sum())
    H, b = J.T @ W @ J, -J.T @ W @ r
    f = K * SIZE + 2
    off = problem.rho_priors - problem.rhos
    of_one = np.diag(H)[f:] + problem.prior_information
    prior = information_of_guesses(problem)
    H[f:, f:] += prior
    b[f:] += prior @ off
    Hff, Hfd, Hdd = H[:f, :f], H[:f, f:], H[f:, f:]
    expected_A = Hff - Hfd @ np.linalg.solve(Hdd, Hfd.T)
    expected_g = b[:f] - Hfd @ np.linalg.solve(Hdd, b[f:])
    found = _Equations.of(problem)
    at = problem.T_k_w, problem.brightness, problem.rhos, 0.0, 0.0
    _linearise(problem, *at, HUBER, GATE, found)
    scale = np.sqrt(np.outer(np.diag(Hff), np.diag(Hff)))
    # Patches move as their middle does: in these small images that is some percent off.
    np.testing.assert_allclose(found.A / scale, expected_A / scale, atol=0.04)
    np.testing.assert_allclose(found.h_rho, of_one, rtol=0.1 if bands else 0.08)
    np.testing.assert_allclose(
        found.g / np.sqrt(np.diag(Hff)), expected_g / np.sqrt(np.diag(Hff)), atol=5.0
    )
    assert np.abs(expected_g / np.sqrt(np.diag(Hff))).max() > 50.0
    size = np.abs(r)
    cost = np.sum(trust * np.where(size <= HUBER, r**2, HUBER * (2 * size - HUBER)))
    cost += r @ (W - np.diag(w)) @ r
    cost += off @ prior @ off
    np.testing.assert_allclose(found.cost, cost, rtol=1e-4)


@pytest.mark.parametrize("bands", [False, True])
def test_each_point_pulls_as_if_it_were_alone_and_together_they_pull_as_all(rng, bands):
    looseness = np.array([0.0 if bands else 0.5, 0.5])
    problem = replace(window_problem(rng, points=24), bands=bands, looseness=looseness)
    at = problem.T_k_w, problem.brightness
    found = _Equations.of(problem)
    pulls = np.full_like(found.W, np.nan)
    given = 0.0, 0.0, HUBER, GATE
    _linearise(problem, *at, problem.rhos, *given, found, pulls=pulls)
    size = np.abs(pulls).max()
    np.testing.assert_allclose(pulls.sum(axis=0), found.g, rtol=1e-6, atol=1e-9 * size)
    # What guesses have in common no point pulls alone.
    problem = replace(problem, prior_information=np.zeros(24))
    _linearise(problem, *at, problem.rhos, *given, found, pulls=pulls)
    for n in range(24):
        alone = problem.take(np.arange(24) == n)
        own = _Equations.of(alone)
        _linearise(alone, *at, alone.rhos, *given, own)
        np.testing.assert_allclose(pulls[n], own.g, rtol=1e-6, atol=1e-9 * size)
    np.testing.assert_allclose(pulls.sum(axis=0), found.g, rtol=1e-6, atol=1e-9 * size)
    assert 0.1 < found.steepness < 0.95
    _linearise(problem, *at, problem.rhos, 0.0, 0.0, 1e6, GATE, found, pulls=pulls)
    assert found.steepness == 1.0


def one_world(rng, finer=1.0):
    """Keyframes of one and the same plane at 3 m, drawn by shifting one smooth image.

    Its waves are 57 to 125 px long, or ``finer`` by a factor.
    """
    problem = window_problem(rng, points=60, keyframes=3)
    y, x = np.mgrid[:120, :160].astype(float)
    waves = [
        (finer * rng.uniform(0.05, 0.11), *rng.uniform(0, 7, 2), rng.uniform(20, 30))
        for _ in range(6)
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
        prior_information=np.zeros(60), twists=np.zeros((3, 6)), patches=patches, trusts=trusts,
        seen=seen,
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


def with_images(problem, change):
    """The same with changed images, and patches taken from those."""
    images = tuple(np.ascontiguousarray(change(stack)) for stack in problem.images)
    patches, trusts = np.zeros_like(problem.patches), np.zeros_like(problem.trusts)
    pixels = problem.bearings[:, :2] * 150.0 + [80.0, 60.0]
    for n, host in enumerate(problem.hosts):
        own = slice(n, n + 1)
        camera = problem.host_cameras[n]
        take_patches(images[camera][host], pixels[own], 1.0, 50.0, patches[own], trusts[own])
    return replace(problem, images=images, patches=patches, trusts=trusts)


def poses_off(found, true):
    return np.concatenate([log_se3(a @ inverse(b)) for a, b in zip(found, true, strict=True)])


@pytest.mark.parametrize("looseness", [0.0, 2.0])
def test_poses_err_as_claimed(looseness):
    """Noise that patches of a keyframe carry into all others: points are the clusters."""
    runs, values, sizes = 40, [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)

        def noisy(stack, rng=rng):
            out = stack.copy()
            out[..., 0] += 1.5 * rng.normal(size=stack.shape[:3])
            return out

        truth = one_world(np.random.default_rng(7))
        problem = replace(with_images(truth, noisy), looseness=np.full(2, looseness))
        solution = adjust_photometrically(problem, huber=9.0, gate=14.0, iterations=15)
        off = poses_off(solution.T_k_w[1:], truth.T_k_w[1:])
        for k in (0, 6):
            block = slice(k, k + 6)
            own = solution.covariance[block, block]
            values.append(off[block] @ np.linalg.solve(own, off[block]))
            sizes.append(np.sqrt(np.trace(own[:3, :3])) / np.linalg.norm(off[block][:3]))
    low, high = nees_band(runs, 6, 0.99)
    # Residuals are smaller than the noise: each point has fitted its own depth to them.
    assert low < np.mean(values) < 1.35 * high
    assert 0.5 < np.median(sizes) < 2.0


def test_shading_that_stays_with_the_sensor_is_no_motion(rng):
    truth = one_world(rng, finer=4.0)
    y, x = np.mgrid[:120, :160].astype(np.float32)

    def shaded(stack):
        out = stack.copy()
        out[..., 0] += 2e-3 * ((x - 80) ** 2 + (y - 60) ** 2)
        out[..., 1] += 4e-3 * (x - 80)
        out[..., 2] += 4e-3 * (y - 60)
        return out

    moved_by_it = []
    for looseness in (np.zeros(2), np.full(2, 2.0), np.full(2, 100.0)):
        found = [
            adjust_photometrically(
                replace(problem, looseness=looseness),
                huber=9.0,
                gate=14.0,
                iterations=15,
            ).T_k_w
            for problem in (truth, with_images(truth, shaded))
        ]
        moved_by_it.append(np.linalg.norm(poses_off(*found)))
    assert 3e-3 < moved_by_it[0] < 0.1
    assert moved_by_it[1] < 0.6 * moved_by_it[0]
    assert moved_by_it[2] < 0.5 * moved_by_it[1]


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


def two_bands(rng, unit=1.0):
    """The same world with points of both cameras, each followed by its own; rigs that also turn.

    All lengths of the map are ``unit`` times as long as they are in metres, the lever arms not.
    """
    truth = one_world(rng)
    host_cameras = np.tile([0, 1], 30)
    order = np.lexsort((host_cameras, truth.hosts))
    hosts, host_cameras = truth.hosts[order], host_cameras[order]
    # A plane turned in front of fixed cameras: roll about the optical axis moves the second one.
    turns = [exp_se3([0, 0, 0, 0, 0, a]) for a in (0.0, 0.25, -0.2)]
    T_k_w = np.stack([turn @ T for turn, T in zip(turns, truth.T_k_w, strict=True)])
    y, x = np.mgrid[:120, :160].astype(float)
    rays = np.stack([(x - 80) / 150, (y - 60) / 150, np.ones_like(x)], axis=-1)
    stacks = []
    for camera in range(2):
        images = []
        for T in T_k_w:
            T_w_c = inverse(T) @ truth.T_rig_camera[camera]
            points = T_w_c[:3, 3] + 3.0 * rays @ T_w_c[:3, :3].T
            images.append(plane_image(points[..., 0], points[..., 1], T_w_c))
        stacks.append(np.stack(images))
    pixels = truth.bearings[:, :2] * 150 + [80, 60]
    patches, trusts = np.zeros((60, 8)), np.zeros((60, 8))
    for n in range(60):
        take_patches(
            stacks[host_cameras[n]][hosts[n]], pixels[n : n + 1], 1.0, 50.0, patches[n : n + 1],
            trusts[n : n + 1],
        )  # fmt: skip
    seen = np.zeros((60, 3, 2), bool)
    seen[np.arange(60), :, host_cameras] = True
    seen[np.arange(60), hosts, host_cameras] = False
    T_k_w[:, :3, 3] *= unit
    return replace(
        truth, images=tuple(stacks), T_k_w=T_k_w, hosts=hosts, host_cameras=host_cameras,
        rhos=np.full(60, 1 / (3.0 * unit)), patches=patches, trusts=trusts, seen=seen, bands=True,
        rho_priors=np.full(60, 1 / (3.0 * unit)),
    )  # fmt: skip


def plane_image(X, Y, T_w_c):
    """(H, W, 3) brightness of a plane at 3 m and its gradients in pixels."""
    waves = [(9.0, 0.3, 1.0, 25), (12.0, 1.9, 4.0, 30), (7.0, 2.6, 2.0, 25), (14.0, 1.2, 5.0, 20)]
    out = np.zeros((*X.shape, 3))
    R = T_w_c[:3, :3]
    for k, angle, phase, size in waves:
        kx, ky = k * np.cos(angle), k * np.sin(angle)
        wave = kx * X + ky * Y + phase
        out[..., 0] += size * np.sin(wave)
        slope = size * np.cos(wave) * 3.0 / 150
        out[..., 1] += slope * (kx * R[0, 0] + ky * R[1, 0])
        out[..., 2] += slope * (kx * R[0, 1] + ky * R[1, 1])
    return out.astype(np.float32)


@pytest.mark.parametrize("unit", [0.8, 1.0, 1.3])
def test_turns_tell_how_large_the_map_is(rng, unit):
    """Of both signs; and as sure as it is right."""
    problem = two_bands(rng, unit)
    start = replace(problem, rhos=problem.rhos * rng.uniform(0.97, 1.03, 60))
    solution = adjust_photometrically(
        start, huber=9.0, gate=14.0, iterations=40, free_scale=True, hold=HOLD
    )
    # One unit of the map is 1 / unit metres.
    assert solution.log_scale == pytest.approx(-np.log(unit), abs=0.02)
    assert 1e-5 < solution.log_scale_sigma < 0.05
    assert size_of(solution.T_k_w) == pytest.approx(size_of(problem.T_k_w), rel=1e-3)


def test_noise_is_no_information_on_the_scale():
    """Where the other camera compares two views of its own, noise of slopes must not count."""
    errors, sigmas = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)

        def noisy(stack, rng=rng):
            image = stack[..., 0] + 3.0 * rng.normal(size=stack.shape[:3])
            slopes = np.gradient(image, axis=2), np.gradient(image, axis=1)
            return np.stack([image, *slopes], axis=-1).astype(np.float32)

        truth = two_bands(np.random.default_rng(7))
        problem = with_images(truth, noisy)
        problem.seen[...] = True
        problem.seen[np.arange(60), problem.hosts] = False
        solution = adjust_photometrically(
            problem, huber=9.0, gate=25.0, iterations=25, free_scale=True, hold=HOLD
        )
        errors.append(solution.log_scale)
        sigmas.append(solution.log_scale_sigma)
    assert 0.05 < np.median(sigmas) < 0.3
    assert 0.6 < np.sqrt(np.mean(np.square(np.array(errors) / sigmas))) < 1.7
    assert abs(np.mean(errors)) < 0.1


def test_without_a_turn_the_scale_stays_open(rng):
    """Translations of a plane look the same from any lever arm."""
    sigmas = []
    for angle in (0.0, 1.0):
        truth = two_bands(rng)
        problem = truth if angle else replace(
            one_world(rng), bands=True, host_cameras=truth.host_cameras, hosts=truth.hosts,
            seen=truth.seen,
        )  # fmt: skip
        for n in range(60):
            if not angle:
                pixel = problem.bearings[n : n + 1, :2] * 150 + [80, 60]
                take_patches(
                    problem.images[problem.host_cameras[n]][problem.hosts[n]], pixel, 1.0, 50.0,
                    problem.patches[n : n + 1], problem.trusts[n : n + 1],
                )  # fmt: skip
        solution = adjust_photometrically(
            problem, huber=9.0, gate=14.0, iterations=5, free_scale=True, hold=HOLD
        )
        sigmas.append(np.inf if solution is None else solution.log_scale_sigma / solution.sigma)
    assert sigmas[0] > 30 * sigmas[1]


def test_a_wrong_size_pulls_towards_the_right_one(rng):
    """Held at a size that is 10 % too large, the equations say so."""
    problem = two_bands(rng, 1.1)
    solution = adjust_photometrically(problem, huber=9.0, gate=14.0, iterations=6, hold=HOLD)
    assert size_of(solution.T_k_w) == pytest.approx(size_of(problem.T_k_w), rel=1e-3)
    assert -0.2 < solution.log_scale < -0.05
    true = adjust_photometrically(two_bands(rng), huber=9.0, gate=14.0, iterations=6, hold=HOLD)
    assert abs(true.log_scale) < 0.02


def test_late_cameras_tell_how_late_they_are(rng):
    """The second camera looked 20 ms before the stamp, which nobody said."""
    problem = two_bands(rng)
    twists = np.array([[0.0, 0, 0, 0, 0, 0.8], [0, 0, 0, 0, 0, -1.0], [0, 0, 0, 0, 0, 0.5]])
    T_k_w = problem.T_k_w.copy()
    late = replace(
        problem, twists=twists, lags_s=np.array([0.0, 0.0]), bolometers=np.array([False, True])
    )
    # Seen from where the rig was then: the keyframes of the first camera were later.
    moved = [exp_se3(-0.02 * twist) @ T for twist, T in zip(twists, T_k_w, strict=True)]
    images = list(problem.images)
    y, x = np.mgrid[:120, :160].astype(float)
    rays = np.stack([(x - 80) / 150, (y - 60) / 150, np.ones_like(x)], axis=-1)
    fresh = []
    for T in moved:
        T_w_c = inverse(T) @ problem.T_rig_camera[0]
        points = T_w_c[:3, 3] + 3.0 * rays @ T_w_c[:3, :3].T
        fresh.append(plane_image(points[..., 0], points[..., 1], T_w_c))
    images[0] = np.stack(fresh)
    patches, trusts = problem.patches.copy(), problem.trusts.copy()
    pixels = problem.bearings[:, :2] * 150 + [80, 60]
    for n in np.flatnonzero(problem.host_cameras == 0):
        take_patches(
            images[0][problem.hosts[n]], pixels[n : n + 1], 1.0, 50.0, patches[n : n + 1],
            trusts[n : n + 1],
        )  # fmt: skip
    late = replace(
        late, images=tuple(images), T_k_w=np.stack(moved), patches=patches, trusts=trusts
    )
    solution = adjust_photometrically(late, huber=9.0, gate=40.0, iterations=40, free_lag=True)
    assert solution.lag_s == pytest.approx(0.02, abs=0.002)
    assert 0.0 < solution.lag_sigma_s < 0.002
