"""Features of a stereo frame and the motion between two of them, however far apart they are."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.feature_based.description import (
    DescriptionConfig,
    Features,
    FreakDescriber,
)
from thermal_stereo_vo.odometry.feature_based.fast_hessian import FastHessian, FastHessianConfig
from thermal_stereo_vo.odometry.feature_based.loop_matching import (
    LoopMatches,
    LoopMatchingConfig,
    StereoFeatures,
    match_loops,
)
from thermal_stereo_vo.odometry.feature_based.motion import Motion, MotionConfig, estimate_motion
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera


@dataclass(frozen=True)
class FeatureConfig:
    """The stages of the paper's method."""

    detector: FastHessianConfig = group(FastHessianConfig, "Fast-Hessian interest points.")
    description: DescriptionConfig = group(DescriptionConfig, "FREAK descriptors.")
    matching: LoopMatchingConfig = group(LoopMatchingConfig, "Gates of the loop matching.")
    motion: MotionConfig = group(MotionConfig, "RANSAC and refinement of the motion.")


class FeatureMatcher:
    """Fast-Hessian + FREAK on both eyes, loop matching, RANSAC and one of three solvers."""

    def __init__(self, config: FeatureConfig, solver: str, worker: Executor, seed: int) -> None:
        self._config = config
        self._solver = solver
        self._seed = seed
        self._detectors = {role: FastHessian(config.detector) for role in (LEFT, RIGHT)}
        self._describers = {role: FreakDescriber(config.description) for role in (LEFT, RIGHT)}
        self._worker = worker
        self.reset()

    def reset(self) -> None:
        """Start the random numbers anew."""
        self._rng = np.random.default_rng(self._seed)

    def extract(self, left: CameraView, right: CameraView) -> StereoFeatures:
        """Describe the interest points of both eyes; the worker takes the right one.

        Raises FrameError for a view without its 8-bit form.
        """
        future = self._worker.submit(self._extract_one, RIGHT, right)
        left_features = self._extract_one(LEFT, left)
        return StereoFeatures.of(left_features, future.result(), left.camera)

    def match(
        self,
        current: StereoFeatures,
        reference: StereoFeatures,
        camera: StereoCamera,
        T_reference_current: NDArray[np.float64] | None,
    ) -> LoopMatches:
        """Close loops between two frames; without a prediction (4, 4) the search is wide."""
        return match_loops(current, reference, camera, T_reference_current, self._config.matching)

    def sees_enough(self, features: StereoFeatures, camera: StereoCamera) -> bool:
        """Whether both eyes agree on enough points to measure a motion from this frame on.

        The loop from a frame to itself closes where they do.  It also closes now and then by
        chance: just as often when the eyes are exchanged, which tells true partners from others.
        """
        exchanged = StereoFeatures(
            features.right, features.left, features.right_grid, features.left_grid, features.size
        )
        camera_exchanged = replace(camera, cx=camera.cx_right, cx_right=camera.cx)
        by_chance = self.match(exchanged, exchanged, camera_exchanged, np.eye(4))
        loops = self.match(features, features, camera, np.eye(4))
        return len(loops) >= self._config.motion.min_inliers and len(loops) > 2 * len(by_chance)

    def measure(
        self,
        matches: LoopMatches,
        camera: StereoCamera,
        T_reference_current: NDArray[np.float64] | None,
    ) -> Motion | None:
        """The motion from the reference to the current frame, or None."""
        points = camera.triangulate(matches.previous_left, matches.previous_right)
        observed = np.concatenate([matches.left, matches.right], axis=1).astype(np.float64)
        start = np.eye(4) if T_reference_current is None else inverse(T_reference_current)
        return estimate_motion(
            points, observed, camera, start, self._solver, self._config.motion, self._rng
        )

    def _extract_one(self, role: str, view: CameraView) -> Features:
        image = view.display
        if image is None:
            raise FrameError(f"view '{role}' has no 8-bit form: run the frame through the AGC")
        points = self._detectors[role].detect(image, view.mask)
        return self._describers[role].describe(image, points)
