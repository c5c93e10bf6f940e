"""The pose of one frame against points whose depths are uncertain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, transform_points
from thermal_stereo_vo.odometry.feature_based.frame_pose import (
    frame_residuals,
    frame_residuals_reference,
    linearise_frame,
    mark_inliers,
    prosac_samples,
    ransac_frame_pose,
    refine_frame_pose,
    robust_sigma,
    samples_needed,
)

from .stereo_problems import CAMERA, seen_points
from .window_problems import (
    NO_TURN,
    TURN,
    eliminated,
    eyes_of,
    mean_nees_band,
    numeric_jacobian,
    path,
    seen_by,
)

GAIN = CAMERA.fx * CAMERA.baseline_m
turns = pytest.mark.parametrize("turn", [NO_TURN, TURN], ids=("straight", "turned"))


@dataclass(frozen=True)
class Frame:
    """Points of three keyframes seen by a fourth pose, ``T_true``."""

    T_hosts: np.ndarray
    hosts: np.ndarray
    bearings: np.ndarray
    rhos: np.ndarray
    rho_information: np.ndarray
    observed: np.ndarray
    weights: np.ndarray
    T_true: np.ndarray
    turn: np.ndarray

    @property
    def geometry(self):
        return self.T_hosts, self.hosts, self.bearings, self.rhos

    def reference(self, T, rhos=None):
        depths = self.rhos if rhos is None else rhos
        return frame_residuals_reference(
            T, self.T_hosts, self.hosts, self.bearings, depths, self.observed, CAMERA, self.turn
        )

    def refined(self, T_start, **options):
        return refine_frame_pose(
            T_start,
            *self.geometry,
            self.rho_information,
            self.observed,
            self.weights,
            eyes_of(self.turn),
            **{"sigma_floor_px": 0.05, **options},
        )


def make_frame(
    rng, n=60, *, sigma_px=0.3, depth_sigma_px=0.05, turn=NO_TURN, holes=0.0, depth_m=(4.0, 40.0)
):
    T_hosts = path(rng, 3)
    T_true = exp_se3(rng.normal(0, [0.4] * 3 + [0.05] * 3)) @ T_hosts[-1]
    hosts = np.sort(np.arange(n) % 3)
    in_host = seen_points(rng, n, depth_m)
    points_w = np.array(
        [
            transform_points(inverse(T_hosts[h]), p[None])[0]
            for h, p in zip(hosts, in_host, strict=True)
        ]
    )
    observed = seen_by(T_true, points_w, turn) + rng.normal(0, sigma_px, (n, 4))
    lost = rng.random((n, 2)) < holes
    observed[:, :2][lost[:, 0]] = np.nan
    observed[:, 2:][lost[:, 1]] = np.nan
    rhos = np.maximum(1.0 / in_host[:, 2] + rng.normal(0, depth_sigma_px, n) / GAIN, 1e-5)
    # In px^2 m^2: what one observation of unit weight would have to say.
    share = (sigma_px / depth_sigma_px) ** 2 if depth_sigma_px > 0.0 else 1e6
    return Frame(
        T_hosts, hosts, in_host / in_host[:, 2:], rhos, np.full(n, GAIN**2 * share), observed,
        np.ones(n), T_true, turn,
    )  # fmt: skip


def near(rng, T, size_m=0.05):
    return exp_se3(rng.normal(0, [size_m] * 3 + [0.2 * size_m] * 3)) @ T


def difference(pose, T):
    return log_se3(pose.T_camera_world @ inverse(T))


def squared_sigmas(pose, T):
    e = difference(pose, T)
    return float(e @ np.linalg.solve(pose.covariance, e))


# ------------------------------------------------------------------------- residuals, linearisation


@turns
def test_residuals_are_those_of_the_plain_form(rng, turn):
    frame = make_frame(rng, turn=turn, holes=0.3)
    T = near(rng, frame.T_true)
    out = np.empty_like(frame.observed)
    frame_residuals(T, *frame.geometry, frame.observed, eyes_of(turn), out)
    np.testing.assert_allclose(out, frame.reference(T), atol=1e-9)
    blind = np.isnan(frame.observed[:, 0])
    assert 5 < np.isfinite(out[blind, 3]).sum() < blind.sum() < len(out)
    assert np.isnan(out[~blind, 3]).all()


def test_at_the_truth_without_noise_nothing_is_left(rng):
    """The second order of the turn aside, which the right eye's model leaves out."""
    for turn, limit_px in ((NO_TURN, 1e-9), (TURN, 0.05)):
        frame = make_frame(rng, sigma_px=0.0, depth_sigma_px=0.0, turn=turn)
        assert np.nanmax(np.abs(frame.reference(frame.T_true))) < limit_px


