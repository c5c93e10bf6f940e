"""Motion between two stereo frames: 3-point RANSAC, then refinement on the inliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.kernels import retract, solve_positive
from thermal_stereo_vo.odometry.feature_based.stereo_projection import (
    StereoCamera,
    linearise_reprojection,
    reprojection_residuals,
)
from thermal_stereo_vo.odometry.information import inverse_information
from thermal_stereo_vo.odometry.solvers import Solution, SolverConfig, solve_reprojection

_SHARPEST_PX = 0.05
"""Less than this is no error of a feature: images without noise make no outliers."""


@dataclass(frozen=True)
class MotionConfig:
    """How outliers are told and the motion refined."""

    ransac_iterations: int = setting(200, "Most 3-point samples.", minimum=1, maximum=100000)
    ransac_confidence: float = setting(
        0.9999, "Stop sampling once a better sample is this unlikely.", minimum=0.5, maximum=1.0
    )
    inlier_px: float = setting(
        2.0,
        "Largest reprojection error of an inlier in either eye.",
        unit="px",
        minimum=0.05,
        maximum=50.0,
    )
    inlier_medians: float = setting(
        5.0,
        "And in medians of the inliers' errors, where that is less: sharp features show what is "
        "wrong by less than inlier_px. 0 never asks for less (P1).",
        minimum=0.0,
        maximum=100.0,
    )
    refinements: int = setting(
        2, "Rounds of solving on the inliers and choosing them anew.", minimum=1, maximum=10
    )
    min_inliers: int = setting(10, "Fewer inliers are no measurement.", minimum=6, maximum=1000)
    radial_trust: float = setting(
        0.25,
        "Tangent of the angle from the optical axis at which the residual calibration error is as "
        "large as the noise of a feature; points further out weigh less. 0 trusts all alike (P1).",
        minimum=0.0,
        maximum=10.0,
    )
    solver: SolverConfig = group(SolverConfig, "Stopping rules of the solvers.")


@dataclass(frozen=True)
class Motion:
    """A measured motion.

    ``T_current_previous`` (4, 4); ``covariance`` (6, 6) of its left perturbation (rho, phi);
    ``inliers`` (N,) bool; rms of the inliers' residual components in px.
    """

    T_current_previous: NDArray[np.float64]
    covariance: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    rms_px: float
    solution: Solution


def estimate_motion(
    points_m: NDArray[np.float64],
    observed_px: NDArray[np.float64],
    camera: StereoCamera,
    T_start: NDArray[np.float64],
    solver: str,
    config: MotionConfig,
    rng: np.random.Generator,
) -> Motion | None:
    """The motion that maps (N, 3) previous points onto (N, 4) current pixels uL vL uR vR.

    ``T_start`` (4, 4) is where every search starts.  None when fewer than ``min_inliers`` agree.
    """
    n = len(points_m)
    if n < config.min_inliers:
        return None
    parameters = camera.parameters
    # A view of a larger array would be another type to the compiler.
    points_m, observed_px = np.ascontiguousarray(points_m), np.ascontiguousarray(observed_px)
    samples = rng.integers(0, n, size=(config.ransac_iterations, 3))
    _, T = ransac_motion(
        points_m, observed_px, parameters, T_start, samples,
        config.inlier_px**2, config.ransac_confidence,
    )  # fmt: skip
    solution: Solution | None = None
    inliers = inliers_of(T, points_m, observed_px, camera, config)
    for _ in range(config.refinements):
        if int(inliers.sum()) < config.min_inliers:
            return None
        chosen_points = np.ascontiguousarray(points_m[inliers])
        chosen_px = np.ascontiguousarray(observed_px[inliers])
        solution = solve_reprojection(
            solver,
            T,
            chosen_points,
            chosen_px,
            radial_weights(chosen_px, camera, config.radial_trust),
            parameters,
            config.solver,
        )
        T = solution.T
        used = inliers
        inliers = inliers_of(T, points_m, observed_px, camera, config)
    assert solution is not None
    if int(inliers.sum()) < config.min_inliers:
        return None
    residuals = reprojection_residuals(T, points_m[used], observed_px[used], camera)
    variance_px2 = 2.0 * solution.cost / max(residuals.size - 6, 1)
    unit_covariance = inverse_information(solution.A)
    if unit_covariance is None:
        return None
    return Motion(
        T, variance_px2 * unit_covariance, inliers, float(np.sqrt(np.mean(residuals**2))), solution
    )


def inliers_of(
    T: NDArray[np.float64],
    points_m: NDArray[np.float64],
    observed_px: NDArray[np.float64],
    camera: StereoCamera,
    config: MotionConfig,
) -> NDArray[np.bool_]:
    """(N,) bool: which points the motion explains, by both rules of the settings."""
    errors_px2 = worse_errors(T, points_m, observed_px, camera.parameters)
    inliers: NDArray[np.bool_] = errors_px2 < config.inlier_px**2
    if config.inlier_medians > 0.0 and np.any(inliers):
        median_px2 = max(float(np.median(errors_px2[inliers])), _SHARPEST_PX**2)
        inliers &= errors_px2 < config.inlier_medians**2 * median_px2
    return inliers


def radial_weights(
    observed_px: NDArray[np.float64], camera: StereoCamera, trust: float
) -> NDArray[np.float64]:
    """(N,) weights 1 / (1 + (r / trust)^2), r the tangent of the angle from the optical axis.

    What calibration leaves of the lens distortion grows towards the border of the image, and,
    other than noise, does not average out over frames.
    """
    if trust == 0.0:
        return np.ones(len(observed_px))
    x = (observed_px[:, 0] - camera.cx) / camera.fx
    y = (observed_px[:, 1] - camera.cy) / camera.fy
    weights: NDArray[np.float64] = 1.0 / (1.0 + (x * x + y * y) / trust**2)
    return weights


@njit(cache=True, nogil=True)
def ransac_motion(  # type: ignore[no-untyped-def]
    points, observed, camera, T_start, samples, inlier_px2, confidence
):
    """Best of many 3-point motions by the truncated squared errors of all points (MSAC).

    Torr and Zisserman 2000.  P1 counts inliers: with points 0.1 px sharp and a threshold of 2 px
    the motion with most of them is one bent until a wrong match fits, such as a turn before a wall
    in place of a step to the side.  ``samples`` (M, 3) indices.  Each is solved by Gauss-Newton on
    its 12 equations from ``T_start``.  Returns the number of inliers and (4, 4) T.
    """
    n = len(points)
    best_T = T_start.copy()
    best, best_cost = truncated_cost(best_T, points, observed, camera, inlier_px2)
    T, T_new = np.eye(4), np.eye(4)
    A, g, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    three_points, three_px, ones = np.empty((3, 3)), np.empty((3, 4)), np.ones(3)
    needed = len(samples)
    for s in range(len(samples)):
        if s >= needed:
            break
        a, b, c = samples[s, 0], samples[s, 1], samples[s, 2]
        if a in (b, c) or b == c:
            continue
        three_points[0], three_points[1], three_points[2] = points[a], points[b], points[c]
        three_px[0], three_px[1], three_px[2] = observed[a], observed[b], observed[c]
        T[:] = T_start
        good = False
        for _ in range(15):
            cost = linearise_reprojection(T, three_points, three_px, ones, camera, A, g)
            if not np.isfinite(cost):
                break
            for k in range(6):
                A[k, k] *= 1.0 + 1e-9
            if not solve_positive(A, g, step):
                break
            retract(T, step, T_new)
            T[:] = T_new
            largest = np.max(np.abs(step))
            if largest < 1e-5:
                good = True
                break
            if largest > 100.0:
                break
        if not good:
            continue
        count, cost = truncated_cost(T, points, observed, camera, inlier_px2)
        if cost < best_cost:
            best, best_cost = count, cost
            best_T[:] = T
            ratio = (count / n) ** 3
            if ratio >= 1.0:
                break
            if ratio > 1e-9 and confidence < 1.0:
                needed = min(needed, int(np.ceil(np.log(1.0 - confidence) / np.log(1.0 - ratio))))
    return best, best_T


@njit(cache=True, nogil=True)
def squared_errors(T, point, pixel, camera):  # type: ignore[no-untyped-def]
    """Squared reprojection error (px^2) in the left and the right eye; infinite behind them."""
    fx, fy, cx, cy, cx_right, baseline = camera
    x, y, z = point[0], point[1], point[2]
    pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if pz <= 1e-6:
        return np.inf, np.inf
    px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    v = fy * py / pz + cy
    du_left = pixel[0] - (fx * px / pz + cx)
    du_right = pixel[2] - (fx * (px - baseline) / pz + cx_right)
    left = du_left * du_left + (pixel[1] - v) ** 2
    right = du_right * du_right + (pixel[3] - v) ** 2
    return left, right


@njit(cache=True, nogil=True)
def worse_error(T, point, pixel, camera):  # type: ignore[no-untyped-def]
    """The larger squared reprojection error (px^2) of both eyes; infinite behind them."""
    left, right = squared_errors(T, point, pixel, camera)
    # NaN is larger than any threshold, whichever eye it is in.
    return max(left, right) if left >= 0.0 and right >= 0.0 else np.inf


@njit(cache=True, nogil=True)
def truncated_cost(T, points, observed, camera, inlier_px2):  # type: ignore[no-untyped-def]
    """How many points reproject within the threshold in both eyes, and what all cost together.

    A point costs the larger squared error (px^2) of its two eyes, at most the threshold.
    """
    count, cost = 0, 0.0
    for i in range(len(points)):
        error = worse_error(T, points[i], observed[i], camera)
        if error < inlier_px2:
            count += 1
            cost += error
        else:
            cost += inlier_px2
    return count, cost


@njit(cache=True, nogil=True)
def worse_errors(T, points, observed, camera):  # type: ignore[no-untyped-def]
    """(N,) the larger squared reprojection error (px^2) of both eyes; infinite behind them."""
    errors = np.empty(len(points))
    for i in range(len(points)):
        errors[i] = worse_error(T, points[i], observed[i], camera)
    return errors
