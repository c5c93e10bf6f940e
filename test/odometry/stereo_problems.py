"""Motion problems with a known answer, and their plain numpy form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3, transform_points
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera

CAMERA = StereoCamera(fx=522.0, fy=526.0, cx=320.5, cy=255.0, cx_right=324.0, baseline_m=0.268)


@dataclass(frozen=True)
class Problem:
    """``points`` (N, 3) m, ``observed`` (N, 4) px, ``weights`` (N,), ``T_true`` (4, 4)."""

    points: NDArray[np.float64]
    observed: NDArray[np.float64]
    weights: NDArray[np.float64]
    T_true: NDArray[np.float64]
    camera: StereoCamera = CAMERA

    def residuals(self, T):
        """(N, 4) x - f(p) px, written out without the package's own projection."""
        c = self.camera
        x, y, z = transform_points(T, self.points).T
        with np.errstate(invalid="ignore", divide="ignore"):
            v = c.fy * y / z + c.cy
            predicted = [
                c.fx * x / z + c.cx,
                v,
                c.fx * (x - c.baseline_m) / z + c.cx_right,
                v,
            ]
        r = self.observed - np.stack(predicted, axis=1)
        return np.where((z > 0)[:, None], r, np.inf)

    def cost(self, T) -> float:
        """Half the weighted sum of squares, px^2."""
        return float(0.5 * np.sum(self.weights[:, None] * self.residuals(T) ** 2))

    def normal_equations(self, T, step=1e-6):
        """A (6, 6) and g (6,) by central differences of the left perturbation."""
        J = np.empty((4 * len(self.points), 6))
        for k in range(6):
            e = np.zeros(6)
            e[k] = step
            ahead, behind = (self.residuals(exp_se3(s * e) @ T).ravel() for s in (1, -1))
            J[:, k] = -(ahead - behind) / (2 * step)
        w = np.repeat(self.weights, 4)
        return J.T @ (w[:, None] * J), J.T @ (w * self.residuals(T).ravel())

    def scipy_solution(self, T_start):
        """(4, 4) minimum by scipy's Levenberg-Marquardt (MINPACK)."""
        w = np.sqrt(self.weights)[:, None]
        found = least_squares(
            lambda d: (w * self.residuals(exp_se3(d) @ T_start)).ravel(),
            np.zeros(6),
            method="lm",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        return exp_se3(found.x) @ T_start


def make_problem(
    rng: np.random.Generator,
    n: int = 60,
    *,
    sigma_px: float = 0.5,
    translation_m: float = 0.3,
    rotation_rad: float = 0.05,
    depth_m: tuple[float, float] = (4.0, 40.0),
    weighted: bool = False,
) -> Problem:
    """Points in front of the rig after a random motion, seen with noise."""
    T_true = exp_se3(
        np.concatenate([rng.normal(0, translation_m, 3), rng.normal(0, rotation_rad, 3)])
    )
    after = seen_points(rng, n, depth_m)
    observed = CAMERA.project(after) + rng.normal(0, sigma_px, (n, 4))
    weights = rng.uniform(0.1, 3.0, n) if weighted else np.ones(n)
    return Problem(transform_points(inverse(T_true), after), observed, weights, T_true)


def seen_points(rng, n, depth_m=(4.0, 40.0)):
    """(N, 3) points spread over the image of ``CAMERA``."""
    z = np.exp(rng.uniform(*np.log(depth_m), n))
    u, v = rng.uniform((0, 0), (640, 512), (n, 2)).T
    return np.column_stack([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z])


def on_a_line(rng):
    """Any turn about the line through all points changes nothing: A has rank 5."""
    along = np.linspace(-1.0, 1.0, 30)[:, None]
    points = np.array([0.5, -0.3, 12.0]) + along * np.array([2.0, 1.0, 4.0])
    observed = CAMERA.project(points) + rng.normal(0, 0.3, (30, 4))
    return Problem(points, observed, np.ones(30), np.eye(4))


def one_place(rng):
    """Thirty times the same point: rank 3."""
    points = np.tile([[0.5, -0.3, 12.0]], (30, 1))
    observed = CAMERA.project(points) + rng.normal(0, 0.3, (30, 4))
    return Problem(points, observed, np.ones(30), np.eye(4))


def difference(T_a, T_b):
    """(6,) tangent vector from one motion to the other."""
    return log_se3(T_a @ inverse(T_b))