def linearised(frame, T, width):
    A, g = np.full((6, 6), np.nan), np.full(6, np.nan)
    cost = linearise_frame(
        T, *frame.geometry, frame.rho_information, frame.observed, frame.weights,
        eyes_of(frame.turn), width, A, g,
    )  # fmt: skip
    return cost, A, g


def dense_equations(frame, T, width):
    """Of pose and all inverse depths at once, by differences of the plain residuals."""
    n = len(frame.rhos)

    def residuals(x):
        return frame.reference(exp_se3(x[:6]) @ T, frame.rhos + x[6:] / GAIN).ravel()

    r = residuals(np.zeros(6 + n))
    seen = np.isfinite(r)
    J = -numeric_jacobian(residuals, np.zeros(6 + n), 1e-5)[seen]
    J[:, 6:] *= GAIN
    w = np.repeat(frame.weights, 4)[seen] / (1.0 + (r[seen] / width) ** 2)
    H, b = J.T @ (w[:, None] * J), J.T @ (w * r[seen])
    H[6:, 6:] += np.diag(frame.rho_information)
    cost = np.sum(
        np.repeat(frame.weights, 4)[seen] * 0.5 * width**2 * np.log1p((r[seen] / width) ** 2)
    )
    return cost, H, b


@turns
@pytest.mark.parametrize("known", [0.0, 1.0], ids=("free depths", "held depths"))
def test_equations_are_those_of_all_unknowns_with_the_depths_eliminated(rng, turn, known):
    frame = make_frame(rng, 25, turn=turn, holes=0.2, depth_sigma_px=0.5)
    frame = replace(
        frame,
        weights=rng.uniform(0.3, 2.0, 25),
        rho_information=known * frame.rho_information * rng.uniform(0.2, 3.0, 25),
    )
    seen_twice = np.isfinite(frame.observed).sum(axis=1) >= 2
    frame = replace(
        frame,
        **{
            name: getattr(frame, name)[seen_twice]
            for name in ("hosts", "bearings", "rhos", "rho_information", "observed", "weights")
        },
    )
    T = near(rng, frame.T_true, 0.02)
    cost, A, g = linearised(frame, T, 1.5)
    dense_cost, H, b = dense_equations(frame, T, 1.5)
    A_dense, g_dense = eliminated(H, b, 6)
    assert cost == pytest.approx(dense_cost, rel=1e-9)
    scale = np.sqrt(np.diag(A_dense))
    outer = np.outer(scale, scale)
    np.testing.assert_allclose(A / outer, A_dense / outer, atol=1e-5)
    np.testing.assert_allclose(g / scale, g_dense / scale, atol=1e-4 * np.abs(b[:6] / scale).max())
    assert np.abs(g_dense - b[:6]).max() > 0.01 * np.abs(b[:6]).max()  # elimination did matter


def test_depths_known_for_certain_leave_the_slope_of_the_cost(rng):
    frame = make_frame(rng, 30, turn=TURN, holes=0.2)
    frame = replace(frame, rho_information=np.full(30, 1e30), weights=rng.uniform(0.3, 2.0, 30))
    T = near(rng, frame.T_true, 0.02)
    _, _, g = linearised(frame, T, 1.5)

    def cost(x):
        return np.array(linearised(frame, exp_se3(x) @ T, 1.5)[0])

    np.testing.assert_allclose(g, -numeric_jacobian(cost, np.zeros(6)), rtol=1e-5, atol=0.05)


