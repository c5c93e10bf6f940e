"""Stereo odometry over a window of keyframes, the default.

Each frame is tracked against the patches of a few keyframes, in both eyes and to a small part of a
pixel; its pose comes from those observations together with the inverse depths of the points
(``frame_pose``).  When the view has changed enough, the frame becomes a keyframe: while the next
image is on its way, it gets new points, and all keyframes of the window are adjusted together
(``bundle_adjustment``).
Where nothing moves no keyframe comes, so that nothing drifts at hover.  While one eye is blind the
other goes on alone, with keyframes of its own once the known points leave its picture.  When
patches are lost (a gap, a fast turn), descriptors find the way back to the newest keyframe.
"""

from __future__ import annotations

from concurrent.futures import Future, wait
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import adjoint, inverse
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    BundleSolution,
    adjust_bundle,
)
from thermal_stereo_vo.odometry.feature_based.corners import CornerConfig, find_corners
from thermal_stereo_vo.odometry.feature_based.extrinsics import (
    ExtrinsicsConfig,
    ExtrinsicsRefiner,
)
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig, FeatureMatcher
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import blindness
from thermal_stereo_vo.odometry.feature_based.image_pyramid import Pyramid
from thermal_stereo_vo.odometry.feature_based.keyframe_window import (
    KeyframeWindow,
    WindowPoints,
    positions_m,
)
from thermal_stereo_vo.odometry.feature_based.loop_matching import StereoFeatures
from thermal_stereo_vo.odometry.feature_based.one_eye_keyframe import (
    guess_inverse_depths,
    known_inverse_depths,
    right_eye_pose,
    seen_by_one_eye,
)
from thermal_stereo_vo.odometry.feature_based.patch_tracker import (
    PatchTracker,
    Pyramids,
    Tracked,
    TrackingConfig,
)
from thermal_stereo_vo.odometry.feature_based.stereo_points import find_stereo_points
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.gyro import GyroIntegrator
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.odometry_state import OdometryState, with_reasons, with_stages
from thermal_stereo_vo.odometry.status_machine import StatusConfig
from thermal_stereo_vo.odometry.workers import make_worker, outcome

MOST_MISSES = 3
"""A point that should be in sight but is not found this many times in a row is given up."""
SCARCE = 0.5
"""Share of the points found since a keyframe below which a single eye needs another one: the
fewer such keyframes there are, the longer those of both eyes, which know the scale, are kept."""
STILL_ALIKE = 0.9
"""Share of a keyframe's points above which another frame shows hardly anything new."""


@dataclass(frozen=True)
class _LastView:
    """A frame of both eyes that was measured and is no keyframe (yet)."""

    frame: RigFrame
    pyramids: Pyramids
    tracked: Tracked


@dataclass(frozen=True)
class _Seen:
    """The points that a frame saw, as they were known then: the window goes on meanwhile."""

    points: WindowPoints
    T_keyframe_world: NDArray[np.float64]
    intensity: NDArray[np.float32]


