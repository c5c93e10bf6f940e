"""The odometry of P1 (Mouats et al. 2015): each stereo frame against the one before it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import OutOfOrderError
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.results import (
    OdometryResult,
    PointCloud,
    TrackingStatus,
    TrackStats,
)
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.feature_based.description import DescriptionConfig, FreakDescriber
from thermal_stereo_vo.odometry.feature_based.fast_hessian import FastHessian, FastHessianConfig
from thermal_stereo_vo.odometry.feature_based.loop_matching import (
    LoopMatches,
    LoopMatchingConfig,
    StereoFeatures,
    match_loops,
)
from thermal_stereo_vo.odometry.feature_based.motion import Motion, MotionConfig, estimate_motion
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.motion_prior import (
    ConstantVelocity,
    coasting_covariance,
    coasting_twist_covariance,
)
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig, StatusMachine


@dataclass(frozen=True)
class FrameToFrameConfig:
    """The stages of the paper's method."""

    detector: FastHessianConfig = group(FastHessianConfig, "Fast-Hessian interest points.")
    description: DescriptionConfig = group(DescriptionConfig, "FREAK descriptors.")
    matching: LoopMatchingConfig = group(LoopMatchingConfig, "Gates of the loop matching.")
    motion: MotionConfig = group(MotionConfig, "RANSAC and refinement of the motion.")


@dataclass(frozen=True)
class _Reference:
    """The frame that the next ones are matched against."""

    features: StereoFeatures
    pose: PoseEstimate
    stamp_ns: int