# --------------------------------------------------------------------------------------- refinement


@turns
def test_without_noise_the_pose_is_exact(rng, turn):
    frame = make_frame(rng, sigma_px=0.0, depth_sigma_px=0.0, turn=NO_TURN)
    observed = frame.observed.copy()
    if turn.any():  # as the right eye's own model sees it: no second order
        observed -= replace(frame, turn=turn).reference(frame.T_true)
        observed[:, 3] = np.nan
    frame = replace(frame, observed=observed, turn=turn)
    pose = frame.refined(near(rng, frame.T_true))
    assert np.abs(difference(pose, frame.T_true)).max() < 1e-7
    assert pose.sigma_px == 0.05  # the floor
    assert np.nanmax(np.abs(pose.residuals)) < 1e-4


def many(make, runs, seed=0):
    """Squared Mahalanobis distances and noise estimates over many seeds."""
    squares, sigmas = [], []
    for k in range(runs):
        rng = np.random.default_rng(seed + k)
        frame = make(rng)
        pose = frame.refined(near(rng, frame.T_true))
        squares.append(squared_sigmas(pose, frame.T_true))
        sigmas.append(pose.sigma_px)
    return np.array(squares), np.array(sigmas)


def test_the_covariance_is_that_of_the_errors(rng):
    """Depths that many keyframes have seen: the residuals show the noise of this frame alone."""
    squares, sigmas = many(lambda rng: make_frame(rng, 80, depth_sigma_px=0.03), 100)
    low, high = mean_nees_band(6, 100)
    # Cauchy weights forgo a little of what Gaussian noise could tell, and sigma is an estimate.
    assert 0.8 * low < squares.mean() < 1.25 * high
    assert 0.29 < np.median(sigmas) < 0.32


def test_fresh_depths_are_claimed_with_caution(rng):
    """Depths as bad as one disparity enter the residuals: more is claimed than the pose is off."""
    squares, sigmas = many(lambda rng: make_frame(rng, 80, depth_sigma_px=0.3), 60)
    assert 0.8 < squares.mean() < 6.0
    assert 0.32 < np.median(sigmas) < 0.9


def test_one_eye_will_do(rng):
    """Keyframes know the depths, so that a single eye gives a metric pose, if a less sure one."""
    both = make_frame(rng, 80)
    sure = both.refined(both.T_true)
    for eye in (slice(0, 2), slice(2, 4)):
        observed = np.full_like(both.observed, np.nan)
        observed[:, eye] = both.observed[:, eye]
        pose = replace(both, observed=observed).refined(near(rng, both.T_true))
        assert 0.05 < squared_sigmas(pose, both.T_true) < 22.5  # of 6 dimensions, 99.9 %
        sizes = np.trace(pose.covariance[:3, :3]) / np.trace(sure.covariance[:3, :3])
        assert 1.05 < sizes < 10.0


def test_wrong_points_hardly_move_the_pose(rng):
    clean = make_frame(rng, 100)
    wrong = clean.observed.copy()
    wrong[::5] += rng.normal(0, 40.0, (20, 4))
    pose = replace(clean, observed=wrong).refined(clean.T_true)
    assert squared_sigmas(pose, clean.T_true) < 22.5
    assert 0.25 < pose.sigma_px < 0.6
    off = np.nanmax(np.abs(pose.residuals), axis=1)
    assert (off[::5] > 4.0 * pose.sigma_px).sum() >= 18
    assert np.mean(np.delete(off, np.s_[::5]) < 4.0 * pose.sigma_px) > 0.95


