"""What leaving keyframes leave behind: against full problems, and what it must not claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import adjoint, exp_se3, inverse
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    _Equations,
    _linearise,
    left_behind,
)
from thermal_stereo_vo.odometry.direct.window_prior import (
    WindowPrior,
    eliminate,
    eliminate_reference,
)

from .smooth_world import window_problem

K, C, SIZE = 4, 2, 10
U = K * SIZE + 2
HUBER, GATE = 15.0, 1e4


def state(rng):
    """Poses and brightness of some keyframes."""
    T = np.stack([exp_se3(rng.normal(size=6) * [0.5, 0.5, 0.5, 0.2, 0.2, 0.2]) for _ in range(K)])
    return T, rng.normal(size=(K, C, 2))


def moved(T, brightness, step):
    frames = step[:-2].reshape(len(T), SIZE)
    T_new = np.stack([exp_se3(d[:6]) @ t for d, t in zip(frames, T, strict=True)])
    return T_new, brightness + frames[:, 6:].reshape(len(T), C, 2)


def test_elimination_is_the_schur_complement(rng):
    J = rng.normal(size=(60, 12))
    J[:, 4] = J[:, 7] = 0.0  # nothing shows these
    H, b = J.T @ J, J.T @ rng.normal(size=60)
    own = np.zeros(12, bool)
    own[[1, 4, 5, 9]] = True
    expected_H, expected_b = eliminate_reference(H, b, own)
    eliminate(H, b, own)
    np.testing.assert_allclose(H[np.ix_(~own, ~own)], expected_H, atol=1e-10)
    np.testing.assert_allclose(b[~own], expected_b, atol=1e-10)
    assert not H[own].any()
    assert not b[own].any()
    np.testing.assert_array_equal(H, H.T)


def test_marginalising_first_gives_what_solving_all_at_once_gives(rng):
    """Residuals J d - y in the unknowns themselves, taken in two portions about two states."""
    T, light = state(rng)
    rows = [rng.normal(size=(80, U)) for _ in range(3)]
    for J in rows:
        J[:, -2] = 0.0  # the scale is held
    sights = [rng.normal(size=80) for _ in range(3)]
    before = 1e-2 * rng.normal(size=U)
    before[-2:] = 0.0, 2e-3
    prior = WindowPrior.nothing(T, light, 0.01)
    J, y = rows[0], sights[0]
    prior = prior.grown(J.T @ J, J.T @ y, T, light, 0.01, J * y[:, None])
    J, y = rows[1], sights[1] - rows[1] @ before
    there = *moved(T, light, before), 0.01 + before[-1]
    prior = prior.grown(J.T @ J, J.T @ y, *there, J * y[:, None])
    prior = prior.without(1)
    stay = np.ones(U, bool)
    stay[SIZE : 2 * SIZE] = False
    free = np.ones(U, bool)
    free[-2] = False
    # What comes later speaks of those that stay.
    J = rows[2] * stay
    A = sum(r.T @ r for r in [rows[0], rows[1], J])
    g = sum(r.T @ s for r, s in zip([rows[0], rows[1], J], sights, strict=True))
    everything = np.zeros(U)
    everything[free] = np.linalg.solve(A[np.ix_(free, free)], g[free])
    H, b = prior.H + (J.T @ J)[np.ix_(stay, stay)], prior.b + (J.T @ sights[2])[stay]
    rest = np.flatnonzero(free[stay])
    later = np.linalg.solve(H[np.ix_(rest, rest)], b[rest])
    np.testing.assert_allclose(later, everything[stay & free], rtol=1e-9, atol=1e-9)
    # The offsets are those of the state, in the order of the unknowns.
    step = everything.copy()
    after = moved(T, light, step)
    left = np.arange(K) != 1
    offsets = prior.offsets(after[0][left], after[1][left], 0.01 + step[-1])
    np.testing.assert_allclose(offsets[rest], step[stay][rest], atol=1e-8)


def test_a_lag_that_is_forgotten_leaves_the_others_what_any_lag_would(rng):
    problem = replace(
        window_problem(rng, points=32, keyframes=K), bands=True, bolometers=np.array([False, True])
    )
    prior = left_behind(problem, 0, huber=HUBER, gate=GATE, weight=1.0)
    prior = replace(prior, b=prior.b + np.abs(prior.H).max() * rng.normal(size=len(prior.b)))
    assert prior.H[-1, -1] > 0.0
    found = prior.forgetting_lag()
    own = np.arange(len(prior.b)) == len(prior.b) - 1
    H, b = eliminate_reference(prior.H, prior.b, own)
    size = np.abs(prior.H).max()
    np.testing.assert_allclose(found.H[:-1, :-1], H, rtol=1e-7, atol=1e-9 * size)
    np.testing.assert_allclose(found.b[:-1], b, rtol=1e-7, atol=1e-6 * size)
    assert not np.any(found.H[-1])
    assert found.b[-1] == 0.0
    assert not np.any(found.scatter[-1])


def one_camera(rng):
    """Four keyframes seen by one camera, as when the scale is not known; its arm is zero."""
    problem = window_problem(rng, points=32, keyframes=K)
    seen = problem.seen.copy()
    seen[..., 1] = False
    seen[problem.host_cameras == 1] = False
    return replace(
        problem,
        bands=True,
        seen=seen,
        T_rig_camera=np.stack([np.eye(4), problem.T_rig_camera[1]]),
        prior_information=np.zeros_like(problem.prior_information),
    )


def gauge(T):
    """(U, 7) steps that move the whole map, and at last the one that makes it larger."""
    out = np.zeros((len(T) * SIZE + 2, 7))
    for k, T_k in enumerate(T):
        out[k * SIZE : k * SIZE + 6, :6] = adjoint(T_k)
        out[k * SIZE : k * SIZE + 3, 6] = T_k[:3, 3]
    return out


def share_of(H, directions):
    """Largest information along any of the directions, of that of single unknowns."""
    scale = np.sqrt(np.diag(H)) + 1e-12
    unit = directions * scale[:, None]
    unit /= np.linalg.norm(unit, axis=0)
    return np.abs(np.einsum("ij,ik,kj->j", unit, H / np.outer(scale, scale), unit)).max()


@pytest.mark.parametrize("fixed", [True, False])
def test_nothing_becomes_known_of_the_place_and_size_of_the_map(rng, fixed):
    """Two keyframes leave at different states.  Without first estimates the size seems known."""
    problem = one_camera(rng)
    prior = left_behind(problem, 0, huber=HUBER, gate=GATE, weight=1.0)
    assert np.linalg.norm(prior.H) > 1e3
    first = prior.T_first
    assert share_of(prior.H, gauge(first)) < 1e-9
    # Meanwhile the adjustment has moved the others, and points of the next one go.
    T = np.stack([exp_se3(0.05 * rng.normal(size=6)) @ t for t in problem.T_k_w[1:]])
    there = problem.take(problem.hosts > 0)
    there = replace(
        there,
        slots=problem.slots[1:],
        T_k_w=T,
        twists=problem.twists[1:],
        brightness=problem.brightness[1:],
        hosts=there.hosts - 1,
        seen=there.seen[:, 1:],
        prior=prior,
    )
    if not fixed:
        there = replace(there, prior=replace(prior, T_first=T))
    again = left_behind(there, 0, huber=HUBER, gate=GATE, weight=1.0)
    known = share_of(again.H, gauge(first[1:] if fixed else T[1:]))
    assert known < 1e-9 if fixed else known > 1e-5


def test_it_is_a_sum_of_squares(rng):
    for bands in (False, True):
        problem = replace(window_problem(rng, points=32, keyframes=K), bands=bands)
        prior = left_behind(problem, 1, huber=HUBER, gate=GATE, weight=0.5)
        values = np.linalg.eigvalsh(prior.H)
        assert values[0] > -1e-9 * values[-1]
        assert values[-1] > 1e3


def test_keyframes_move_pixels_as_at_their_first_estimates(rng):
    """Equations with a prior: residuals of now, Jacobians of then, and the pull of the prior."""
    problem = window_problem(rng, points=24, keyframes=K)
    then = np.stack([exp_se3(0.02 * rng.normal(size=6)) @ T for T in problem.T_k_w])
    light = problem.brightness + 0.05 * rng.normal(size=(K, C, 2))
    J = rng.normal(size=(200, U))
    prior = WindowPrior.nothing(then, light, 0.015)
    prior = prior.grown(J.T @ J, J.T @ rng.normal(size=200), then, light, 0.015, J)
    at = problem.T_k_w, problem.brightness, problem.rhos, 0.0, 0.0
    problem = replace(problem, bolometers=np.array([False, True]))
    alone, both = _Equations.of(problem), _Equations.of(problem)
    _linearise(problem, *at, HUBER, GATE, alone, prior.slopes_at(then, light))
    _linearise(replace(problem, prior=prior), *at, HUBER, GATE, both)
    off = prior.offsets(problem.T_k_w, problem.brightness, 0.02)
    assert off[-1] == pytest.approx(0.005)
    np.testing.assert_allclose(both.A, alone.A + prior.H, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(both.g, alone.g + prior.b - prior.H @ off, rtol=1e-9, atol=1e-6)
    assert both.cost == pytest.approx(alone.cost + off @ prior.H @ off - 2 * prior.b @ off)
    # Residuals do not depend on where Jacobians are taken.
    here = _Equations.of(problem)
    _linearise(problem, *at, HUBER, GATE, here)
    assert here.cost == pytest.approx(alone.cost)
    assert np.abs(here.A - alone.A).max() > 1.0


def test_another_unit_changes_nothing_but_the_unit(rng):
    T, light = state(rng)
    J = rng.normal(size=(80, U))
    J[:, -2] = 0.0
    prior = WindowPrior.nothing(T, light, 0.0).grown(
        J.T @ J, J.T @ rng.normal(size=80), T, light, 0, J
    )
    now = moved(T, light, 0.1 * rng.normal(size=U))
    about_m, factor = np.array([1.0, -2.0, 0.5]), 3.5

    def larger(T_k_w):
        out = []
        for T_k in T_k_w:
            T_w = inverse(T_k)
            T_w[:3, 3] = about_m + factor * (T_w[:3, 3] - about_m)
            out.append(inverse(T_w))
        return np.stack(out)

    def cost(prior, T_k_w):
        off = prior.offsets(T_k_w, now[1], 0.01)
        return off @ prior.H @ off - 2.0 * prior.b @ off

    again = prior.rescaled(factor, about_m)
    assert cost(again, larger(now[0])) == pytest.approx(cost(prior, now[0]), rel=1e-9)
    assert cost(again, now[0]) != pytest.approx(cost(prior, now[0]), rel=1e-3)
    # These pulls scatter as the equations say, in any unit.
    np.testing.assert_allclose(again.scatter, again.H, rtol=1e-9)


def test_a_new_keyframe_is_not_known(rng):
    T, light = state(rng)
    J = rng.normal(size=(80, U))
    prior = WindowPrior.nothing(T, light, 0.0).grown(
        J.T @ J, J.T @ rng.normal(size=80), T, light, 0, J
    )
    more = prior.with_newest(np.eye(4), np.ones((C, 2)))
    np.testing.assert_array_equal(more.known, [True] * K + [False])
    T_more = np.concatenate([T, exp_se3(np.full(6, 0.3))[None]])
    light_more = np.concatenate([light, np.full((1, C, 2), 7.0)])
    slopes = more.slopes_at(T_more, light_more)
    np.testing.assert_array_equal(slopes[0][-1], T_more[-1])
    np.testing.assert_array_equal(slopes[1][-1], light_more[-1])
    back = more.without(K)
    np.testing.assert_allclose(back.H, prior.H)
    np.testing.assert_allclose(back.b, prior.b)
    np.testing.assert_allclose(back.scatter, prior.scatter)


def test_what_points_that_left_disagreed_by_is_known_of_those_that_stay(rng):
    """Redraw the pulls many times: the right side that is left scatters as the prior says."""
    T, light = state(rng)
    J = rng.normal(size=(120, U))
    J[:, -2] = 0.0
    spread = rng.uniform(0.2, 3.0, 120)
    rights, scatters = [], []
    for _ in range(400):
        y = spread * rng.normal(size=120)
        prior = WindowPrior.nothing(T, light, 0.0)
        prior = prior.grown(J.T @ J, J.T @ y, T, light, 0.0, J * y[:, None]).without(1)
        rights.append(prior.b)
        scatters.append(prior.scatter)
    found, told = np.cov(np.array(rights).T), np.mean(scatters, axis=0)
    known = np.diag(told) > 0.0
    assert known.sum() == U - SIZE - 1
    size = np.sqrt(np.diag(told)[known])
    of_noise = (found[np.ix_(known, known)] / np.outer(size, size)) - (
        told[np.ix_(known, known)] / np.outer(size, size)
    )
    np.testing.assert_allclose(of_noise, 0.0, atol=0.3)
    np.testing.assert_allclose(np.mean(np.diag(of_noise)), 0.0, atol=0.05)
