"""One stereo frame against the patches of a keyframe window: where they are, and its pose."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.odometry.feature_based.fixed_pattern import on_fixed_pattern
from thermal_stereo_vo.odometry.feature_based.frame_pose import (
    FramePose,
    mark_inliers,
    prosac_samples,
    ransac_frame_pose,
    refine_frame_pose,
)
from thermal_stereo_vo.odometry.feature_based.image_pyramid import LEVELS, Pyramid, build_pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import (
    NO_GUESS,
    KeyframeWindow,
    WindowPoints,
)
from thermal_stereo_vo.odometry.feature_based.patch_alignment import align_patches

Pyramids = tuple[Pyramid | None, Pyramid | None]
"""Left and right; None for a blind eye."""


@dataclass(frozen=True)
class TrackingConfig:
    """How patches are found again and which of them are believed."""

    smoothing_px: float = setting(
        0.8, "Sigma of the Gaussian before alignment.", unit="px", minimum=0.0, maximum=5.0
    )
    patch_radius_px: int = setting(
        5, "Half side of the patches; 5 means 11 x 11.", unit="px", minimum=2, maximum=15
    )
    alignment_iterations: int = setting(
        10, "Most iterations of an alignment on each pyramid level.", minimum=1, maximum=100
    )
    min_correlation: float = setting(
        0.65, "Least correlation of an aligned patch.", minimum=0.0, maximum=1.0
    )
    row_tolerance_px: float = setting(
        1.5, "Largest row difference of the eyes.", unit="px", minimum=0.1, maximum=20.0
    )
    ransac_iterations: int = setting(100, "Most 3-point samples.", minimum=1, maximum=10000)
    inlier_px: float = setting(
        1.0, "Largest residual of an inlier of the samples.", unit="px", minimum=0.1, maximum=50.0
    )
    outlier_sigmas: float = setting(
        4.0, "Residuals beyond this many sigma do not count as seen.", minimum=2.0, maximum=20.0
    )
    sigma_floor_px: float = setting(
        0.1, "Least noise that is assumed.", unit="px", minimum=0.001, maximum=5.0
    )
    radial_trust: float = setting(
        0.5,
        "Tangent of the angle from the optical axis at which the residual calibration error is as "
        "large as the noise of a feature; points further out weigh less. 0 trusts all alike.",
        minimum=0.0,
        maximum=10.0,
    )
    min_inliers: int = setting(12, "Fewer inliers are no measurement.", minimum=6, maximum=1000)


@dataclass(frozen=True)
class Tracked:
    """What one frame saw.

    ``observed`` (N, 4) px uL vL uR vR of ``points``, NaN where not found; ``inliers`` (N,) bool;
    ``pose`` from the inliers.
    """

    points: WindowPoints
    observed: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    pose: FramePose

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(self.inliers.sum())

    def zero_flow(self, window: KeyframeWindow) -> int:
        """Inliers that stick to the sensor, by the pose that all of them gave."""
        predicted, _ = window.predict(self.points, self.pose.T_camera_world, 1.0)
        stuck = on_fixed_pattern(self.points.host_px, self.observed[:, :2], predicted[:, :2])
        return int(np.sum(stuck & self.inliers))

    def epipolar_dy_px(self) -> float:
        """Median row of the right eye minus row of the left; 0 while an eye is blind."""
        dy_px = self.observed[self.inliers, 3] - self.observed[self.inliers, 1]
        return float(np.nanmedian(dy_px)) if np.any(np.isfinite(dy_px)) else 0.0


class PatchTracker:
    """Aligns patches coarse to fine; the worker takes one half of them."""

    def __init__(self, config: TrackingConfig, worker: Executor, seed: int) -> None:
        self._config = config
        self._worker = worker
        self._seed = seed
        self.reset()

    def reset(self) -> None:
        """Start the random numbers anew."""
        self._rng = np.random.default_rng(self._seed)

    def pyramids(self, left: CameraView | None, right: CameraView | None) -> Pyramids:
        """Image pyramids of both eyes."""

        def build(view: CameraView | None) -> Pyramid | None:
            return None if view is None else build_pyramid(view.image, self._config.smoothing_px)

        future = self._worker.submit(build, right)
        return build(left), future.result()

    def align(
        self, window: KeyframeWindow, pyramids: Pyramids, T_start: NDArray[np.float64]
    ) -> tuple[WindowPoints, NDArray[np.float64], NDArray[np.float64]]:
        """Look for all points of the window around where ``T_start`` T_camera_world puts them.

        Returns the points, (N, 4) observations with NaN for what was not found or sticks to the
        sensor, and the (N,) correlation of the patches.
        """
        points = window.points()
        predicted, warps = window.predict(points, T_start, float(self._config.patch_radius_px))
        observed = np.full((len(points), 4), np.nan)
        score = np.full(len(points), -1.0)

        def run(part: slice) -> None:
            _Alignment(
                self._config, window, points.hosts[part], points.host_px[part], warps[part]
            ).both_eyes(pyramids, predicted[part], observed[part], score[part])

        half = len(points) // 2
        future = self._worker.submit(run, slice(half, len(points)))
        run(slice(0, half))
        future.result()
        observed[on_fixed_pattern(points.host_px, observed[:, :2], predicted[:, :2])] = np.nan
        return points, observed, score

    def locate(
        self,
        window: KeyframeWindow,
        points: WindowPoints,
        observed: NDArray[np.float64],
        score: NDArray[np.float64],
        T_start: NDArray[np.float64],
    ) -> Tracked | None:
        """The pose (T_camera_world) that most points agree on; None when too few do."""
        config = self._config
        seen = np.flatnonzero(np.sum(np.isfinite(observed), axis=1) >= 2)
        if len(seen) < config.min_inliers:
            return None
        best_first = seen[np.argsort(-score[seen], kind="stable")]
        chosen = points.take(best_first)
        geometry = (window.T_keyframe_world, chosen.hosts, chosen.bearings, chosen.rhos)
        counted = _without_guesses(points, observed)
        pixels, eyes = counted[best_first], window.eyes
        samples = prosac_samples(self._rng, len(chosen), config.ransac_iterations)
        count, T = ransac_frame_pose(
            T_start, *geometry, pixels, eyes, samples, config.inlier_px, 0.999
        )
        if count < config.min_inliers:
            return None
        # The sample fixed depths that the refinement leaves free: be generous before it.
        marked = np.empty(len(chosen), np.bool_)
        mark_inliers(T, *geometry, pixels, eyes, 2.0 * config.inlier_px, marked)
        return self._refine(window, points, observed, counted, np.sort(best_first[marked]), T)

    def _refine(
        self,
        window: KeyframeWindow,
        points: WindowPoints,
        observed: NDArray[np.float64],
        counted: NDArray[np.float64],
        index: NDArray[np.intp],
        T_start: NDArray[np.float64],
    ) -> Tracked | None:
        config = self._config
        chosen = points.take(index)
        pixels = np.ascontiguousarray(counted[index])
        pose = refine_frame_pose(
            T_start,
            window.T_keyframe_world,
            chosen.hosts,
            chosen.bearings,
            chosen.rhos,
            chosen.rho_information,
            pixels,
            window.radial_weights(chosen.host_px, pixels, config.radial_trust),
            window.eyes,
            sigma_floor_px=config.sigma_floor_px,
        )
        if pose is None:
            return None
        limit_px = config.outlier_sigmas * pose.sigma_px
        # The residuals hold the noise of the depths too, which the pose did not fix: twice that.
        fits = ~np.any(np.abs(pose.residuals) > 2.0 * limit_px, axis=1)
        inliers = np.zeros(len(points), np.bool_)
        inliers[index[fits]] = True
        if int(inliers.sum()) < config.min_inliers:
            return None
        return Tracked(points, observed, inliers, pose)


def _without_guesses(points: WindowPoints, observed: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) observations, of points with a guessed depth only by the eye that found them.

    A disparity against a guess would shift the pose.
    """
    if np.all(points.guesser == NO_GUESS):
        return observed
    counted = observed.copy()
    for eye in (0, 1):
        found_again = np.isfinite(observed[:, 2 * eye])
        counted[(points.guesser == eye) & found_again, 2 - 2 * eye : 4 - 2 * eye] = np.nan
    return counted


