"""First distances of one host count together as a few."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.direct.photometric_bundle import _Equations, _moved
from thermal_stereo_vo.odometry.direct.shared_guesses import SharedGuesses

GUESSES = np.linspace(0.2, 0.9, 400)
INFORMATION = (2.0 / (0.5 * GUESSES)) ** 2


def guessed(group=None, information=INFORMATION):
    group = np.zeros(400, np.int64) if group is None else group
    return SharedGuesses.of(group, 2, GUESSES, information)


def cost(guesses, rhos):
    errors = guesses.errors(rhos)
    off = rhos - guesses.means(errors)
    return float(INFORMATION @ off**2) + guesses.cost(errors)


def test_where_nothing_was_guessed_nothing_is_shared():
    assert guessed(information=np.zeros(400)) is None


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_a_common_error_is_found_and_costs_little(factor):
    guesses = guessed()
    rhos = factor * GUESSES
    errors = guesses.errors(rhos)
    assert errors[0] == pytest.approx(factor - 1.0, abs=0.01)
    # By 0.2 at once where each may be off by 0.5: not 400 errors of that size, but about one.
    expected = (2.0 * (factor - 1.0) / 0.2) ** 2
    assert cost(guesses, rhos) == pytest.approx(expected, rel=0.03, abs=1e-9)


def test_errors_of_their_own_cost_as_ever(rng):
    rhos = GUESSES * (1.0 + 0.3 * rng.permutation(np.tile([-1.0, 1.0], 200)))
    alone = float(INFORMATION @ (rhos - GUESSES) ** 2)
    assert cost(guessed(), rhos) == pytest.approx(alone, rel=0.02)


def test_the_best_error_is_the_least_cost(rng):
    guesses = guessed(group=np.arange(400) % 2)
    rhos = GUESSES * rng.uniform(0.5, 1.2, 400)
    best = guesses.errors(rhos)
    least = cost(guesses, rhos)
    for group in range(2):
        for small in (-1e-3, 1e-3):
            errors = best.copy()
            errors[group] += small
            off = rhos - guesses.means(errors)
            assert float(INFORMATION @ off**2) + guesses.cost(errors) > least


def test_groups_err_apart():
    guesses = guessed(group=np.repeat([0, 1], 200))
    rhos = GUESSES * np.repeat([0.8, 1.0], 200)
    np.testing.assert_allclose(guesses.errors(rhos), [-0.2, 0.0], atol=0.01)


def test_a_wall_that_is_nearer_than_guessed_moves_as_one(rng):
    """Each depth is told to a tenth of what its guess says: together they win, alone they lose."""
    guesses = guessed()
    told = 0.1 * INFORMATION
    true = 1.3 * GUESSES
    A, g = np.eye(1), np.zeros(1)
    rhos, W = GUESSES.copy(), np.zeros((400, 1))
    for _ in range(2):
        errors = guesses.errors(rhos)
        h_rho = INFORMATION + told
        b_rho = INFORMATION * (guesses.means(errors) - rhos) + told * (true - rhos)
        step = guesses.eliminate(W, h_rho, b_rho, A, g, np.zeros((0, 1)))
        rhos = rhos + (b_rho + step.pulls_on_depths(np.zeros(1))) / h_rho
    alone = (INFORMATION * GUESSES + told * true) / (INFORMATION + told)
    assert np.median(alone / GUESSES) == pytest.approx(1.03, abs=0.01)
    assert np.median(rhos / GUESSES) == pytest.approx(1.26, abs=0.01)


def test_eliminating_them_is_solving_for_all_at_once(rng):
    """Two keyframes of one camera (U = 18), 20 points, half of them guessed, in three groups."""
    U, N, J = 18, 20, 3
    group, rhos = rng.integers(0, J, N), rng.uniform(0.2, 0.8, N)
    information = rng.uniform(1.0, 5.0, N) * (np.arange(N) % 2)
    guesses = SharedGuesses.of(group, J, rhos * rng.uniform(0.7, 1.3, N), information)
    errors = guesses.errors(rhos)
    root = rng.normal(size=(200, U + N))
    data = root.T @ root
    data[U:, U:] = np.diag(np.diag(data)[U:])
    data[np.diag_indices(U + N)] += 50.0
    right = rng.normal(size=U + N)
    # All unknowns together: everything else, depths, errors.
    H, b = np.zeros((U + N + J,) * 2), np.zeros(U + N + J)
    H[:-J, :-J], b[:-J] = data, right
    for n in range(N):
        slope = np.zeros(U + N + J)
        slope[U + n], slope[U + N + group[n]] = 1.0, -guesses.rhos[n]
        off = guesses.means(errors)[n] - rhos[n]
        H += information[n] * np.outer(slope, slope)
        b += information[n] * slope * off
    H[-J:, -J:] += np.diag(guesses.worths)
    b[-J:] -= guesses.worths * errors
    step = np.linalg.solve(H, b)

    out = _Equations(
        A=data[:U, :U].copy(),
        g=right[:U].copy(),
        W=data[U:, :U],
        h_rho=np.diag(data)[U:] + information,
        b_rho=right[U:] + information * (guesses.means(errors) - rhos),
        energies=np.zeros((N, 2, 1)),
    )
    out.A -= out.W.T @ (out.W / out.h_rho[:, None])
    pulls = -out.W * (out.b_rho / out.h_rho)[:, None]
    out.g += pulls.sum(axis=0)
    out.shared = guesses.eliminate(out.W, out.h_rho, out.b_rho, out.A, out.g, pulls)
    np.testing.assert_allclose(np.linalg.solve(out.A, out.g), step[:U], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(right[:U] + pulls.sum(axis=0), out.g, rtol=1e-9, atol=1e-12)
    T, brightness = np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 1, 2))
    _, _, moved = _moved(T, brightness, rhos, out, step[:U])
    np.testing.assert_allclose(moved - rhos, step[U:-J], rtol=1e-6, atol=1e-12)
