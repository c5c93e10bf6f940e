"""Equations gathered over a patch: the kernels against the plain, pixel-wise form."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.direct.patch_sums import (
    BY_LAG,
    BY_RHO,
    LOG_SCALE,
    SLOPES,
    SUMS,
    compare_patch,
    gather_patch,
    middle_slopes,
    middle_slopes_at_home,
    relative_to_home,
    share_slopes,
    view_patch,
    warp_of_patch,
)
from thermal_stereo_vo.odometry.direct.photometric import (
    LAG,
    RHO,
    SCALE,
    huber_weight,
    linearise_patch,
    patch_energy,
    resample_patch,
)
from thermal_stereo_vo.odometry.direct.window_equations import add_slopes

from .smooth_world import CAMERAS, T_RIG_CAMERA, smooth_image

MIDDLE = 4
"""The pixel of the pattern without offset."""
BEARING, RHO_AT, GAIN, B_HOST, B_TARGET, HUBER = np.array([0.1, -0.05, 1.0]), 0.4, 0.8, 4.0, -3.0, 9


@pytest.fixture
def seen(rng):
    """A patch as both forms see it in the second camera: residuals, Jacobian, view, G, images."""
    image, patch = smooth_image(rng), rng.normal(size=8) * 30
    T, C = exp_se3([0.05, -0.03, 0.04, 0.02, -0.03, 0.05]), inverse(T_RIG_CAMERA[1])
    arms = np.stack([[0.1, -0.2, 0.05], C[:3, 3]])
    step = 1.0 / CAMERAS[0, :2]
    r, J = np.empty(8), np.zeros((8, 11))
    assert linearise_patch(
        image, CAMERAS[1], 1.0, T, C, arms, BEARING, RHO_AT, step, patch, GAIN, B_HOST, B_TARGET,
        r, J,
    )  # fmt: skip
    view, G = np.empty((3, 8)), np.zeros((2, SLOPES))
    place = BEARING[0], BEARING[1], RHO_AT
    assert view_patch(image[None], 0, tuple(CAMERAS[1]), (C @ T)[None], 0, *place, *step, view)
    middle_slopes(T[None], 0, C[None], 0, arms[None], *place, G)
    return {"image": image, "patch": patch, "r": r, "J": J, "view": view, "G": G, "step": step}


def compared(seen, trusts, huber=HUBER):
    r, weights = np.empty(8), np.empty(8)
    energy = compare_patch(
        seen["view"], seen["patch"], trusts, GAIN, B_HOST, B_TARGET, huber, r, weights
    )
    return energy, r, weights


def columns(seen):
    """(8, 11) Jacobian as the kernels gather it, in the order of a pair; last the depth."""
    view, G = seen["view"], seen["G"]
    moves = np.outer(view[1], G[0]) + np.outer(view[2], G[1])
    light = np.column_stack([-GAIN * (seen["patch"] - B_HOST), -np.ones(8)])
    return np.column_stack([moves[:, :6], light, moves[:, 6:]])


def test_residuals_and_weights_are_those_of_the_pixelwise_form(seen, rng):
    trusts = rng.uniform(0.3, 1.0, 8)
    energy, r, weights = compared(seen, trusts)
    np.testing.assert_allclose(r, seen["r"], atol=1e-3)
    expected = [t * huber_weight(e, HUBER) for t, e in zip(trusts, r, strict=True)]
    np.testing.assert_allclose(weights, expected)
    assert energy == pytest.approx(patch_energy(r, trusts, HUBER))
    assert (np.abs(r) > HUBER).any()
    assert (np.abs(r) < HUBER).any()


def test_slopes_are_exact_in_the_middle_and_near_by_around(seen):
    J = columns(seen)
    exact = seen["J"][:, [0, 1, 2, 3, 4, 5, 6, 7, SCALE, RHO]]
    mine = np.delete(J, 9, axis=1)
    np.testing.assert_allclose(mine[MIDDLE], exact[MIDDLE], rtol=1e-5, atol=1e-5)
    size = np.abs(exact).max(axis=0)
    np.testing.assert_allclose(mine / size, exact / size, atol=0.25)
    assert np.abs(mine - exact).max() > 1e-3  # it is an approximation


def equations(J, r, weights):
    return J.T @ (weights[:, None] * J), J.T @ (weights * r)


def gathered(seen, r, weights, looseness=0.0):
    sums, w, tail = np.empty(SUMS), np.empty(10), np.empty(2)
    H, v = np.zeros((3, 10, 10)), np.zeros((3, 10))
    gather_patch(seen["view"], seen["patch"], GAIN, B_HOST, looseness, r, weights, sums)
    add_slopes(seen["G"], sums, 0, 1, H, v, w, tail)
    assert not H[[0, 2]].any()
    return np.triu(H[1]), v[1], w, tail


def expect(found, J, r, weights):
    H, b = equations(J, r, weights)
    scale = np.sqrt(np.diag(H))
    upper, v, w, tail = found
    expected = np.triu(H[:10, :10])
    np.testing.assert_allclose(
        upper / np.outer(scale, scale)[:10, :10],
        expected / np.outer(scale, scale)[:10, :10],
        atol=1e-10,
    )
    np.testing.assert_allclose(v / scale[:10], -b[:10] / scale[:10], atol=1e-9)
    np.testing.assert_allclose(w / scale[:10], H[:10, 10] / scale[:10], atol=1e-9 * scale[10])
    np.testing.assert_allclose(tail, [H[10, 10], b[10]], rtol=1e-9)


def test_gathered_equations_are_those_of_all_pixels(seen, rng):
    _, r, weights = compared(seen, rng.uniform(0.3, 1.0, 8))
    seen["G"][:, BY_LAG] = rng.normal(size=2)
    expect(gathered(seen, r, weights), columns(seen), r, weights)


def test_what_a_patch_is_off_as_a_whole_is_eliminated(seen, rng):
    """As one more unknown of each patch, held at zero by its prior: the dense form."""
    trusts, looseness, wide = rng.uniform(0.3, 1.0, 8), 1.7, 1e6
    seen["G"][:, BY_LAG] = rng.normal(size=2)
    energy, r, weights = compared(seen, trusts, wide)
    W = np.diag(trusts)
    ones = np.ones((8, 1))
    whole = W - W @ ones @ np.linalg.inv(ones.T @ W @ ones + 1.0 / looseness) @ ones.T @ W
    J = columns(seen)
    H, b = J.T @ whole @ J, J.T @ whole @ r
    scale = np.sqrt(np.diag(J.T @ W @ J))
    both = np.outer(scale, scale)
    upper, v, w, tail = gathered(seen, r, weights, looseness=looseness)
    given = seen["view"], seen["patch"], GAIN, B_HOST, looseness, r, weights
    explained = gather_patch(*given, np.empty(SUMS))
    np.testing.assert_allclose(upper / both[:10, :10], np.triu(H[:10, :10]) / both[:10, :10],
                               atol=1e-10)  # fmt: skip
    np.testing.assert_allclose(v / scale[:10], -b[:10] / scale[:10], atol=1e-9)
    np.testing.assert_allclose(w / scale[:10], H[:10, 10] / scale[:10], atol=1e-9 * scale[10])
    np.testing.assert_allclose(tail, [H[10, 10], b[10]], rtol=1e-8)
    assert explained == pytest.approx(energy - r @ whole @ r)
    assert explained > 0.1 * energy


def plane_point(T, x, y):
    q = T[:3, :3] @ [x, y, 1.0] + RHO_AT * T[:3, 3]
    return q[:2] / q[2]


def test_a_patch_is_distorted_as_its_neighbours_move():
    T_home, T = (
        exp_se3([0.15, 0.02, -0.03, 0.1, -0.2, 0.3]),
        exp_se3([0.1, -0.3, 0.2, -0.1, 0.2, 0]),
    )
    warp, back = np.empty((2, 2)), np.empty((2, 2))
    x, y = BEARING[:2]
    assert warp_of_patch(T[None], 0, T_home[None], 0, x, y, RHO_AT, warp, back)
    h = 1e-6

    def slopes(T):
        by_x = (plane_point(T, x + h, y) - plane_point(T, x - h, y)) / (2 * h)
        by_y = (plane_point(T, x, y + h) - plane_point(T, x, y - h)) / (2 * h)
        return np.column_stack([by_x, by_y])

    np.testing.assert_allclose(warp, slopes(T) @ np.linalg.inv(slopes(T_home)), atol=1e-7)
    np.testing.assert_allclose(warp @ back, np.eye(2), atol=1e-12)
    # The plane at the depth of the patch goes through the camera: what it shows is a line.
    beside = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0.5 / RHO_AT], [0, 0, 0, 1]])
    beside[0, 3] = -1.0 / RHO_AT
    assert not warp_of_patch(beside[None], 0, T_home[None], 0, x, y, RHO_AT, warp, back)


def at_home(rng, seen):
    """The view of another camera's image at the host's time, and how that moves there."""
    arm, drift = np.array([0.15, 0.02, -0.01]), np.array([0.2, -0.1, 0.1, 0.1, -0.15, 0.3])
    T = exp_se3([0.15, 0.02, -0.03, 0.01, -0.02, 0.015])
    image = smooth_image(rng)
    patch, trust, slopes = np.zeros(8), np.zeros(8), np.zeros((3, 8))
    assert resample_patch(
        image, CAMERAS[1], T, arm, drift, BEARING, RHO_AT, seen["step"], 30.0, patch, trust, slopes
    )
    home, G_home = np.empty((3, 8)), np.empty((2, 3))
    place = BEARING[0], BEARING[1], RHO_AT
    assert view_patch(image[None], 0, tuple(CAMERAS[1]), T[None], 0, *place, *seen["step"], home)
    middle_slopes_at_home(T[None], arm[None], drift[None], 0, *place, G_home)
    np.testing.assert_allclose(home[0], patch, atol=1e-3)
    moves = np.outer(home[1], G_home[0]) + np.outer(home[2], G_home[1])
    np.testing.assert_allclose(moves[MIDDLE], slopes[:, MIDDLE], rtol=1e-5, atol=1e-5)
    return home, G_home, patch, trust


def test_where_the_patch_itself_moves_too(seen, rng):
    """A patch taken from another camera's image: by scale, lag and depth it moves there as well.

    Where both views agree the equations are those of both motions with the slopes of each.
    """
    home, G_home, patch, trust = at_home(rng, seen)
    warp, back = np.array([[1.1, 0.2], [-0.1, 0.9]]), np.linalg.inv([[1.1, 0.2], [-0.1, 0.9]])
    seen["patch"] = patch
    seen["G"][:, BY_LAG] = rng.normal(size=2)
    seen["view"][1:] = GAIN * back.T @ home[1:]
    _, r, weights = compared(seen, trust)
    J = columns(seen)
    J[:, [8, 9, 10]] -= GAIN * (np.outer(home[1], G_home[0]) + np.outer(home[2], G_home[1]))
    agreed = seen["view"].copy()
    share_slopes(home[None, 1:], 0, GAIN, back, seen["view"])
    np.testing.assert_allclose(seen["view"], agreed, atol=1e-12)
    relative_to_home(warp, np.stack([np.full((2, 3), np.nan), G_home]), 1, seen["G"])
    expect(gathered(seen, r, weights), J, r, weights)
    assert (LOG_SCALE, BY_LAG, BY_RHO, LAG) == (6, 7, 8, 9)


def test_what_moves_both_views_alike_is_not_seen_whatever_the_noise(seen, rng):
    home, G_home, _, _ = at_home(rng, seen)
    warp, back = np.array([[1.1, 0.2], [-0.1, 0.9]]), np.linalg.inv([[1.1, 0.2], [-0.1, 0.9]])
    noisy, own = seen["view"].copy(), seen["view"].copy()
    share_slopes(home[None, 1:], 0, GAIN, back, noisy)
    np.testing.assert_allclose(noisy[1:], 0.5 * (own[1:] + GAIN * back.T @ home[1:]), atol=1e-12)
    seen["G"][:, LOG_SCALE:] = warp @ G_home
    relative_to_home(warp, G_home[None], 0, seen["G"])
    np.testing.assert_allclose(seen["G"][:, LOG_SCALE:], 0.0, atol=1e-15)
    assert np.abs(seen["G"][:, :LOG_SCALE]).max() > 0.1
