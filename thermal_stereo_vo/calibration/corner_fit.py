"""Sub-pixel corners by fitting the image of an ideal corner seen through a blurring lens.

A corner where two straight edges cross looks, blurred by a Gaussian of width sigma, like

    I(p) = a + g.p + A (s + erf(n1.(p - c) / (sqrt(2) sigma))) (s + erf(n2.(p - c) / ...))

with s = 0 where four fields of a chessboard meet and s = 1 at the corner of a bright or dark
square.  The plane a + g.p takes a warm background or a hot spot.  All pixels of both edges work for
the corner c, which makes the fit far less noisy than a gradient or saddle-point method in weak
contrast, and a convex corner is not pulled inwards by the blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

_MAX_RADIUS_PX = 14
_ITERATIONS = 15
_SETTLED_PX = 1e-3
_MAX_IMBALANCE = 0.6
_PARAMETERS = 9  # c (2), angle of n1, angle of n2, log sigma, A, a, g (2)


@dataclass(frozen=True)
class CornerFit:
    """Fitted corners; every array has one row a corner.

    ``pixels`` (N, 2); ``sigma_px`` (N,) standard deviation of the position from the residuals;
    ``amplitude`` (N,) signed A in counts; ``blur_px`` (N,); ``noise`` (N,) rms residual in counts;
    ``good`` (N,) False where the fit ran away, left the image or explains the pixels badly, or
    where four fields of a chessboard should meet and do not.
    """

    pixels: Array
    sigma_px: Array
    amplitude: Array
    blur_px: Array
    noise: Array
    good: NDArray[np.bool_]


@dataclass(frozen=True)
class _Windows:
    """``counts`` and ``weight`` (0 or 1) (N, P), pixel offsets ``at`` (N, P, 2) from ``origin``."""

    counts: Array
    weight: Array
    at: Array
    origin: NDArray[np.int_]


def fit_corners(
    image: NDArray[Any],
    pixels: Array,
    edges_px: Array,
    *,
    convex: bool,
    reach: float = 0.42,
) -> CornerFit:
    """Refine corners in an (H, W) image of any depth.

    ``pixels`` (N, 2) are the first guesses, good to about a quarter of the shorter edge.
    ``edges_px`` (N, 2, 2) are the two edge vectors at each corner to the next corner; for a
    ``convex`` corner of a square they run along the sides of that square.  Pixels within ``reach``
    of an edge vector (and 14 px) take part.
    """
    count = len(pixels)
    if count == 0:
        empty = np.zeros(0)
        return CornerFit(np.zeros((0, 2)), empty, empty, empty, empty, np.zeros(0, bool))
    guess = np.asarray(pixels, dtype=np.float64)
    lengths = np.linalg.norm(edges_px, axis=2)
    cross = edges_px[:, 0, 0] * edges_px[:, 1, 1] - edges_px[:, 0, 1] * edges_px[:, 1, 0]
    sane = np.abs(cross) > 0.1 * lengths[:, 0] * lengths[:, 1]
    edges_px = np.where(sane[:, None, None], edges_px, 20.0 * np.eye(2))

    windows = _windows(image, guess, edges_px, reach)
    sane &= windows.weight.sum(1) >= 3 * _PARAMETERS
    offset = 1.0 if convex else 0.0
    parameters = _initial(windows, guess - windows.origin, edges_px, offset)
    parameters, cost, covariance = _levenberg(windows, parameters, offset)

    noise = np.sqrt(cost / np.maximum(windows.weight.sum(1) - _PARAMETERS, 1.0))
    variance = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]) * noise**2
    fitted = windows.origin + parameters[:, :2]
    blur_px = np.exp(parameters[:, 4])
    explained = 1.0 - cost / np.maximum(_spread(windows), 1e-12)
    shortest = lengths.min(1)
    if not convex:
        sane &= _imbalance(windows, parameters) < _MAX_IMBALANCE
    return CornerFit(
        pixels=fitted,
        sigma_px=np.sqrt(np.where(np.isfinite(variance), variance, np.inf)),
        amplitude=parameters[:, 5],
        blur_px=blur_px,
        noise=np.maximum(noise, 1e-9),
        good=sane
        & np.isfinite(variance)
        & (np.linalg.norm(fitted - guess, axis=1) < 0.3 * shortest)
        & (blur_px < 0.45 * shortest)
        & (explained > 0.5),
    )


def _windows(image: NDArray[Any], guess: Array, edges_px: Array, reach: float) -> _Windows:
    """The pixels near each guess whose lattice coordinates stay within ``reach``."""
    height, width = image.shape
    origin = np.rint(guess).astype(int)
    extent = reach * np.abs(edges_px).sum(1).max()
    radius = int(np.clip(np.ceil(extent) + 1, 4, _MAX_RADIUS_PX))
    dy, dx = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    at = np.stack([dx.ravel(), dy.ravel()], axis=1)
    x, y = origin[:, :1] + at[:, 0], origin[:, 1:] + at[:, 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    # Lattice coordinates u, v of a pixel: p - guess = u edge0 + v edge1.
    px, py = np.moveaxis(at[None] - (guess - origin)[:, None], 2, 0)
    (ax, ay), (bx, by) = edges_px[:, 0].T[:, :, None], edges_px[:, 1].T[:, :, None]
    determinant = ax * by - ay * bx
    u, v = (px * by - py * bx) / determinant, (ax * py - ay * px) / determinant
    used = inside & (np.abs(u) < reach) & (np.abs(v) < reach)
    # Keep the used pixels only, padded to the largest window.
    keep = np.argsort(~used, axis=1, kind="stable")[:, : max(int(used.sum(1).max()), 1)]
    rows = np.arange(len(guess))[:, None]
    x, y = np.clip(x[rows, keep], 0, width - 1), np.clip(y[rows, keep], 0, height - 1)
    return _Windows(
        image[y, x].astype(np.float64),
        used[rows, keep].astype(np.float64),
        at[keep].astype(np.float64),
        origin,
    )


def _initial(windows: _Windows, centre: Array, edges_px: Array, offset: float) -> Array:
    """Edges along the lattice, sigma 1 px, and the linear parameters by least squares."""
    parameters = np.zeros((len(centre), _PARAMETERS))
    parameters[:, :2] = centre
    first, second = edges_px[:, 0], edges_px[:, 1]
    # n1 is normal to the second edge and points along the first, n2 the other way round.
    for column, edge, towards in ((2, second, first), (3, first, second)):
        normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
        normal *= np.sign(np.sum(normal * towards, axis=1, keepdims=True))
        parameters[:, column] = np.arctan2(normal[:, 1], normal[:, 0])
    (d1, d2), _ = _distances(windows, parameters)
    scale = np.sqrt(0.5)
    product = (offset + erf(d1 * scale)) * (offset + erf(d2 * scale))
    parameters[:, 5:] = _regress(windows, [product, *_plane(windows)])
    return parameters


def _distances(windows: _Windows, parameters: Array) -> tuple[list[Array], list[Array]]:
    """Signed distances (N, P) to both edges, and positions along them."""
    dx, dy = np.moveaxis(windows.at - parameters[:, None, :2], 2, 0)
    across, along = [], []
    for k in (2, 3):
        c, s = np.cos(parameters[:, k, None]), np.sin(parameters[:, k, None])
        across.append(dx * c + dy * s)
        along.append(dy * c - dx * s)
    return across, along


def _residuals(windows: _Windows, parameters: Array, offset: float) -> tuple[Array, Array]:
    """(N, P) image minus model, and the model's Jacobian (N, P, 9)."""
    (d1, d2), (t1, t2) = _distances(windows, parameters)
    inverse = np.exp(-parameters[:, 4, None]) * np.sqrt(0.5)
    z1, z2 = d1 * inverse, d2 * inverse
    e1, e2 = offset + erf(z1), offset + erf(z2)
    amplitude = parameters[:, 5, None]
    slope = amplitude * inverse * (2.0 / np.sqrt(np.pi))
    s1, s2 = slope * np.exp(-z1 * z1) * e2, slope * np.exp(-z2 * z2) * e1
    jacobian = np.empty((*d1.shape, _PARAMETERS))
    jacobian[:, :, 0] = -(s1 * np.cos(parameters[:, 2, None]) + s2 * np.cos(parameters[:, 3, None]))
    jacobian[:, :, 1] = -(s1 * np.sin(parameters[:, 2, None]) + s2 * np.sin(parameters[:, 3, None]))
    jacobian[:, :, 2] = s1 * t1
    jacobian[:, :, 3] = s2 * t2
    jacobian[:, :, 4] = -(s1 * d1 + s2 * d2)
    product = e1 * e2
    jacobian[:, :, 5] = product
    jacobian[:, :, 6] = 1.0
    jacobian[:, :, 7:] = windows.at
    plane = (
        parameters[:, 6, None]
        + parameters[:, 7, None] * windows.at[:, :, 0]
        + parameters[:, 8, None] * windows.at[:, :, 1]
    )
    return windows.counts - plane - amplitude * product, jacobian