class _Alignment:
    """The patches of some points, ready to be looked for in either eye."""

    def __init__(
        self,
        config: TrackingConfig,
        window: KeyframeWindow,
        hosts: NDArray[np.int64],
        host_px: NDArray[np.float64],
        warps: NDArray[np.float64],
    ) -> None:
        self._config = config
        self._patches = (hosts, host_px, warps)
        self._stacks = window.images.stacks
        self._px, self._score = np.empty((len(hosts), 2)), np.empty(len(hosts))

    def both_eyes(
        self,
        pyramids: Pyramids,
        predicted: NDArray[np.float64],
        observed: NDArray[np.float64],
        score: NDArray[np.float64],
    ) -> None:
        """Fill ``observed`` (N, 4) and ``score`` (N,) from ``predicted`` (N, 4)."""
        left, right = pyramids
        start, top_level = predicted[:, 2:], LEVELS - 1
        dy_px = predicted[:, 3] - predicted[:, 1]
        if left is not None:
            found = self._one_eye(left, predicted[:, :2], LEVELS - 1)
            observed[found, :2] = self._px[found]
            score[:] = self._score
            # The eyes move together: what the left one found tells the right one where to look.
            start = np.full((len(predicted), 2), np.nan)
            disparity = predicted[:, 0] - predicted[:, 2]
            start[found, 0] = self._px[found, 0] - disparity[found]
            start[found, 1] = self._px[found, 1] + dy_px[found]
            top_level = 1
        if right is not None:
            found = self._one_eye(right, start, top_level)
            if left is None:
                score[:] = self._score
            else:
                row_error_px = self._px[:, 1] - observed[:, 1] - dy_px
                found &= np.abs(row_error_px) < self._config.row_tolerance_px
            observed[found, 2:] = self._px[found]

    def _one_eye(
        self, pyramid: Pyramid, start_px: NDArray[np.float64], top_level: int
    ) -> NDArray[np.bool_]:
        config = self._config
        align_patches(
            self._stacks,
            pyramid,
            *self._patches,
            np.ascontiguousarray(start_px),
            top_level,
            config.patch_radius_px,
            config.alignment_iterations,
            self._px,
            self._score,
        )
        return np.asarray(self._score >= config.min_correlation)
