"""How far away new points may be, before anything has measured it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.direct.rig import Rig

_NEIGHBOURS = 5
_MARGIN_PX = 50.0
_SPREAD = 0.1
_RHO_MIN = 1e-4


def random_depths(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(N,) inverse depths of mean one (Dai et al. 2019, section IV.A)."""
    rhos = np.exp(_SPREAD * rng.standard_normal(count))
    return np.asarray(rhos / rhos.mean())


def depths_around(
    rig: Rig,
    camera: int,
    T_rig_host: NDArray[np.float64],
    bearings: NDArray[np.float64],
    rhos: NDArray[np.float64],
    pixels: NDArray[np.int64],
) -> NDArray[np.float64] | None:
    """(M,) inverse depths at ``pixels`` (M, 2) of a camera, between the known points near by.

    ``T_rig_host`` (N, 4, 4), ``bearings`` (N, 3) and ``rhos`` (N,) of those.  None when too few of
    them are in sight.
    """
    T = rig.T_camera_rig[camera] @ T_rig_host
    depth_rho = np.einsum("nj,nj->n", T[:, 2, :3], bearings) + rhos * T[:, 2, 3]
    at = rig.pixels_of(camera, T_rig_host, bearings, rhos)
    height, width = rig.shapes[camera]
    inside = np.all((at > -_MARGIN_PX) & (at < np.array([width, height]) + _MARGIN_PX), axis=1)
    at, there = at[inside], rhos[inside] / depth_rho[inside]
    if len(at) < _NEIGHBOURS:
        return None
    squares = np.subtract.outer(pixels[:, 0], at[:, 0]) ** 2
    squares += np.subtract.outer(pixels[:, 1], at[:, 1]) ** 2
    squares += _NEIGHBOURS**2
    near = np.argpartition(squares, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]
    weights = 1.0 / np.take_along_axis(squares, near, axis=1)
    mean = np.sum(weights * there[near], axis=1) / np.sum(weights, axis=1)
    return np.asarray(np.maximum(mean, _RHO_MIN))
