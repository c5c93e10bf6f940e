"""Stereo odometry over a window of keyframes, the default.

Each frame is tracked against the patches of a few keyframes, in both eyes and to a small part of a
pixel; its pose comes from those observations together with the inverse depths of the points
(``frame_pose``).  When the view has changed enough, the frame becomes a keyframe, and all keyframes
of the window are adjusted together (``bundle_adjustment``) while the next image is on its way.
What changed little adds no keyframe, so that nothing drifts at hover.  When patches are lost (a gap,
a fast turn), descriptors find the way back to the newest keyframe.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    BundleSolution,
    adjust_bundle,
)
from thermal_stereo_vo.odometry.feature_based.corners import CornerConfig, find_corners
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig, FeatureMatcher
from thermal_stereo_vo.odometry.feature_based.frame_pose import (
    FramePose,
    mark_inliers,
    prosac_samples,
    ransac_frame_pose,
    refine_frame_pose,
)
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import blindness
from thermal_stereo_vo.odometry.feature_based.image_pyramid import (
    LEVELS,
    Pyramid,
    build_pyramid,
)
from thermal_stereo_vo.odometry.feature_based.inverse_depth import predict_pixels
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow, WindowPoints
from thermal_stereo_vo.odometry.feature_based.loop_matching import StereoFeatures
from thermal_stereo_vo.odometry.feature_based.patch_alignment import (
    align_patches,
    search_disparity,
)
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.odometry_state import OdometryState, with_stages
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate
from thermal_stereo_vo.odometry.status_machine import StatusConfig


@dataclass(frozen=True)
class WindowedConfig:
    """Tracking against keyframes and their joint refinement."""

    corners: CornerConfig = group(CornerConfig, "Which points a keyframe gets.")
    smoothing_px: float = setting(
        0.8, "Sigma of the Gaussian before alignment.", unit="px", minimum=0.0, maximum=5.0
    )
    patch_radius_px: int = setting(
        5, "Half side of the patches (11 x 11).", unit="px", minimum=2, maximum=15
    )
    alignment_iterations: int = setting(
        10, "Most iterations of an alignment on each pyramid level.", minimum=1, maximum=100
    )
    min_correlation: float = setting(
        0.75, "Least correlation of an aligned patch.", minimum=0.0, maximum=1.0
    )
    row_tolerance_px: float = setting(
        1.5, "Largest row difference of the eyes.", unit="px", minimum=0.1, maximum=20.0
    )
    max_disparity_px: float = setting(
        160.0, "Largest disparity.", unit="px", minimum=8.0, maximum=2000.0
    )
    ransac_iterations: int = setting(100, "Most 3-point samples.", minimum=1, maximum=10000)
    inlier_px: float = setting(
        2.0, "Largest residual of an inlier of the samples.", unit="px", minimum=0.1, maximum=50.0
    )
    outlier_sigmas: float = setting(
        4.0, "Residuals beyond this many sigma do not count as seen.", minimum=2.0, maximum=20.0
    )
    sigma_floor_px: float = setting(
        0.1, "Least noise that is assumed.", unit="px", minimum=0.001, maximum=5.0
    )
    radial_trust: float = setting(
        0.25,
        "Tangent of the angle from the optical axis at which the residual calibration error is as "
        "large as the noise of a feature; points further out weigh less. 0 trusts all alike.",
        minimum=0.0,
        maximum=10.0,
    )
    min_inliers: int = setting(12, "Fewer inliers are no measurement.", minimum=6, maximum=1000)
    keyframe_inlier_share: float = setting(
        0.7,
        "A keyframe is due when fewer of the newest keyframe's points are still tracked.",
        minimum=0.0,
        maximum=1.0,
    )
    keyframe_parallax_px: float = setting(
        25.0,
        "A keyframe is due when points have moved this far by translation.",
        unit="px",
        minimum=1.0,
        maximum=500.0,
    )
    bundle_iterations: int = setting(
        8, "Most iterations of a bundle adjustment.", minimum=1, maximum=100
    )
    covariance_scale: float = setting(
        1.0,
        "Factor on covariances for what the residuals do not show.",
        minimum=0.01,
        maximum=100.0,
    )


@dataclass(frozen=True)
class _Tracked:
    """What one frame saw: ``observed`` (N, 4) px of ``points``, inliers among them, its pose."""

    points: WindowPoints
    observed: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    pose: FramePose


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
    ) -> None:
        self._settings = (config, features, status, solver, keyframes, seed)
        self._config = config
        self._status_config = status
        self._keyframes = keyframes
        self._seed = seed
        self._matcher = FeatureMatcher(features, solver, seed)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="odometry")
        self._timer = StageTimer()
        self.reset(np.eye(4))

    def warm_up(self) -> None:
        """Run small synthetic frames through every kernel, in an instance of its own."""
        throw_away = WindowedOdometry(*self._settings)
        for i, dtype in enumerate((np.uint8, np.uint8, np.uint16, np.uint8)):
            throw_away.process(synthetic_pair(i * 100_000_000, dtype))
        throw_away._add_keyframe(synthetic_pair(400_000_000), None)
        throw_away.process(synthetic_pair(500_000_000))
        throw_away._find_back(synthetic_pair(600_000_000))

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._matcher.reset()
        self._rng = np.random.default_rng(self._seed)
        self._state = OdometryState(self._status_config, T_world_rig)
        self._window: KeyframeWindow | None = None
        self._camera: StereoCamera | None = None
        self._keyframe: RigFrame | None = None
        self._keyframe_features: StereoFeatures | None = None
        self._keyframe_count = 0
        self._bundle: Future[BundleSolution | None] | None = None
        self._bundle_index = np.zeros(0, np.int64)
        self._last_pose: PoseEstimate | None = None
        self._last_stamp_ns = 0
        self._tracked: _Tracked | None = None

    def local_map(self) -> PointCloud:
        """The points that the last frame saw."""
        if self._window is None or self._tracked is None:
            return PointCloud.empty()
        points = self._tracked.points.take(np.flatnonzero(self._tracked.inliers))
        return PointCloud(
            self._window.positions_m(points).astype(np.float32), self._window.intensities(points)
        )

    def process(self, frame: RigFrame) -> OdometryResult:
        """Track against the window; make a keyframe when the view has changed."""
        self._state.advance(frame.stamp_ns)
        result = self._process(frame)
        return with_stages(result, self._timer.take())

    def _process(self, frame: RigFrame) -> OdometryResult:
        self._finish_bundle()
        left, right = frame.views.get(LEFT), frame.views.get(RIGHT)
        if left is None and right is None:
            return self._state.unmeasured(TrackStats(), blindness(frame))
        if self._window is None:
            return self._start(frame)
        with self._timer.stage("pyramid"):
            pyramids = self._pyramids(left, right)
        T_predicted = inverse(self._state.predicted())
        tracked = self._track(pyramids, T_predicted)
        if tracked is None and left is not None and right is not None:
            with self._timer.stage("find back"):
                T_found = self._find_back(frame)
            if T_found is not None:
                tracked = self._track(pyramids, T_found)
        self._tracked = tracked
        if tracked is None:
            result = self._state.unmeasured(TrackStats(), "too few points of the keyframes found")
            if result.status is TrackingStatus.LOST:
                # Nothing of the window is in sight any more: go on from where the rig was lost.
                self._restart(frame)
            return result
        return self._measured(frame, pyramids, tracked)

    # --- one frame -------------------------------------------------------------------------------

    def _pyramids(
        self, left: CameraView | None, right: CameraView | None
    ) -> tuple[Pyramid | None, Pyramid | None]:
        def build(view: CameraView | None) -> Pyramid | None:
            return None if view is None else build_pyramid(view.image, self._config.smoothing_px)

        future = self._worker.submit(build, right)
        return build(left), future.result()

    def _track(
        self, pyramids: tuple[Pyramid | None, Pyramid | None], T_start: NDArray[np.float64]
    ) -> _Tracked | None:
        """Look for all points near where ``T_start`` (4, 4) T_camera_world puts them."""
        window, camera, config = self._window, self._camera, self._config
        assert window is not None and camera is not None
        points = window.points()
        if len(points) < config.min_inliers:
            return None
        with self._timer.stage("align"):
            observed, score = self._align(pyramids, points, T_start)
        seen = np.flatnonzero(np.sum(np.isfinite(observed), axis=1) >= 2)
        if len(seen) < config.min_inliers:
            return None
        with self._timer.stage("pose"):
            # Best first for PROSAC; the kernels only ask that hosts come in runs for speed.
            best_first = seen[np.argsort(-score[seen], kind="stable")]
            chosen = points.take(best_first)
            parameters = camera.parameters
            hosts = (window.T_keyframe_world, chosen.hosts, chosen.bearings, chosen.rhos)
            count, T = ransac_frame_pose(
                T_start,
                *hosts,
                observed[best_first],
                parameters,
                prosac_samples(self._rng, len(chosen), config.ransac_iterations),
                config.inlier_px,
                0.999,
            )
            if count < config.min_inliers:
                return None
            inliers = np.zeros(len(points), np.bool_)
            marked = np.empty(len(chosen), np.bool_)
            mark_inliers(
                T, *hosts, observed[best_first], parameters, 2.0 * config.inlier_px, marked
            )
            inliers[best_first[marked]] = True
            return self._refine(points, observed, inliers, T)

    def _refine(
        self,
        points: WindowPoints,
        observed: NDArray[np.float64],
        inliers: NDArray[np.bool_],
        T_start: NDArray[np.float64],
    ) -> _Tracked | None:
        window, camera, config = self._window, self._camera, self._config
        assert window is not None and camera is not None
        index = np.flatnonzero(inliers)
        chosen = points.take(index)
        pose = refine_frame_pose(
            T_start,
            window.T_keyframe_world,
            chosen.hosts,
            chosen.bearings,
            chosen.rhos,
            chosen.rho_information,
            np.ascontiguousarray(observed[index]),
            self._weights(chosen, observed[index]),
            camera.parameters,
            sigma_floor_px=config.sigma_floor_px,
        )
        if pose is None:
            return None
        limit_px = max(config.outlier_sigmas * pose.sigma_px, 3.0 * config.sigma_floor_px)
        # Depth noise adds to the residuals of a pose that was estimated jointly with the depths.
        fits = ~np.any(np.abs(pose.residuals) > 2.0 * limit_px, axis=1)
        inliers = np.zeros(len(points), np.bool_)
        inliers[index[fits]] = True
        if int(inliers.sum()) < config.min_inliers:
            return None
        return _Tracked(points, observed, inliers, pose)

    def _weights(self, points: WindowPoints, observed: NDArray[np.float64]) -> NDArray[np.float64]:
        camera, trust = self._camera, self._config.radial_trust
        assert camera is not None
        if trust == 0.0:
            return np.ones(len(points))
        x = np.where(np.isfinite(observed[:, 0]), observed[:, 0], observed[:, 2])
        y = np.where(np.isfinite(observed[:, 1]), observed[:, 1], observed[:, 3])
        here = ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2
        there = np.sum(points.bearings[:, :2] ** 2, axis=1)
        return np.asarray(1.0 / (1.0 + (here + there) / trust**2))

    def _align(
        self,
        pyramids: tuple[Pyramid | None, Pyramid | None],
        points: WindowPoints,
        T_start: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(N, 4) observations, NaN where a patch was not found, and (N,) correlation."""
        window, camera, config = self._window, self._camera, self._config
        assert window is not None and camera is not None
        predicted = np.full((len(points), 4), np.nan)
        warps = np.tile(np.eye(2), (len(points), 1, 1))
        predict_pixels(
            T_start,
            window.T_keyframe_world,
            points.hosts,
            points.bearings,
            points.rhos,
            camera.parameters,
            float(config.patch_radius_px),
            predicted,
            warps,
        )
        observed = np.full((len(points), 4), np.nan)
        score = np.full(len(points), -1.0)

        def run(part: slice) -> None:
            self._align_part(
                pyramids, points, predicted[part], warps[part], observed[part], score[part], part
            )

        half = len(points) // 2
        future = self._worker.submit(run, slice(half, len(points)))
        run(slice(0, half))
        future.result()
        return observed, score

    def _align_part(
        self,
        pyramids: tuple[Pyramid | None, Pyramid | None],
        points: WindowPoints,
        predicted: NDArray[np.float64],
        warps: NDArray[np.float64],
        observed: NDArray[np.float64],
        score: NDArray[np.float64],
        part: slice,
    ) -> None:
        window, config = self._window, self._config
        assert window is not None
        slots, host_px = points.hosts[part], points.host_px[part]
        n = len(slots)
        found_px, found_score = np.empty((n, 2)), np.empty(n)

        def align(pyramid: Pyramid, start_px: NDArray[np.float64], top_level: int) -> None:
            align_patches(
                window.images.stacks,
                pyramid,
                slots,
                host_px,
                warps,
                np.ascontiguousarray(start_px),
                top_level,
                config.patch_radius_px,
                config.alignment_iterations,
                found_px,
                found_score,
            )

        left, right = pyramids
        right_start, right_top = predicted[:, 2:], LEVELS - 1
        if left is not None:
            align(left, predicted[:, :2], LEVELS - 1)
            good = found_score >= config.min_correlation
            observed[good, :2] = found_px[good]
            score[:] = found_score
            # The eyes move together: what the left eye found tells the right one where to look.
            right_start = np.full((n, 2), np.nan)
            disparity = predicted[:, 0] - predicted[:, 2]
            right_start[good, 0] = found_px[good, 0] - disparity[good]
            right_start[good, 1] = found_px[good, 1]
            right_top = 1
        if right is not None:
            align(right, right_start, right_top)
            good = found_score >= config.min_correlation
            if left is not None:
                row_px = np.abs(found_px[:, 1] - observed[:, 1])
                good &= row_px < config.row_tolerance_px
            else:
                score[:] = found_score
            observed[good, 2:] = found_px[good]

    def _measured(
        self,
        frame: RigFrame,
        pyramids: tuple[Pyramid | None, Pyramid | None],
        tracked: _Tracked,
    ) -> OdometryResult:
        window = self._window
        assert window is not None
        keyframe = window.newest_pose()
        T_camera_keyframe = tracked.pose.T_camera_world @ keyframe.T_world_rig
        covariance = self._config.covariance_scale * tracked.pose.covariance
        pose = keyframe.moved(T_camera_keyframe, covariance)
        searched = np.ones(len(tracked.points), np.bool_)
        if len(frame.views) == 2:
            visible = searched & self._visible(tracked)
            window.note_tracking(
                tracked.points.take(np.flatnonzero(visible)), tracked.inliers[visible], 3
            )
        is_keyframe = len(frame.views) == 2 and self._keyframe_is_due(tracked)
        residuals = tracked.pose.residuals
        both = tracked.observed[tracked.inliers]
        dy_px = both[:, 3] - both[:, 1]
        stats = TrackStats(
            features=len(tracked.points),
            matches=int(np.sum(np.any(np.isfinite(tracked.observed), axis=1))),
            inliers=int(tracked.inliers.sum()),
            rms_px=float(np.sqrt(np.nanmean(residuals**2))),
            epipolar_dy_px=float(np.nanmedian(dy_px)) if np.any(np.isfinite(dy_px)) else 0.0,
            keyframe=is_keyframe,
        )
        before = self._last_pose
        elapsed_s = (frame.stamp_ns - self._last_stamp_ns) * 1e-9
        T_after_before = inverse(pose.T_world_rig) @ (
            self._state.pose.T_world_rig if before is None else before.T_world_rig
        )
        result = self._state.measured(pose, T_after_before, covariance, elapsed_s, stats)
        self._last_pose, self._last_stamp_ns = pose, frame.stamp_ns
        if is_keyframe:
            if stats.inliers < self._status_config.degraded_inliers:
                # A thread of few points would let the adjustment swing old against new: what is
                # measured now stays measured, with its covariance.
                window.clear()
                self._tracked = None
            with self._timer.stage("keyframe"):
                self._add_keyframe(frame, self._tracked, pyramids)
        return result

    def _visible(self, tracked: _Tracked) -> NDArray[np.bool_]:
        """(N,) points whose place lies in the image, so that missing them means something."""
        window, camera = self._window, self._camera
        assert window is not None and camera is not None
        points = tracked.points
        predicted = np.full((len(points), 4), np.nan)
        warps = np.zeros((len(points), 2, 2))
        predict_pixels(
            tracked.pose.T_camera_world, window.T_keyframe_world, points.hosts, points.bearings,
            points.rhos, camera.parameters, 1.0, predicted, warps,
        )  # fmt: skip
        height, width = window.images.stacks[0].shape[1:]
        margin = self._config.patch_radius_px + 2.0
        x, y = predicted[:, 0], predicted[:, 1]
        return (x > margin) & (x < width - margin) & (y > margin) & (y < height - margin)

    # --- keyframes -------------------------------------------------------------------------------

    def _keyframe_is_due(self, tracked: _Tracked) -> bool:
        window, camera, config = self._window, self._camera, self._config
        assert window is not None and camera is not None
        seen = int(tracked.inliers.sum())
        if seen < config.keyframe_inlier_share * self._keyframe_count:
            return True
        # Parallax: what is left of the flow since the newest keyframe without its rotation.
        newest = window.newest
        mine = tracked.inliers & (tracked.points.hosts == newest)
        if int(mine.sum()) < config.min_inliers:
            return True
        points = tracked.points.take(np.flatnonzero(mine))
        T = tracked.pose.T_camera_world @ inverse(window.T_keyframe_world[newest])
        rotated = points.bearings @ T[:3, :3].T
        rotated_px = rotated[:, :2] / rotated[:, 2:] * (camera.fx, camera.fy)
        moved = rotated + points.rhos[:, None] * T[:3, 3]
        moved_px = moved[:, :2] / moved[:, 2:] * (camera.fx, camera.fy)
        parallax_px = float(np.median(np.linalg.norm(moved_px - rotated_px, axis=1)))
        return parallax_px > config.keyframe_parallax_px

    def _add_keyframe(
        self,
        frame: RigFrame,
        tracked: _Tracked | None,
        pyramids: tuple[Pyramid | None, Pyramid | None] | None = None,
    ) -> None:
        """Take the frame into the window, give it new points, start the bundle adjustment."""
        window, config = self._window, self._config
        assert window is not None
        left_view, right_view = frame.views[LEFT], frame.views[RIGHT]
        left, right = pyramids or self._pyramids(left_view, right_view)
        assert left is not None and right is not None
        if tracked is None:
            window.add_keyframe(
                self._state.pose,
                None if not window.order else np.zeros((6, 6)),
                left,
                window.points(),
                np.full((len(window.points()), 4), np.nan),
            )
        else:
            inliers = np.flatnonzero(tracked.inliers)
            window.add_keyframe(
                self._state.pose,
                config.covariance_scale * tracked.pose.covariance,
                left,
                tracked.points.take(inliers),
                tracked.observed[inliers],
            )
        self._add_points(left, right, left_view, tracked)
        self._keyframe, self._keyframe_features = frame, None
        if len(window.order) > 1:
            problem, self._bundle_index = window.bundle_problem(config.radial_trust)
            self._bundle = self._worker.submit(
                adjust_bundle,
                problem,
                sigma_floor_px=config.sigma_floor_px,
                iterations=config.bundle_iterations,
            )

    def _add_points(
        self, left: Pyramid, right: Pyramid, view: CameraView, tracked: _Tracked | None
    ) -> None:
        """Corners where the keyframe has none yet, with the disparity its right eye gives them."""
        window, camera, config = self._window, self._camera, self._config
        assert window is not None and camera is not None
        occupied = np.zeros((0, 2))
        if tracked is not None:
            alive = np.isin(tracked.points.index, window.points().index) & tracked.inliers
            occupied = tracked.observed[alive][:, :2]
            occupied = occupied[np.all(np.isfinite(occupied), axis=1)]
        corners = find_corners(
            left[0], occupied, 2 * config.patch_radius_px + 2, view.mask, config.corners
        )
        n = len(corners)
        disparity, score = np.zeros(n, np.int64), np.zeros(n)
        # One level up the search is four times cheaper, and half as noisy.
        search_disparity(
            left[1],
            right[1],
            corners // 2,
            config.patch_radius_px,
            0,
            int(config.max_disparity_px) // 2,
            disparity,
            score,
        )
        start = corners.astype(np.float64)
        start[:, 0] -= 2.0 * disparity
        start[score < config.min_correlation] = np.nan
        found_px, found_score = np.empty((n, 2)), np.empty(n)
        align_patches(
            window.images.stacks,
            right,
            np.full(n, window.newest, np.int64),
            corners.astype(np.float64),
            np.tile(np.eye(2), (n, 1, 1)),
            start,
            1,
            config.patch_radius_px,
            config.alignment_iterations,
            found_px,
            found_score,
        )
        good = found_score >= config.min_correlation
        good &= np.abs(found_px[:, 1] - corners[:, 1]) < config.row_tolerance_px
        good &= np.abs(found_px[:, 0] - start[:, 0]) < 4.0
        pixels = corners[good]
        intensity = view.image[pixels[:, 1], pixels[:, 0]].astype(np.float32)
        window.add_points(pixels.astype(np.float64), found_px[good, 0], intensity, 1.0)
        self._keyframe_count = len(pixels) + len(occupied)

    def _finish_bundle(self) -> None:
        """Wait for the adjustment that the last keyframe started, and take it over."""
        if self._bundle is None:
            return
        with self._timer.stage("wait for bundle"):
            solution = self._bundle.result()
        self._bundle = None
        window = self._window
        assert window is not None
        if solution is None:
            return
        window.apply(solution, self._bundle_index, self._config.outlier_sigmas)
        # The last frame was that keyframe: the pose goes on from where it is now known to be.
        pose = window.newest_pose()
        self._state.pose = pose
        self._last_pose = pose

    # --- start and recovery ----------------------------------------------------------------------

    def _start(self, frame: RigFrame) -> OdometryResult:
        left, right = frame.views.get(LEFT), frame.views.get(RIGHT)
        if left is None or right is None:
            return self._state.unmeasured(TrackStats(), blindness(frame))
        self._restart(frame)
        window = self._window
        if window is None:
            return self._state.unmeasured(TrackStats(), "too few points with a depth to start from")
        return self._state.started(TrackStats(features=len(window.points()), keyframe=True))

    def _restart(self, frame: RigFrame) -> None:
        """Begin a new window with this frame, at the pose of the state."""
        left, right = frame.views.get(LEFT), frame.views.get(RIGHT)
        if left is None or right is None:
            return
        self._camera = StereoCamera.of(left, right)
        self._window = KeyframeWindow(
            self._keyframes, 4 * self._config.corners.points, left.image.shape, self._camera
        )
        self._state.prior.forget()
        self._last_pose, self._last_stamp_ns = self._state.pose, frame.stamp_ns
        self._add_keyframe(frame, None)
        if len(self._window.points()) < self._config.min_inliers:
            self._window = None

    def _find_back(self, frame: RigFrame) -> NDArray[np.float64] | None:
        """(4, 4) T_camera_world by descriptors against the newest keyframe, or None."""
        window, camera, keyframe = self._window, self._camera, self._keyframe
        assert window is not None and camera is not None and keyframe is not None
        matcher = self._matcher
        if self._keyframe_features is None:
            self._keyframe_features = matcher.extract(keyframe.views[LEFT], keyframe.views[RIGHT])
        features = matcher.extract(frame.views[LEFT], frame.views[RIGHT])
        motion = matcher.measure(
            matcher.match(features, self._keyframe_features, camera, None), camera, None
        )
        if motion is None:
            return None
        return np.asarray(motion.T_current_previous @ window.T_keyframe_world[window.newest])