class FrameToFrameOdometry:
    """Fast-Hessian + FREAK, loop matching, RANSAC and one of three solvers, frame by frame."""

    requirements = Requirements(roles=(LEFT, RIGHT), rectified_pair=True, display=True)

    def __init__(
        self, config: FrameToFrameConfig, status: StatusConfig, solver: str, seed: int
    ) -> None:
        self._config = config
        self._status_config = status
        self._solver = solver
        self._seed = seed
        self._detectors = {role: FastHessian(config.detector) for role in (LEFT, RIGHT)}
        self._describers = {role: FreakDescriber(config.description) for role in (LEFT, RIGHT)}
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="right-eye")
        self._timer = StageTimer()
        self._last_stamp_ns: int | None = None
        self.reset(np.eye(4))

    def warm_up(self) -> None:
        """Run two small synthetic frames through every kernel."""
        from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair

        throw_away = FrameToFrameOdometry(
            self._config, self._status_config, self._solver, self._seed
        )
        for stamp_ns in range(3):
            throw_away.process(synthetic_pair(stamp_ns * 100_000_000))

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._rng = np.random.default_rng(self._seed)
        self._status = StatusMachine(self._status_config)
        self._prior = ConstantVelocity()
        self._pose = PoseEstimate.start(T_world_rig)
        self._reference: _Reference | None = None
        self._last_stamp_ns = None
        self._twist_covariance = np.zeros((6, 6))
        self._map = PointCloud.empty()

    def local_map(self) -> PointCloud:
        """The inliers of the last measurement."""
        return self._map

    def process(self, frame: RigFrame) -> OdometryResult:
        """Match against the last good frame and move on."""
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            raise OutOfOrderError(
                f"frame at {frame.stamp_ns} ns does not come after {self._last_stamp_ns} ns: "
                "reset the odometry after a jump of the clock"
            )
        step_s = (
            0.0 if self._last_stamp_ns is None else ((frame.stamp_ns - self._last_stamp_ns) * 1e-9)
        )
        self._last_stamp_ns = frame.stamp_ns
        left, right = frame.views.get(LEFT), frame.views.get(RIGHT)
        if left is None or right is None:
            reason = ", ".join(
                f"{role} eye blind ({why.value})" for role, why in frame.blind.items()
            )
            return self._predict(frame.stamp_ns, step_s, TrackStats(), reason or "no images")
        camera = StereoCamera.of(left, right)
        features = self._extract(left, right)
        stats = TrackStats(features=len(features.left))
        if self._reference is None:
            return self._start(frame.stamp_ns, features, stats)
        return self._track(frame.stamp_ns, step_s, features, left, camera, stats)

    def _extract(self, left: CameraView, right: CameraView) -> StereoFeatures:
        with self._timer.stage("extract"):
            future = self._worker.submit(self._extract_one, RIGHT, right)
            left_features = self._extract_one(LEFT, left)
            return StereoFeatures.of(left_features, future.result(), left.camera)

    def _extract_one(self, role: str, view: CameraView):  # type: ignore[no-untyped-def]
        image = view.display
        if image is None:
            raise ValueError(
                f"view '{role}' has no 8-bit view: run the frame through the AGC first"
            )
        points = self._detectors[role].detect(image, view.mask)
        return self._describers[role].describe(image, points)

    def _start(self, stamp_ns: int, features: StereoFeatures, stats: TrackStats) -> OdometryResult:
        self._reference = _Reference(features, self._pose, stamp_ns)
        return self._result(stamp_ns, self._status.started(stamp_ns), stats, "first frame")

    def _track(
        self,
        stamp_ns: int,
        step_s: float,
        features: StereoFeatures,
        left: CameraView,
        camera: StereoCamera,
        stats: TrackStats,
    ) -> OdometryResult:
        reference = self._reference
        assert reference is not None
        elapsed_s = (stamp_ns - reference.stamp_ns) * 1e-9
        found = None
        if self._prior.twist is not None:
            found = self._measure(features, reference, camera, self._prior.predict(elapsed_s))
        if found is None:
            found = self._measure(features, reference, camera, None)
        if found is None:
            result = self._predict(stamp_ns, step_s, stats, "too few matches agree on a motion")
            if result.status is TrackingStatus.LOST:
                # Nothing of the old reference is in sight any more: go on from here.
                self._reference = _Reference(features, self._pose, stamp_ns)
                self._prior.forget()
            return result
        motion, matches = found
        self._pose = reference.pose.moved(motion.T_current_previous, motion.covariance)
        self._reference = _Reference(features, self._pose, stamp_ns)
        self._prior.update(inverse(motion.T_current_previous), elapsed_s)
        self._twist_covariance = motion.covariance / elapsed_s**2
        self._remember_points(matches, motion, left, camera)
        inliers = int(motion.inliers.sum())
        dy_px = matches.left[motion.inliers, 1] - matches.right[motion.inliers, 1]
        stats = replace(
            stats,
            matches=len(matches),
            inliers=inliers,
            rms_px=motion.rms_px,
            iterations=motion.solution.iterations,
            evaluations=motion.solution.evaluations,
            epipolar_dy_px=float(np.median(dy_px)),
        )
        return self._result(stamp_ns, self._status.measured(stamp_ns, inliers), stats, "")

    def _measure(
        self,
        features: StereoFeatures,
        reference: _Reference,
        camera: StereoCamera,
        T_previous_current: NDArray[np.float64] | None,
    ) -> tuple[Motion, LoopMatches] | None:
        with self._timer.stage("match"):
            matches = match_loops(
                features, reference.features, camera, T_previous_current, self._config.matching
            )
        with self._timer.stage("motion"):
            points = camera.triangulate(matches.previous_left, matches.previous_right)
            observed = np.concatenate([matches.left, matches.right], axis=1).astype(np.float64)
            start = np.eye(4) if T_previous_current is None else inverse(T_previous_current)
            motion = estimate_motion(
                points, observed, camera, start, self._solver, self._config.motion, self._rng
            )
        return None if motion is None else (motion, matches)

    def _predict(
        self, stamp_ns: int, step_s: float, stats: TrackStats, reason: str
    ) -> OdometryResult:
        """Coast on the last twist; the pose of the last good reference stays untouched."""
        unseen_s = self._status.unseen_s(stamp_ns) - step_s
        status = self._status.unmeasured(stamp_ns)
        if status is TrackingStatus.GAP:
            moved = self._pose.moved(
                inverse(self._prior.predict(step_s)), coasting_covariance(unseen_s, step_s)
            )
            self._pose = moved
        return self._result(stamp_ns, status, stats, reason)

    def _remember_points(
        self, matches: LoopMatches, motion: Motion, left: CameraView, camera: StereoCamera
    ) -> None:
        pixels = matches.left[motion.inliers]
        points = camera.triangulate(pixels, matches.right[motion.inliers])
        x, y = np.rint(pixels).astype(np.intp).T
        height, width = left.image.shape
        intensity = left.image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        seen = np.isfinite(points[:, 2])
        self._map = PointCloud(
            transform_points(self._pose.T_world_rig, points[seen]).astype(np.float32),
            intensity[seen].astype(np.float32),
        )

    def _result(
        self, stamp_ns: int, status: TrackingStatus, stats: TrackStats, reason: str
    ) -> OdometryResult:
        stats = replace(stats, stage_ms=self._timer.take())
        if status is TrackingStatus.LOST:
            return OdometryResult(
                stamp_ns, status, None, None, stats=stats, reason=reason,
                reset_counter=self._status.reset_counter,
            )  # fmt: skip
        twist_covariance = self._twist_covariance
        if status is TrackingStatus.GAP:
            unseen_s = self._status.unseen_s(stamp_ns)
            twist_covariance = twist_covariance + coasting_twist_covariance(unseen_s)
        return OdometryResult(
            stamp_ns,
            status,
            self._pose.T_world_rig,
            self._pose.covariance,
            twist=self._prior.twist if self._prior.twist is not None else np.zeros(6),
            twist_covariance=twist_covariance,
            stats=stats,
            reason=reason,
            reset_counter=self._status.reset_counter,
        )