@dataclass(frozen=True)
class _Completed:
    """What became of a keyframe: its number of points, and the adjustment of points ``index``."""

    points: int
    index: NDArray[np.int64]
    bundle: BundleSolution | None


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe, and how keyframes are adjusted."""

    inlier_share: float = setting(
        0.75,
        "A keyframe is due when fewer of the newest keyframe's points are still tracked.",
        minimum=0.0,
        maximum=1.0,
    )
    parallax_px: float = setting(
        15.0,
        "A keyframe is due when points have moved this far by translation.",
        unit="px",
        minimum=1.0,
        maximum=500.0,
    )
    max_disparity_px: float = setting(
        160.0, "Largest disparity of a new point.", unit="px", minimum=8.0, maximum=2000.0
    )
    bundle_iterations: int = setting(
        8, "Most iterations of a bundle adjustment.", minimum=1, maximum=100
    )


@dataclass(frozen=True)
class WindowedConfig:
    """Tracking against keyframes and their joint refinement."""

    corners: CornerConfig = group(CornerConfig, "Which points a keyframe gets.")
    tracking: TrackingConfig = group(TrackingConfig, "How patches are found again.")
    keyframes: KeyframeConfig = group(KeyframeConfig, "When a frame is kept.")
    extrinsics: ExtrinsicsConfig = group(ExtrinsicsConfig, "The rotation between the eyes.")
    covariance_scale: float = setting(
        1.0,
        "Factor on covariances for what the residuals do not show.",
        minimum=0.01,
        maximum=100.0,
    )


class WindowedOdometry:
    """Patch tracking against keyframes with local bundle adjustment."""

    requirements = Requirements(roles=(LEFT, RIGHT), rectified_pair=True, display=True)

    def __init__(
        self,
        config: WindowedConfig,
        features: FeatureConfig,
        status: StatusConfig,
        solver: str,
        keyframes: int,
        seed: int,
        threads: int = 2,
        gyro: GyroIntegrator | None = None,
    ) -> None:
        self._settings = (config, features, status, solver, keyframes, seed, threads)
        self._config = config
        self._status_config = status
        self._room = keyframes
        self._worker = make_worker(threads, "odometry")
        self._tracker = PatchTracker(config.tracking, self._worker, seed)
        self._matcher = FeatureMatcher(features, solver, self._worker, seed)
        self._timer = StageTimer()
        if config.extrinsics.refine:
            left_over = config.extrinsics.scale_share * status.scale_sigma
            status = replace(status, scale_sigma=left_over)
        self._state = OdometryState(status, np.eye(4), gyro)
        self._completion: Future[_Completed] | None = None
        self._forget()

    def warm_up(self) -> None:
        """Run small synthetic frames through every kernel, in an instance of its own."""
        throw_away = WindowedOdometry(*self._settings)
        for i, dtype in enumerate((np.uint8, np.uint16, np.uint8, np.uint16)):
            frame = synthetic_pair(i * 100_000_000, dtype)
            throw_away.process(frame)
            if throw_away._window is not None:
                throw_away._finish_keyframe(throw_away._window)
                throw_away._keyframe_count = 10**6  # every frame becomes a keyframe
                throw_away._find_back(throw_away._window, frame)

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._state.restart(T_world_rig)
        self._forget()

    def _forget(self) -> None:
        if self._completion is not None:
            wait([self._completion])  # what it finds, or raises, is of no use any more
        self._completion = None
        self._failure = ""
        """Why the last work on a keyframe came to nothing, until it is told."""
        self._matcher.reset()
        self._tracker.reset()
        self._extrinsics = ExtrinsicsRefiner(self._config.extrinsics, self._room)
        self._window: KeyframeWindow | None = None
        self._keyframe: RigFrame | None = None
        self._keyframe_slot = 0
        self._newest_is_by_one_eye = False
        self._most_inliers = 0
        self._keyframe_features: StereoFeatures | None = None
        self._keyframe_count = 0
        self._last_measured = self._state.pose
        self._last_measured_ns = 0
        self._last_covariance = np.zeros((6, 6))
        self._tracked: Tracked | None = None
        self._seen: _Seen | None = None
        self._last_view: _LastView | None = None

    def local_map(self) -> PointCloud:
        """The points that the last frame saw."""
        seen = self._seen
        if seen is None:
            return PointCloud.empty()
        xyz = positions_m(seen.points, seen.T_keyframe_world)
        return PointCloud(xyz.astype(np.float32), seen.intensity)

    def process(self, frame: RigFrame) -> OdometryResult:
        """Track against the window; make a keyframe when the view has changed."""
        self._state.advance(frame.stamp_ns, by_bolometer=frame.has_counts)
        self._seen = None
        if self._window is not None:
            self._finish_keyframe(self._window)
            if len(frame.views) < 2:
                self._keep_last_view(self._window)
        if not frame.views:
            self._tracked = None
            result = self._state.unmeasured(TrackStats(), blindness(frame))
        elif self._window is None:
            result = self._start(frame)
        else:
            result = self._track(self._window, frame)
        failure, self._failure = self._failure, ""
        return with_stages(with_reasons(result, failure), self._timer.take())

    # --- tracking ---------------------------------------------------------------------------------

    def _track(self, window: KeyframeWindow, frame: RigFrame) -> OdometryResult:
        with self._timer.stage("pyramid"):
            pyramids = self._pyramids(frame)
        tracked = self._look(window, pyramids, inverse(self._state.predicted()))
        if tracked is None and len(frame.views) == 2:
            with self._timer.stage("find back"):
                T_found = self._find_back(window, frame)
            if T_found is not None:
                tracked = self._look(window, pyramids, T_found)
        if tracked is None and len(frame.views) == 2:
            tracked, frame = self._look_with_one_eye(window, frame, pyramids)
        if tracked is not None and len(frame.views) < 2 and self._is_worse_than_guessed(tracked):
            tracked = None
        if tracked is not None and self._tracked is None:
            tracked = self._look_again(window, pyramids, tracked)
        self._tracked = tracked
        if tracked is not None:
            return self._measured(window, frame, pyramids, tracked)
        self._last_view = None
        result = self._state.unmeasured(TrackStats(), "too few points of the keyframes found")
        if len(frame.views) == 2:
            if result.status is TrackingStatus.LOST:
                # Nothing of the window was found for long: go on from where the rig was lost.
                self._state.prior.forget()
                self._begin_window(frame)
            elif self._is_out_of_sight(window):
                # Nothing of the window can be found any more: go on from the prediction.
                self._begin_window(frame)
        return result

    def _look_again(self, window: KeyframeWindow, pyramids: Pyramids, tracked: Tracked) -> Tracked:
        """After a gap the prediction is poor and loses many points: look from where the rig is."""
        again = self._look(window, pyramids, tracked.pose.T_camera_world)
        return again if again is not None and again.count > tracked.count else tracked

    def _look_with_one_eye(
        self, window: KeyframeWindow, frame: RigFrame, pyramids: Pyramids
    ) -> tuple[Tracked | None, RigFrame]:
        """Something may cover one lens unnoticed: the frame then counts as one of the other eye."""
        T_predicted = inverse(self._state.predicted())
        for role, alone in ((LEFT, (pyramids[0], None)), (RIGHT, (None, pyramids[1]))):
            tracked = self._look(window, alone, T_predicted)
            if tracked is not None:
                return tracked, replace(frame, views={role: frame.views[role]})
        return None, frame

    def _is_worse_than_guessed(self, tracked: Tracked) -> bool:
        """Whether the motion since the last measurement is better foretold than measured.

        With one eye, once most points have left the picture, the rest leave the position open.
        """
        foretold = self._last_covariance + self._state.foretold_covariance()
        measured = tracked.pose.covariance
        return bool(np.trace(measured[:3, :3]) > np.trace(foretold[:3, :3]))

    def _is_out_of_sight(self, window: KeyframeWindow) -> bool:
        """Whether the window has no more for a sound pose at the predicted one."""
        in_sight = window.count_in_sight(inverse(self._state.pose.T_world_rig))
        return in_sight < self._status_config.degraded_inliers

    def _look(
        self, window: KeyframeWindow, pyramids: Pyramids, T_start: NDArray[np.float64]
    ) -> Tracked | None:
        with self._timer.stage("align"):
            points, observed, score = self._tracker.align(window, pyramids, T_start)
        with self._timer.stage("pose"):
            return self._tracker.locate(window, points, observed, score, T_start)

    def _measured(
        self, window: KeyframeWindow, frame: RigFrame, pyramids: Pyramids, tracked: Tracked
    ) -> OdometryResult:
        newest = window.newest_pose()
        covariance = self._config.covariance_scale * tracked.pose.covariance
        pose = newest.moved(tracked.pose.T_camera_world @ newest.T_world_rig, covariance)
        both_eyes = len(frame.views) == 2
        if both_eyes:
            window.note_tracking(
                tracked.points, tracked.inliers, tracked.pose.T_camera_world, MOST_MISSES
            )
        self._most_inliers = max(self._most_inliers, tracked.count)
        if both_eyes:
            # Depths that were guessed with one eye are measured as soon as both see again.
            is_keyframe = self._newest_is_by_one_eye or self._keyframe_is_due(window, tracked)
        else:
            is_keyframe = self._one_eye_keyframe_is_due(window, frame, tracked)
        stats = TrackStats(
            features=len(tracked.points),
            matches=int(np.sum(np.any(np.isfinite(tracked.observed), axis=1))),
            inliers=tracked.count,
            rms_px=float(np.sqrt(np.nanmean(tracked.pose.residuals**2))),
            epipolar_dy_px=tracked.epipolar_dy_px(),
            right_turn_mrad=self._extrinsics.turn_mrad,
            zero_flow=tracked.zero_flow(window),
            keyframe=is_keyframe,
        )
        T_now_before = inverse(pose.T_world_rig) @ self._last_measured.T_world_rig
        elapsed_s = (frame.stamp_ns - self._last_measured_ns) * 1e-9
        result = self._state.measured(pose, T_now_before, covariance, elapsed_s, stats)
        self._last_measured, self._last_measured_ns = pose, frame.stamp_ns
        self._last_covariance = tracked.pose.covariance
        self._last_view = _LastView(frame, pyramids, tracked) if both_eyes else None
        seen = tracked.points.take(np.flatnonzero(tracked.inliers))
        self._seen = _Seen(seen, window.T_keyframe_world.copy(), window.intensities(seen))
        if is_keyframe and not both_eyes:
            with self._timer.stage("keyframe"):
                self._add_one_eye_keyframe(window, frame, pyramids, tracked)
        elif is_keyframe:
            if tracked.count < self._status_config.degraded_inliers:
                # A thread of few points would let the adjustment swing old against new: what is
                # measured now stays measured, with its covariance.
                window.clear()
                self._tracked = None
            with self._timer.stage("keyframe"):
                self._add_keyframe(window, frame, pyramids, self._tracked)
        return result

    def _pyramids(self, frame: RigFrame) -> Pyramids:
        return self._tracker.pyramids(frame.views.get(LEFT), frame.views.get(RIGHT))

    # --- keyframes --------------------------------------------------------------------------------

    def _keyframe_is_due(self, window: KeyframeWindow, tracked: Tracked) -> bool:
        config = self._config.keyframes
        if tracked.count < config.inlier_share * self._keyframe_count:
            return True
        mine = tracked.inliers & (tracked.points.hosts == window.newest)
        points = tracked.points.take(np.flatnonzero(mine))
        if len(points) < self._config.tracking.min_inliers:
            return True
        return window.parallax_px(points, tracked.pose.T_camera_world) > config.parallax_px

    def _one_eye_keyframe_is_due(
        self, window: KeyframeWindow, frame: RigFrame, tracked: Tracked
    ) -> bool:
        if LEFT not in frame.views and window.camera.cx != window.camera.cx_right:
            return False  # keyframes have the principal point of the left eye
        enough = tracked.count >= self._status_config.degraded_inliers
        return enough and tracked.count < SCARCE * self._most_inliers

    def _add_keyframe(
        self,
        window: KeyframeWindow,
        frame: RigFrame,
        pyramids: Pyramids,
        tracked: Tracked | None,
    ) -> None:
        """Take the frame into the window; new points and the bundle adjustment come beside."""
        self._last_view = None
        left = pyramids[0]
        assert left is not None
        occupied_px = np.zeros((0, 2))
        if tracked is None:
            window.add_keyframe(self._state.pose, np.zeros((6, 6)), left)
        else:
            inliers = np.flatnonzero(tracked.inliers)
            occupied_px = window.add_keyframe(
                self._state.pose,
                self._config.covariance_scale * tracked.pose.covariance,
                left,
                tracked.points.take(inliers),
                tracked.observed[inliers],
            )
        self._keyframe, self._keyframe_features = frame, None
        self._keyframe_slot, self._newest_is_by_one_eye = window.newest, False
        self._completion = self._worker.submit(self._complete, window, frame, pyramids, occupied_px)

    def _complete(
        self,
        window: KeyframeWindow,
        frame: RigFrame,
        pyramids: Pyramids,
        occupied_px: NDArray[np.float64],
    ) -> _Completed:
        """Give the newest keyframe points of its own and adjust the window.

        No pose waits for it; nothing else touches the window before ``_finish_keyframe``.
        """
        config = self._config
        left, right = pyramids
        assert left is not None
        assert right is not None
        view = frame.views[LEFT]
        pixels, right_x_px = find_stereo_points(
            window,
            left,
            right,
            view.mask,
            occupied_px,
            config.keyframes.max_disparity_px,
            config.corners,
            config.tracking,
        )
        window.add_points(pixels, right_x_px, view.image[pixels[:, 1], pixels[:, 0]])
        count = len(pixels) + len(occupied_px)
        if len(window.order) == 1:
            return _Completed(count, np.zeros(0, np.int64), None)
        problem, index = window.bundle_problem(config.tracking.radial_trust)
        solution = adjust_bundle(
            problem,
            sigma_floor_px=config.tracking.sigma_floor_px,
            iterations=config.keyframes.bundle_iterations,
        )
        return _Completed(count, index, solution)

    def _add_one_eye_keyframe(
        self, window: KeyframeWindow, frame: RigFrame, pyramids: Pyramids, tracked: Tracked
    ) -> None:
        """Take a frame of one eye into the window, as seen from where that eye is.

        It stays where it was measured until the next adjustment: by itself an eye knows no scale.
        """
        T_eye_left = np.eye(4) if LEFT in frame.views else right_eye_pose(window)
        pyramid = pyramids[0] if LEFT in frame.views else pyramids[1]
        assert pyramid is not None
        known = known_inverse_depths(window, tracked, T_eye_left @ tracked.pose.T_camera_world)
        inliers = np.flatnonzero(tracked.inliers)
        Ad = adjoint(T_eye_left)
        occupied_px = window.add_keyframe(
            self._state.pose.moved(T_eye_left, np.zeros((6, 6))),
            self._config.covariance_scale * Ad @ tracked.pose.covariance @ Ad.T,
            pyramid,
            tracked.points.take(inliers),
            seen_by_one_eye(tracked.observed[inliers]),
        )
        self._newest_is_by_one_eye = True
        if self._keyframe_slot == window.newest:
            self._keyframe = None
        self._completion = self._worker.submit(
            self._complete_one_eye, window, frame, pyramid, occupied_px, known
        )

    def _complete_one_eye(
        self,
        window: KeyframeWindow,
        frame: RigFrame,
        pyramid: Pyramid,
        occupied_px: NDArray[np.float64],
        known: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> _Completed:
        """Give the newest keyframe points at guessed depths."""
        role, view = next(iter(frame.views.items()))
        border_px = 2 * self._config.tracking.patch_radius_px + 2
        pixels = find_corners(pyramid[0], occupied_px, border_px, view.mask, self._config.corners)
        rhos, sigmas = guess_inverse_depths(*known, pixels)
        intensity = view.image[pixels[:, 1], pixels[:, 0]]
        window.add_guessed_points(pixels, rhos, sigmas, intensity, eye=(LEFT, RIGHT).index(role))
        return _Completed(len(pixels) + len(occupied_px), np.zeros(0, np.int64), None)

    def _keep_last_view(self, window: KeyframeWindow) -> None:
        """Make a keyframe of the last good frame, as an eye is blind now.

        Nothing nearer to what the eyes will see after the gap is to be had.
        """
        last = self._last_view
        self._last_view = None
        if last is None or last.tracked.count >= STILL_ALIKE * self._keyframe_count:
            return
        with self._timer.stage("keyframe"):
            self._add_keyframe(window, last.frame, last.pyramids, last.tracked)
        self._finish_keyframe(window)

    def _finish_keyframe(self, window: KeyframeWindow) -> None:
        """Wait for the points and the adjustment that the last frame started, and take them over.

        It is always taken over just before the next frame, however fast it was: timing must not
        change results.  Where it failed, the keyframe stays where it was measured, with the points
        it has got; one without points of its own is followed by another at once.
        """
        completion, self._completion = self._completion, None
        if completion is None:
            return
        with self._timer.stage("wait for keyframe"):
            completed, failure = outcome(completion, "the work on the newest keyframe")
        if completed is None:
            self._failure = failure
            self._keyframe_count = int(np.isfinite(window.seen_by_newest()[:, 0]).sum())
            return
        self._keyframe_count, self._most_inliers = completed.points, 0
        solution = completed.bundle
        if solution is not None:
            covariance = self._config.covariance_scale * solution.covariance
            solution = replace(solution, covariance=covariance)
            window.apply(solution, completed.index, self._config.tracking.outlier_sigmas)
            self._extrinsics.learn(window, solution)
            window.right_turn_rad = self._extrinsics.turn_rad
            # The last frame was that keyframe: the pose goes on from where it is now known to be.
            self._state.pose = self._last_measured = window.newest_pose()

    # --- start and recovery -----------------------------------------------------------------------

    def _start(self, frame: RigFrame) -> OdometryResult:
        if len(frame.views) < 2:
            return self._state.unmeasured(TrackStats(), blindness(frame))
        self._begin_window(frame)
        if self._window is None:
            return self._state.unmeasured(TrackStats(), "too few points with a depth to start from")
        points = len(self._window.points())
        if self._state.status is TrackingStatus.INITIALISING:
            return self._state.started(TrackStats(features=points, keyframe=True))
        return self._state.unmeasured(TrackStats(features=points), "starting again")

    def _begin_window(self, frame: RigFrame) -> None:
        """Begin a new window with this frame, at the pose of the state."""
        left, right = frame.views[LEFT], frame.views[RIGHT]
        camera = StereoCamera.of(left, right)
        capacity = 4 * self._config.corners.points
        window = KeyframeWindow(self._room, capacity, left.image.shape, camera)
        window.right_turn_rad = self._extrinsics.turn_rad
        self._last_measured, self._last_measured_ns = self._state.pose, frame.stamp_ns
        self._add_keyframe(window, frame, self._pyramids(frame), None)
        self._finish_keyframe(window)
        enough = len(window.points()) >= self._config.tracking.min_inliers
        self._window = window if enough else None

    def _find_back(self, window: KeyframeWindow, frame: RigFrame) -> NDArray[np.float64] | None:
        """(4, 4) T_camera_world by descriptors against the newest keyframe, or None."""
        if self._keyframe is None:
            return None
        matcher = self._matcher
        if self._keyframe_features is None:
            views = self._keyframe.views
            self._keyframe_features = matcher.extract(views[LEFT], views[RIGHT])
        features = matcher.extract(frame.views[LEFT], frame.views[RIGHT])
        matches = matcher.match(features, self._keyframe_features, window.camera, None)
        motion = matcher.measure(matches, window.camera, None)
        if motion is None:
            return None
        return np.asarray(motion.T_current_previous @ window.T_keyframe_world[self._keyframe_slot])
