"""The odometry of P1 (Mouats et al. 2015): each stereo frame against the one before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.frames import CameraView, GapReason, RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig, FeatureMatcher
from thermal_stereo_vo.odometry.feature_based.fixed_pattern import on_fixed_pattern
from thermal_stereo_vo.odometry.feature_based.loop_matching import LoopMatches, StereoFeatures
from thermal_stereo_vo.odometry.feature_based.motion import Motion
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.gyro import GyroIntegrator
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.odometry_state import OdometryState, with_stages
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig
from thermal_stereo_vo.odometry.workers import make_worker


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
        self,
        config: FeatureConfig,
        status: StatusConfig,
        solver: str,
        seed: int,
        threads: int = 2,
        gyro: GyroIntegrator | None = None,
    ) -> None:
        self._settings = (config, status, solver, seed, threads)
        worker = make_worker(threads, "odometry")
        self._matcher = FeatureMatcher(config, solver, worker, seed)
        self._timer = StageTimer()
        self._state = OdometryState(status, np.eye(4), gyro)
        self._forget()

    def warm_up(self) -> None:
        """Run small synthetic frames through every kernel, in an instance of its own."""
        throw_away = FrameToFrameOdometry(*self._settings)
        for i in range(3):
            throw_away.process(synthetic_pair(i * 100_000_000))

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._state.restart(T_world_rig)
        self._forget()

    def _forget(self) -> None:
        self._matcher.reset()
        self._reference: _Reference | None = None
        self._map = PointCloud.empty()

    def local_map(self) -> PointCloud:
        """The inliers of the last measurement."""
        return self._map

    def process(self, frame: RigFrame) -> OdometryResult:
        """Match against the last good frame and move on."""
        self._state.advance(frame.stamp_ns, by_bolometer=frame.has_counts)
        left, right = frame.views.get(LEFT), frame.views.get(RIGHT)
        if left is None or right is None:
            return self._state.unmeasured(TrackStats(), blindness(frame))
        camera = StereoCamera.of(left, right)
        with self._timer.stage("extract"):
            features = self._matcher.extract(left, right)
        stats = TrackStats(features=len(features.left))
        if self._reference is None:
            result = self._start(frame.stamp_ns, features, camera, stats)
        else:
            result = self._track(frame.stamp_ns, features, self._reference, left, camera, stats)
        return with_stages(result, self._timer.take())

    def _start(
        self, stamp_ns: int, features: StereoFeatures, camera: StereoCamera, stats: TrackStats
    ) -> OdometryResult:
        with self._timer.stage("match"):
            if not self._matcher.sees_enough(features, camera):
                return self._state.unmeasured(stats, "too few points with a depth to start from")
        self._reference = _Reference(features, self._state.pose, stamp_ns)
        return self._state.started(stats)

    def _track(
        self,
        stamp_ns: int,
        features: StereoFeatures,
        reference: _Reference,
        left: CameraView,
        camera: StereoCamera,
        stats: TrackStats,
    ) -> OdometryResult:
        state = self._state
        elapsed_s = (stamp_ns - reference.stamp_ns) * 1e-9
        found = None
        if state.prior.twist is not None:
            found = self._measure(features, reference, camera, state.predicted_motion(elapsed_s))
        if found is None:
            found = self._measure(features, reference, camera, None)
        if found is None:
            result = state.unmeasured(stats, "too few matches agree on a motion")
            if result.status is TrackingStatus.LOST:
                # Nothing of the old reference is in sight any more: go on from here.
                self._reference = _Reference(features, state.pose, stamp_ns)
                state.prior.forget()
            return result
        motion, matches = found
        pose = reference.pose.moved(motion.T_current_previous, motion.covariance)
        self._reference = _Reference(features, pose, stamp_ns)
        self._map = _cloud(matches, motion, left, camera, pose.T_world_rig)
        dy_px = matches.left[motion.inliers, 1] - matches.right[motion.inliers, 1]
        stuck = _stuck(matches, camera, inverse(motion.T_current_previous))
        stats = replace(
            stats,
            matches=len(matches),
            inliers=int(motion.inliers.sum()),
            rms_px=motion.rms_px,
            iterations=motion.solution.iterations,
            evaluations=motion.solution.evaluations,
            epipolar_dy_px=float(np.median(dy_px)),
            zero_flow=int(np.sum(stuck[motion.inliers])),
        )
        return state.measured(pose, motion.T_current_previous, motion.covariance, elapsed_s, stats)

    def _measure(
        self,
        features: StereoFeatures,
        reference: _Reference,
        camera: StereoCamera,
        T_reference_current: NDArray[np.float64] | None,
    ) -> tuple[Motion, LoopMatches] | None:
        with self._timer.stage("match"):
            matches = self._matcher.match(features, reference.features, camera, T_reference_current)
            if T_reference_current is not None:
                stuck = _stuck(matches, camera, T_reference_current)
                matches = matches.take(np.flatnonzero(~stuck)) if np.any(stuck) else matches
        with self._timer.stage("motion"):
            motion = self._matcher.measure(matches, camera, T_reference_current)
        return None if motion is None else (motion, matches)


def blindness(frame: RigFrame) -> str:
    """Why a frame cannot be used, for people."""
    reasons = {role: frame.blind.get(role, GapReason.DROPPED) for role in (LEFT, RIGHT)}
    blind = [f"{role} eye: {reasons[role].value}" for role in reasons if role not in frame.views]
    return ", ".join(blind)


def _stuck(
    matches: LoopMatches, camera: StereoCamera, T_reference_current: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(N,) those that stick to the sensor; a loop on the pattern sticks to that of both eyes."""
    predicted = camera.predict_right(matches.left, matches.right, T_reference_current)
    return on_fixed_pattern(matches.right, matches.previous_right, predicted)


def _cloud(
    matches: LoopMatches,
    motion: Motion,
    left: CameraView,
    camera: StereoCamera,
    T_world_rig: NDArray[np.float64],
) -> PointCloud:
    pixels = matches.left[motion.inliers]
    points = camera.triangulate(pixels, matches.right[motion.inliers])
    x, y = np.rint(pixels).astype(np.intp).T
    height, width = left.image.shape
    intensity = left.image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    seen = np.isfinite(points[:, 2])
    return PointCloud(
        transform_points(T_world_rig, points[seen]).astype(np.float32),
        intensity[seen].astype(np.float32),
    )
