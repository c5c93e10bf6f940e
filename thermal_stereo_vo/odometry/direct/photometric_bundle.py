"""Joint refinement of a few keyframes, their brightness and the inverse depths of their points.

Photometric bundle adjustment after Engel et al. (DSO, TPAMI 2018) and Wang et al. (Stereo DSO,
ICCV 2017).  Unknowns of a keyframe: left perturbation of its pose, then a and b of each camera;
of all together: the logarithm of scale and the lag of bolometers.  Each point has one unknown, so
eliminating it (Schur complement) is a division.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.kernels import solve_positive
from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.clustered_covariance import clustered_covariance
from thermal_stereo_vo.odometry.direct.map_size import size_of, slopes_of_size
from thermal_stereo_vo.odometry.direct.photometric import PIXELS
from thermal_stereo_vo.odometry.direct.rig import with_arms
from thermal_stereo_vo.odometry.direct.shared_guesses import SharedGuesses, SharedStep
from thermal_stereo_vo.odometry.direct.window_equations import POSE, linearise_window
from thermal_stereo_vo.odometry.direct.window_prior import WindowPrior
from thermal_stereo_vo.odometry.information import inverse_information

RHO_MIN = 1e-5
HOLD = 1e8
"""Information, for a noise of one unit of brightness, that leaves nothing free."""
_BRIGHTNESS_DAMPING = 1.0
"""Holds brightness that nothing shows, as that of a camera that was blind."""
_LAG_DAMPING = 1e4
"""Holds the lag where no camera tells it, in 1/s^2: to 50 ms for a noise of 5."""
_MOST_SCALE_STEP = 0.2
_LEAST_NOISE = 0.1
"""In units of brightness; less is never believed."""


@dataclass(frozen=True)
class PhotometricProblem:
    """Keyframes, their images and their points.

    ``images`` one (slots, H, W, 3) float32 stack per camera and ``slots`` (K,) where the keyframes
    stand in it, oldest first; ``T_k_w`` (K, 4, 4); ``twists`` (K, 6) how the rig moved per second,
    for cameras that looked ``lags_s`` (C,) earlier; ``brightness`` (K, C, 2); ``cameras`` (C, 4) fx
    fy cx cy; ``T_rig_camera`` (C, 4, 4); points sorted by host: ``hosts`` (N,) index of keyframe,
    ``host_cameras`` (N,), ``bearings`` (N, 3), ``rhos`` (N,) 1/m, ``rho_priors`` and their
    ``prior_information`` (N,), ``patches`` and ``trusts`` (N, 8); ``seen`` (N, K, C) bool, which
    residuals there are.  With ``bands`` the other camera compares its own two views of a point, for
    its patches again with ``trust_gradient``.  ``bolometers`` (C,) bool: those are late, and
    patches of theirs may be so steep that residuals count as they weigh, not by their size.
    ``looseness`` (C,) is that of ``gather_patch``; between two views of the other camera there is
    none.  With ``guesses_err_together`` the ``rho_priors`` of one camera of one keyframe share an
    error.  ``prior`` is what keyframes that left still say.
    """

    images: tuple[NDArray[np.float32], ...]
    slots: NDArray[np.int64]
    T_k_w: NDArray[np.float64]
    twists: NDArray[np.float64]
    lags_s: NDArray[np.float64]
    brightness: NDArray[np.float64]
    cameras: NDArray[np.float64]
    T_rig_camera: NDArray[np.float64]
    hosts: NDArray[np.int64]
    host_cameras: NDArray[np.int64]
    bearings: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_priors: NDArray[np.float64]
    prior_information: NDArray[np.float64]
    patches: NDArray[np.float64]
    trusts: NDArray[np.float64]
    seen: NDArray[np.bool_]
    bands: bool
    bolometers: NDArray[np.bool_]
    trust_gradient: float
    looseness: NDArray[np.float64]
    guesses_err_together: bool
    prior: WindowPrior | None = None

    def take(self, chosen: NDArray[np.bool_]) -> PhotometricProblem:
        """The same keyframes with the ``chosen`` (N,) points, without the prior."""
        return replace(
            self,
            hosts=self.hosts[chosen],
            host_cameras=self.host_cameras[chosen],
            bearings=self.bearings[chosen],
            rhos=self.rhos[chosen],
            rho_priors=self.rho_priors[chosen],
            prior_information=self.prior_information[chosen],
            patches=self.patches[chosen],
            trusts=self.trusts[chosen],
            seen=self.seen[chosen],
            prior=None,
        )

    @cached_property
    def guesses(self) -> SharedGuesses | None:
        """The first depths with what those of one camera of one keyframe share; None if nothing."""
        if not self.guesses_err_together:
            return None
        cameras = self.seen.shape[2]
        group = self.hosts * cameras + self.host_cameras
        groups = self.seen.shape[1] * cameras
        return SharedGuesses.of(group, groups, self.rho_priors, self.prior_information)

    @property
    def lag_s(self) -> float:
        """How late the bolometers are; 0 where there is none."""
        late = self.lags_s[self.bolometers]
        return float(late[0]) if len(late) else 0.0


@dataclass(frozen=True)
class PhotometricSolution:
    """Keyframes, brightness and depths at the minimum.

    ``energies`` (N, K, C) mean squared residual of each patch, NaN where it is not seen;
    ``rho_information`` (N,) and ``covariance`` (6 (K-1), 6 (K-1)) of the left perturbations of all
    keyframes but the oldest are for the noise ``sigma`` that was found.  ``log_scale`` is the
    logarithm of how many of the map's units are one of the lever arms' after, where it was free;
    ``lag_s`` how much later the bolometers were found to be, with its ``lag_sigma_s``.
    """

    T_k_w: NDArray[np.float64]
    brightness: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_information: NDArray[np.float64]
    covariance: NDArray[np.float64]
    energies: NDArray[np.float64]
    sigma: float
    iterations: int
    log_scale: float
    log_scale_sigma: float
    lag_s: float
    lag_sigma_s: float


@dataclass
class _Equations:
    """Normal equations at one state, reduced to the keyframes."""

    A: NDArray[np.float64]
    g: NDArray[np.float64]
    W: NDArray[np.float64]
    h_rho: NDArray[np.float64]
    b_rho: NDArray[np.float64]
    energies: NDArray[np.float64]
    cost: float = 0.0
    steepness: float = 1.0
    shared: SharedStep | None = None

    @classmethod
    def of(cls, problem: PhotometricProblem) -> _Equations:
        n, k, c = problem.seen.shape
        size = k * (POSE + 2 * c) + 2
        return cls(
            np.zeros((size, size)), np.zeros(size), np.zeros((n, size)), np.zeros(n), np.zeros(n),
            np.full((n, k, c), np.nan),
        )  # fmt: skip


def adjust_photometrically(
    problem: PhotometricProblem,
    *,
    huber: float,
    gate: float,
    iterations: int,
    free_scale: bool = False,
    free_lag: bool = False,
    hold: float = 0.0,
) -> PhotometricSolution | None:
    """Minimise the photometric error, the oldest pose and its brightness held.

    With ``free_scale`` the lever arms of the cameras grow or shrink against the map, with
    ``free_lag`` bolometers are more or less late.  ``hold`` is the information on the size of the
    map (its logarithm), which keeps it where lever arms tell nothing or little of it.  None when
    the equations have no solution.
    """
    K, C = problem.seen.shape[1:]
    size = POSE + 2 * C
    kind = np.append(np.tile(np.arange(size), K), [-1, -1])
    is_brightness = kind >= POSE
    free = np.ones(len(kind), np.bool_)
    free[: size if problem.bands else POSE + 2] = False
    free[-2], free[-1] = free_scale, free_lag
    T, brightness, rhos = problem.T_k_w.copy(), problem.brightness.copy(), problem.rhos.copy()
    log_scale, lag_s = 0.0, 0.0
    now, then = _Equations.of(problem), _Equations.of(problem)
    start_size = size_of(T)
    _linearise(problem, T, brightness, rhos, log_scale, lag_s, huber, gate, now)
    if hold > 0.0:
        _hold_size(now, T, start_size, hold)
    damping, done = 1e-5, 0
    while done < iterations:
        done += 1
        damped = now.A.copy()
        damped[np.diag_indices_from(damped)] += damping * np.diag(now.A) + 1e-6
        damped[is_brightness, is_brightness] += _BRIGHTNESS_DAMPING
        damped[-1, -1] += _LAG_DAMPING
        moves = np.zeros(np.count_nonzero(free))
        if not solve_positive(damped[np.ix_(free, free)], now.g[free], moves):
            return None
        step = np.zeros(len(free))
        step[free] = moves
        T_new, brightness_new, rhos_new = _moved(T, brightness, rhos, now, step)
        log_scale_new = log_scale + float(np.clip(step[-2], -_MOST_SCALE_STEP, _MOST_SCALE_STEP))
        lag_new = lag_s + float(step[-1])
        _linearise(
            problem, T_new, brightness_new, rhos_new, log_scale_new, lag_new, huber, gate, then
        )
        if hold > 0.0:
            _hold_size(then, T_new, start_size, hold)
        if then.cost < now.cost:
            small = now.cost - then.cost < 1e-4 * abs(now.cost)
            T, brightness, rhos = T_new, brightness_new, rhos_new
            log_scale, lag_s = log_scale_new, lag_new
            now, then = then, now
            damping = max(0.2 * damping, 1e-8)
            if small:
                break
        else:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e3:
                break
    A = now.A
    A[is_brightness, is_brightness] += _BRIGHTNESS_DAMPING
    A[-1, -1] += _LAG_DAMPING
    unit_covariance = inverse_information(A[np.ix_(free, free)])
    if unit_covariance is None:
        return None
    is_pose = ((kind >= 0) & (kind < POSE))[free]
    sigma = noise_of(now.energies, gate)
    covariance = sigma**2 * unit_covariance
    if not problem.bands:
        pulls = np.zeros_like(now.W)
        _linearise(problem, T, brightness, rhos, log_scale, lag_s, huber, gate, then, pulls=pulls)
        scattered = clustered_covariance(
            A[np.ix_(free, free)],
            unit_covariance,
            np.ascontiguousarray(pulls[:, free]),
            then.steepness,
            _LEAST_NOISE,
            None if problem.prior is None else problem.prior.scatter[np.ix_(free, free)],
        )
        covariance = covariance if scattered is None else scattered
    at = -1 - int(free_lag)
    scale_sigma = float(np.sqrt(covariance[at, at])) if free_scale else 0.0
    lag_sigma_s = float(np.sqrt(covariance[-1, -1])) if free_lag else 0.0
    if problem.bands and not free_scale:
        log_scale, scale_sigma = _pull_of_scale(now, T, free, sigma)
    return PhotometricSolution(
        T, brightness, rhos, now.h_rho, covariance[np.ix_(is_pose, is_pose)], now.energies, sigma,
        done, log_scale, scale_sigma, lag_s, lag_sigma_s,
    )  # fmt: skip


def _hold_size(equations: _Equations, T_k_w: NDArray[np.float64], size: float, hold: float) -> None:
    """Hold the size of the map where the lever arms are free: one of both must give the unit."""
    off = np.log((size_of(T_k_w) + 1e-6) / (size + 1e-6))
    slope = _slope_of_size(T_k_w, len(equations.g))
    equations.A += hold * np.outer(slope, slope)
    equations.g -= hold * off * slope
    equations.cost += hold * off * off


def _slope_of_size(T_k_w: NDArray[np.float64], unknowns: int) -> NDArray[np.float64]:
    """(U,) derivative of the logarithm of the size by all unknowns."""
    slope = np.zeros(unknowns)
    slope[:-2].reshape(len(T_k_w), -1)[:, :3] = slopes_of_size(T_k_w)
    return slope


def _pull_of_scale(
    equations: _Equations, T_k_w: NDArray[np.float64], free: NDArray[np.bool_], sigma: float
) -> tuple[float, float]:
    """Where the logarithm of scale would go next if it were free, and its standard deviation."""
    slope = _slope_of_size(T_k_w, len(equations.g))
    A = equations.A + HOLD * np.outer(slope, slope)
    free = free.copy()
    free[-2] = True
    unit_covariance = inverse_information(A[np.ix_(free, free)])
    if unit_covariance is None:
        return 0.0, np.inf
    at = int(np.count_nonzero(free[:-2]))
    step = float(unit_covariance[at] @ equations.g[free])
    return step, sigma * float(np.sqrt(unit_covariance[at, at]))


def noise_of(energies: NDArray[np.float64], gate: float) -> float:
    """Root of the mean energy of the patches that are believed; that of the gate when none is."""
    good = energies[energies < gate * gate]
    return float(np.sqrt(np.mean(good))) if len(good) else gate


def _moved(
    T: NDArray[np.float64],
    brightness: NDArray[np.float64],
    rhos: NDArray[np.float64],
    equations: _Equations,
    step: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    per_frame = step[:-2].reshape(len(T), -1)
    T_new = np.stack([exp_se3(d[:POSE]) @ T_k for d, T_k in zip(per_frame, T, strict=True)])
    brightness_new = brightness + per_frame[:, POSE:].reshape(brightness.shape)
    shown = equations.h_rho > 0.0
    delta = np.zeros(len(rhos))
    right = equations.b_rho - equations.W @ step
    if equations.shared is not None:
        right += equations.shared.pulls_on_depths(step)
    delta[shown] = right[shown] / equations.h_rho[shown]
    return T_new, brightness_new, np.maximum(rhos + delta, RHO_MIN)


def _linearise(
    problem: PhotometricProblem,
    T: NDArray[np.float64],
    brightness: NDArray[np.float64],
    rhos: NDArray[np.float64],
    log_scale: float,
    lag_s: float,
    huber: float,
    gate: float,
    out: _Equations,
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    pulls: NDArray[np.float64] | None = None,
) -> None:
    T_rig_camera = with_arms(problem.T_rig_camera, np.exp(-log_scale))
    late = problem.bolometers.astype(np.float64)
    T_then_now = moved_by(problem.twists, problem.lags_s + lag_s * late)
    if slopes is None:
        prior = problem.prior
        slopes = (T, brightness) if prior is None else prior.slopes_at(T, brightness)
    T_slopes, brightness_slopes = slopes
    guesses, rho_priors = problem.guesses, problem.rho_priors
    if guesses is not None:
        errors = guesses.errors(rhos)
        rho_priors = guesses.means(errors)
    if pulls is None:
        pulls = np.zeros((0, len(out.g)))
    out.cost, out.steepness = linearise_window(
        problem.images, problem.slots, T, problem.twists, late, T_then_now, brightness, T_slopes,
        brightness_slopes, problem.cameras, T_rig_camera, problem.hosts, problem.host_cameras,
        problem.bearings, rhos, rho_priors, problem.prior_information, problem.patches,
        problem.trusts, problem.seen, problem.bands, problem.bolometers, problem.trust_gradient,
        problem.looseness, huber, gate, out.A, out.g, out.W, out.h_rho, out.b_rho, out.energies,
        pulls,
    )  # fmt: skip
    if guesses is not None:
        out.shared = guesses.eliminate(out.W, out.h_rho, out.b_rho, out.A, out.g, pulls)
        out.cost += guesses.cost(errors)
    if problem.prior is not None:
        prior = problem.prior
        off = prior.offsets(T, brightness, problem.lag_s + lag_s)
        pulled = prior.H @ off
        out.A += prior.H
        out.g += prior.b - pulled
        out.cost += float(off @ pulled - 2.0 * prior.b @ off)


def left_behind(
    problem: PhotometricProblem, left: int, *, huber: float, gate: float, weight: float
) -> WindowPrior:
    """What stays known of the other keyframes when keyframe ``left`` (index) goes with its points.

    Residuals of points that stay are lost with the image.  ``weight`` is what linearised residuals
    count, which will never be linearised again.
    """
    T, brightness = problem.T_k_w, problem.brightness
    prior = problem.prior or WindowPrior.nothing(T, brightness, problem.lag_s)
    own = problem.take(problem.hosts == left)
    equations = _Equations.of(own)
    # Where keyframes have first estimates, those say how pixels move.
    slopes = prior.slopes_at(T, brightness)
    pulls = np.zeros_like(equations.W)
    _linearise(own, T, brightness, own.rhos, 0.0, 0.0, huber, gate, equations, slopes, pulls)
    pulls *= weight
    grown = prior.grown(
        weight * equations.A, weight * equations.g, T, brightness, problem.lag_s, pulls
    )
    return grown.without(left)


def moved_by(twists: NDArray[np.float64], lags_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, C, 4, 4) rigs when each camera looked from rigs now, by their twists (K, 6)."""
    out = np.tile(np.eye(4), (len(twists), len(lags_s), 1, 1))
    for camera in np.flatnonzero(lags_s):
        for k, twist in enumerate(twists):
            out[k, camera] = exp_se3(lags_s[camera] * twist)
    return out