def _levenberg(windows: _Windows, parameters: Array, offset: float) -> tuple[Array, Array, Array]:
    """Batched Levenberg-Marquardt: parameters, cost (N,), inverse normal matrices (N, 9, 9)."""
    damping = np.full(len(parameters), 1e-3)
    residual, jacobian = _residuals(windows, parameters, offset)
    cost = np.sum(windows.weight * residual**2, axis=1)
    identity = np.eye(_PARAMETERS)
    for _ in range(_ITERATIONS):
        normal_matrix, gradient = _normal_equations(windows, residual, jacobian)
        diagonal = np.diagonal(normal_matrix, axis1=1, axis2=2) + 1e-9
        damped = normal_matrix + (damping[:, None] * diagonal)[:, :, None] * identity
        step = _solve(damped, gradient[:, :, None])[:, :, 0]
        step[:, :2] = np.clip(step[:, :2], -2.0, 2.0)
        step[:, 2:5] = np.clip(step[:, 2:5], -0.3, 0.3)
        trial = parameters + step
        trial[:, 4] = np.clip(trial[:, 4], np.log(0.25), np.log(8.0))
        trial_residual, trial_jacobian = _residuals(windows, trial, offset)
        trial_cost = np.sum(windows.weight * trial_residual**2, axis=1)
        better = trial_cost < cost
        parameters = np.where(better[:, None], trial, parameters)
        residual = np.where(better[:, None], trial_residual, residual)
        jacobian = np.where(better[:, None, None], trial_jacobian, jacobian)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 8.0).clip(1e-9, 1e6)
        if np.abs(step[:, :2]).max() < _SETTLED_PX:
            break
    normal_matrix, _ = _normal_equations(windows, residual, jacobian)
    return parameters, cost, _solve(normal_matrix, np.broadcast_to(identity, normal_matrix.shape))