def test_points_without_weight_say_nothing(rng):
    frame = make_frame(rng, 60)
    wrong = frame.observed.copy()
    wrong[40:] += 1.0
    weights = np.where(np.arange(60) < 40, 1.0, 0.0)
    some = replace(frame, observed=wrong, weights=weights).refined(frame.T_true)
    # The width of the kernel comes from all of them, so that only nearly the same pose comes out.
    assert squared_sigmas(some, frame.T_true) < 22.5
    unweighted = replace(frame, observed=wrong).refined(frame.T_true)
    assert np.linalg.norm(difference(unweighted, frame.T_true)) > np.linalg.norm(
        difference(some, frame.T_true)
    )


def test_the_pose_is_near_the_minimum_over_pose_and_depths(rng):
    """By scipy, all depths unknown; within half a (true) sigma of each other."""
    for _ in range(3):
        frame = make_frame(rng, 40, depth_sigma_px=0.3)
        pose = frame.refined(near(rng, frame.T_true))
        width = 2.385 * pose.sigma_px

        def costs(x, frame=frame, width=width):
            r = frame.reference(exp_se3(x[:6]) @ frame.T_true, x[6:] / GAIN)[:, :3].ravel()
            robust = np.sign(r) * width * np.sqrt(np.log1p((r / width) ** 2))
            held = np.sqrt(frame.rho_information) * (x[6:] / GAIN - frame.rhos)
            return np.concatenate([robust, held])

        found = least_squares(costs, np.concatenate([np.zeros(6), GAIN * frame.rhos]))
        best = exp_se3(found.x[:6]) @ frame.T_true
        assert squared_sigmas(pose, best) < 0.3


def on_a_line(frame):
    """All points on one ray."""
    bearings, observed = np.tile(frame.bearings[:1], (len(frame.hosts), 1)), frame.observed.copy()
    observed[:] = observed[0]
    rhos = np.full(len(frame.hosts), frame.rhos[0])
    return replace(frame, bearings=bearings, rhos=rhos, observed=observed, hosts=0 * frame.hosts)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda frame: replace(frame, observed=np.full_like(frame.observed, np.nan)),
        lambda frame: replace(frame, weights=np.zeros_like(frame.weights)),
        on_a_line,
    ],
    ids=("nothing seen", "no weight", "one place"),
)
def test_no_pose_without_enough_to_tell_it(rng, spoil):
    frame = make_frame(rng, 30)
    assert frame.refined(frame.T_true) is not None
    assert spoil(frame).refined(frame.T_true) is None


def test_robust_sigma_does_not_mind_outliers_nor_holes(rng):
    residuals = rng.normal(0, 0.4, (500, 4))
    residuals[::10] = 80.0
    residuals[1::10, 0] = np.nan
    assert robust_sigma(residuals) == pytest.approx(0.4, rel=0.2)
    assert robust_sigma(np.full((3, 4), np.nan)) == 0.0
    assert robust_sigma(np.array([np.nan, -2.0])) == pytest.approx(2.0 * 1.4826)


# ------------------------------------------------------------------------------------------ samples


def test_samples_begin_with_the_best_and_end_with_all():
    samples = prosac_samples(np.random.default_rng(0), 200, 300)
    assert samples.shape == (300, 3)
    assert samples.min() == 0
    assert 30 <= samples[:30].max() < 80
    assert 190 <= samples[160:].max() < 200
    np.testing.assert_array_equal(samples, prosac_samples(np.random.default_rng(0), 200, 300))
    few = prosac_samples(np.random.default_rng(0), 3, 50)
    assert set(few.ravel()) == {0, 1, 2}


@pytest.mark.parametrize("inliers", [20, 50, 80, 95])
def test_as_many_samples_as_find_inliers_alone_with_the_confidence(rng, inliers):
    needed = samples_needed(inliers, 100, 0.9, 10**6)
    clean = np.all(rng.random((4000, needed, 3)) < inliers / 100, axis=2)
    assert np.mean(np.any(clean, axis=1)) > 0.88
    fewer = np.mean(np.any(clean[:, 1:], axis=1)) if needed > 1 else 0.0
    assert fewer < 0.92