def residuals_of_window(
    problem: PhotometricProblem, log_scale: float = 0.0, lag_s: float = 0.0
) -> NDArray[Any]:
    """(N, K, C, 8) residuals, NaN where there are none: the plain form for tests."""
    from thermal_stereo_vo.odometry.direct.photometric import residuals_reference

    out = np.full((*problem.seen.shape, PIXELS), np.nan)
    T_rig_camera = with_arms(problem.T_rig_camera, np.exp(-log_scale))
    T_then_now = moved_by(problem.twists, problem.lags_s + lag_s * problem.bolometers)
    T_camera_now = np.stack([inverse(T) for T in T_rig_camera]) @ T_then_now
    for n, t, c in zip(*np.nonzero(problem.seen), strict=True):
        h, hc = problem.hosts[n], problem.host_cameras[n]
        across = problem.bands and c != hc
        owner = c if across else hc
        rays = (problem.bearings[n], float(problem.rhos[n]), 1.0 / problem.cameras[hc, :2])
        patch = problem.patches[n]
        if across:
            patch = residuals_reference(
                problem.images[c][problem.slots[h]], problem.cameras[c], 1.0,
                T_camera_now[h, c] @ inverse(T_camera_now[h, hc]), *rays, np.zeros(PIXELS),
                (0.0, 0.0), (0.0, 0.0),
            )  # fmt: skip
        T_rig_host = problem.T_k_w[t] @ inverse(problem.T_k_w[h]) @ inverse(T_camera_now[h, hc])
        out[n, t, c] = residuals_reference(
            problem.images[c][problem.slots[t]], problem.cameras[c], 1.0,
            T_camera_now[t, c] @ T_rig_host, *rays, patch, tuple(problem.brightness[h, owner]),
            tuple(problem.brightness[t, c]),
        )  # fmt: skip
    return out