def _normal_equations(windows: _Windows, residual: Array, jacobian: Array) -> tuple[Array, Array]:
    weighted = (jacobian * windows.weight[:, :, None]).transpose(0, 2, 1)
    return weighted @ jacobian, (weighted @ residual[:, :, None])[:, :, 0]


def _solve(matrices: Array, right: Array) -> Array:
    """Solve many small symmetric positive systems (N, K, K) x = (N, K, M) by LDL'.

    Vectorised over the systems: LAPACK called a hundred times for 9x9 spends its time in threads.
    """
    size = matrices.shape[1]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 1e-30))
    a = matrices * scale[:, :, None] * scale[:, None, :] + 1e-12 * np.eye(size)
    x = right * scale[:, :, None]
    for k in range(size):
        pivot = np.maximum(a[:, k, k], 1e-15)
        factor = a[:, k + 1 :, k] / pivot[:, None]
        a[:, k + 1 :, k:] -= factor[:, :, None] * a[:, None, k, k:]
        x[:, k + 1 :] -= factor[:, :, None] * x[:, None, k]
    for k in range(size - 1, -1, -1):
        known = np.sum(a[:, k, k + 1 :, None] * x[:, k + 1 :], axis=1)
        x[:, k] = (x[:, k] - known) / np.maximum(a[:, k, k], 1e-15)[:, None]
    return x * scale[:, :, None]


def _plane(windows: _Windows) -> list[Array]:
    """The three regressors of a plane, each (N, P)."""
    return [np.ones_like(windows.counts), windows.at[:, :, 0], windows.at[:, :, 1]]


def _regress(windows: _Windows, regressors: list[Array]) -> Array:
    """(N, K) least-squares coefficients of K regressors (N, P)."""
    basis = np.stack(regressors, axis=2)
    weighted = (basis * windows.weight[:, :, None]).transpose(0, 2, 1)
    return _solve(weighted @ basis, weighted @ windows.counts[:, :, None])[:, :, 0]


def _spread(windows: _Windows) -> Array:
    """(N,) squared deviations from the best plane within the window: what edges must explain."""
    regressors = np.stack(_plane(windows), axis=2)
    plane = (regressors @ _regress(windows, _plane(windows))[:, :, None])[:, :, 0]
    return np.asarray(np.sum(windows.weight * (windows.counts - plane) ** 2, axis=1))


def _imbalance(windows: _Windows, parameters: Array) -> Array:
    """(N,) how much of a single edge runs through the corner, against the crossing.

    Near 0 where four fields of two shades meet; 1 at the outer corner of the last square, which
    otherwise looks much like a crossing.
    """
    inverse = np.exp(-parameters[:, 4, None]) * np.sqrt(0.5)
    e1, e2 = (erf(distance * inverse) for distance in _distances(windows, parameters)[0])
    coefficients = np.abs(_regress(windows, [e1 * e2, e1, e2, *_plane(windows)])[:, :3])
    return np.asarray(coefficients[:, 1:].max(1) / np.maximum(coefficients[:, 0], 1e-12))