def test_no_more_samples_than_there_are_and_none_where_all_fit():
    assert samples_needed(100, 100, 0.999, 50) == 0
    assert samples_needed(0, 100, 0.999, 50) == 50
    assert samples_needed(20, 100, 0.999, 50) == 50


def test_a_good_start_needs_few_samples(rng):
    """The best sample of all stands behind the few that are still tried."""
    frame = make_frame(rng, 60, sigma_px=0.1, depth_sigma_px=0.02)
    observed = frame.observed.copy()
    observed[:15] += 30.0
    samples = np.zeros((40, 3), np.int64)
    samples[-1] = [20, 35, 50]
    start = near(rng, frame.T_true, 1e-4)
    count, T = ransac_frame_pose(start, *frame.geometry, observed, eyes_of(), samples, 1.0, 0.999)
    assert 40 <= count <= 45
    np.testing.assert_array_equal(T, start)
    lost = frame.T_true @ exp_se3([0.5, 0.0, 0.0, 0.0, 0.1, 0.0])
    count, T = ransac_frame_pose(lost, *frame.geometry, observed, eyes_of(), samples, 1.0, 0.999)
    assert 40 <= count <= 45
    assert np.abs(log_se3(T @ inverse(frame.T_true))).max() < 0.05


EYES = {"both": slice(0, 4), "left": slice(0, 2), "right": slice(2, 4)}


@pytest.mark.parametrize("eye", EYES.values(), ids=EYES)
def test_samples_find_the_pose_among_as_many_wrong_points(rng, eye):
    frame = make_frame(rng, 80, sigma_px=0.1, depth_sigma_px=0.02)
    observed = np.full_like(frame.observed, np.nan)
    observed[:, eye] = frame.observed[:, eye]
    observed[::2] += rng.uniform(5.0, 60.0, (40, 4)) * rng.choice([-1, 1], (40, 4))
    samples = prosac_samples(rng, 80, 200)
    count, T = ransac_frame_pose(
        near(rng, frame.T_true, 0.1), *frame.geometry, observed, eyes_of(), samples, 1.0, 0.999
    )
    assert 38 <= count <= 42
    assert 1e-6 < np.abs(log_se3(T @ inverse(frame.T_true))).max() < 0.05
    chosen = np.empty(80, np.bool_)
    assert mark_inliers(T, *frame.geometry, observed, eyes_of(), 1.0, chosen) == count
    assert chosen.sum() == count
    assert chosen[1::2].sum() >= 38


def test_a_good_start_is_not_given_away(rng):
    """Samples of nonsense only: the start, which fits, stays."""
    frame = make_frame(rng, 40, sigma_px=0.1, depth_sigma_px=0.02)
    same_thrice = np.zeros((10, 3), np.int64)
    count, T = ransac_frame_pose(
        frame.T_true, *frame.geometry, frame.observed, eyes_of(), same_thrice, 1.0, 0.999
    )
    assert count == 40
    np.testing.assert_array_equal(T, frame.T_true)


def test_inliers_are_those_whose_every_component_fits(rng):
    frame = make_frame(rng, 40, sigma_px=0.4, holes=0.3)
    T = frame.T_true
    chosen = np.empty(40, np.bool_)
    count = mark_inliers(T, *frame.geometry, frame.observed, eyes_of(), 0.7, chosen)
    residuals = frame.reference(T)
    seen = np.isfinite(residuals).sum(axis=1) >= 2
    fits = ~np.any(np.abs(residuals) >= 0.7, axis=1)
    np.testing.assert_array_equal(chosen, seen & fits)
    assert 5 < count == chosen.sum() < 35
    behind = T @ exp_se3([0, 0, 100.0, 0, 0, 0])
    assert (
        mark_inliers(inverse(behind), *frame.geometry, frame.observed, eyes_of(), 1e9, chosen) < 40
    )
