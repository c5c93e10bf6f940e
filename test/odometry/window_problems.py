"""Keyframe windows with a known answer, and their plain numpy form.

Nothing of the package's own projection is used to make or to judge them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import exp_se3, exp_so3, inverse, log_se3, transform_points
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import BundleProblem

from .stereo_problems import CAMERA, seen_points

NO_TURN = np.zeros(3)
TURN = np.array([0.004, -0.006, 0.003])
"""Large enough for each angle to be seen at every place where it should enter."""


def seen_by(T, points_w, turn=NO_TURN, camera=CAMERA):
    """(N, 4) uL vL uR vR of world points, NaN behind either eye; the right eye truly rotated."""
    left = transform_points(T, points_w)
    right = (left - [camera.baseline_m, 0.0, 0.0]) @ exp_so3(turn).T
    z, zr = (np.where(p[:, 2] > 0, p[:, 2], np.nan) for p in (left, right))
    return np.stack(
        [
            camera.fx * left[:, 0] / z + camera.cx,
            camera.fy * left[:, 1] / z + camera.cy,
            camera.fx * right[:, 0] / zr + camera.cx_right,
            camera.fy * right[:, 1] / zr + camera.cy,
        ],
        axis=1,
    )


def bearings_of(pixels, camera=CAMERA):
    """(N, 3) with z = 1."""
    x = (pixels[:, 0] - camera.cx) / camera.fx
    return np.column_stack([x, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))])


def eyes_of(turn=NO_TURN, camera=CAMERA):
    return np.concatenate([camera.parameters, turn])


def path(rng, keyframes, step_m=0.4, turn_rad=0.02):
    """(K, 4, 4) T_k_w of a rig that goes forward and sideways, the first at the origin."""
    T_w_k = [np.eye(4)]
    for _ in range(keyframes - 1):
        step = np.concatenate(
            [rng.normal([0.5 * step_m, 0.0, step_m], 0.1), rng.normal(0, turn_rad, 3)]
        )
        T_w_k.append(T_w_k[-1] @ exp_se3(step))
    return np.array([inverse(T) for T in T_w_k])


@dataclass(frozen=True)
class Window:
    """A bundle problem at its true answer, with noise in the observations."""

    problem: BundleProblem
    points_w: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.problem.rhos)

    def changed(self, **changes) -> Window:
        return replace(self, problem=replace(self.problem, **changes))

    def disturbed(self, rng, *, pose=0.02, depth=0.05) -> Window:
        """Start somewhere else: all poses but the oldest moved, all depths scaled."""
        T = self.problem.T_k_w.copy()
        for k in range(1, len(T)):
            T[k] = exp_se3(rng.normal(0, [pose] * 3 + [0.2 * pose] * 3)) @ T[k]
        return self.changed(
            T_k_w=T, rhos=self.problem.rhos * np.exp(rng.normal(0, depth, len(self)))
        )


def make_window(
    rng: np.random.Generator,
    keyframes: int = 4,
    n: int = 60,
    *,
    sigma_px: float = 0.0,
    turn=NO_TURN,
    depth_m=(3.0, 40.0),
    holes: float = 0.0,
    weighted: bool = False,
) -> Window:
    """Points hosted by all keyframes in turn and seen by all that face them.

    ``holes`` is the share of single observations, by either eye, that are missing.
    """
    T = path(rng, keyframes)
    hosts = np.sort(np.arange(n) % keyframes)
    in_host = seen_points(rng, n, depth_m)
    points_w = np.array(
        [transform_points(inverse(T[h]), p[None])[0] for h, p in zip(hosts, in_host, strict=True)]
    )
    observed = np.array([seen_by(T_k, points_w, turn) for T_k in T])
    exact = observed[hosts, np.arange(n), :2]
    observed += rng.normal(0, sigma_px, observed.shape)
    lost = rng.random((keyframes, n, 2)) < holes
    observed[..., :2][lost[..., 0]] = np.nan
    observed[..., 2:][lost[..., 1]] = np.nan
    # In its host a point is the centre of the patch: exact, by definition.
    observed[hosts, np.arange(n), :2] = exact
    weights = rng.uniform(0.3, 2.0, (keyframes, n)) if weighted else np.ones((keyframes, n))
    problem = BundleProblem(
        T, hosts, bearings_of(exact), 1.0 / in_host[:, 2], observed, weights, eyes_of()
    )
    return Window(problem, points_w)


def poses_apart(T_a, T_b):
    """(6 K,) left tangent vectors from poses b to poses a."""
    return np.concatenate([log_se3(a @ inverse(b)) for a, b in zip(T_a, T_b, strict=True)])


def numeric_jacobian(function, x, step=1e-6):
    """(M, len(x)) by central differences."""
    columns = []
    for k in range(len(x)):
        e = np.zeros(len(x))
        e[k] = step
        columns.append((function(x + e) - function(x - e)) / (2 * step))
    return np.stack(columns, axis=-1)


def eliminated(H, b, keep):
    """Schur complement: the equations of the first ``keep`` unknowns, all others at their best."""
    solved = np.linalg.solve(H[keep:, keep:], np.column_stack([H[keep:, :keep], b[keep:]]))
    return H[:keep, :keep] - H[:keep, keep:] @ solved[:, :-1], b[:keep] - H[:keep, keep:] @ solved[
        :, -1
    ]


def mean_nees_band(dimension: int, runs: int, probability: float = 0.999) -> tuple[float, float]:
    """Where the mean of ``runs`` squared Mahalanobis distances must lie if covariances are true."""
    from scipy.stats import chi2

    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], dimension * runs) / runs
    return float(low), float(high)
