"""Direct odometry with a rectified stereo pair, of two thermal cameras or any other two.

After Stereo DSO (Wang, Schwoerer & Cremers, ICCV 2017): points take their depth from the other eye
of their keyframe, frames are aligned with all points of a window of keyframes, and the window is
adjusted on the brightness of both eyes while the next image is on its way.  A patch may be off in
brightness as a whole, for shading stays with the sensor.  Old keyframes leave with their points and
what those say of the others stays as a prior; the oldest that is left is held.
"""

from __future__ import annotations

from concurrent.futures import Future, wait
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.direct.frame_tracker import (
    FrameTracker,
    Pyramids,
    Tracked,
    starts_around,
)
from thermal_stereo_vo.odometry.direct.gradient_pyramid import (
    BrightnessUnit,
    build_gradient_pyramid,
)
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    RHO_MIN,
    PhotometricSolution,
    adjust_photometrically,
)
from thermal_stereo_vo.odometry.direct.photometric_config import PhotometricConfig
from thermal_stereo_vo.odometry.direct.photometric_window import PhotometricWindow, PointSet
from thermal_stereo_vo.odometry.direct.point_selection import SelectionConfig, select_points
from thermal_stereo_vo.odometry.direct.rig import Rig
from thermal_stereo_vo.odometry.direct.static_stereo import find_disparities
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import blindness
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.gyro import GyroIntegrator
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.odometry_state import OdometryState, with_reasons, with_stages
from thermal_stereo_vo.odometry.status_machine import StatusConfig
from thermal_stereo_vo.odometry.workers import make_worker, outcome, timed

_ROLES = (LEFT, RIGHT)
_OVERSAMPLING = 1.5
_LEAST_USABLE_SHARE = 0.05


@dataclass(frozen=True)
class DirectKeyframeConfig:
    """When a frame becomes a keyframe, and how keyframes are adjusted."""

    inlier_share: float = setting(
        0.75,
        "A keyframe is due when fewer of the newest keyframe's points still fit.",
        minimum=0.0,
        maximum=1.0,
    )
    parallax_px: float = setting(
        12.0,
        "A keyframe is due when points have moved this far by translation.",
        unit="px",
        minimum=1.0,
        maximum=500.0,
    )
    max_disparity_px: float = setting(
        160.0, "Largest disparity of a new point.", unit="px", minimum=8.0, maximum=2000.0
    )
    bundle_iterations: int = setting(
        6, "Most iterations of a photometric adjustment (DSO).", minimum=1, maximum=100
    )


@dataclass(frozen=True)
class StereoPhotometricConfig(PhotometricConfig):
    """How brightness is compared between the eyes, and over time."""

    patch_offset: float = setting(
        1.5,
        "How far the brightness of a patch may be off as a whole (1 sigma), relative to the noise "
        "of a pixel: shading of the optics stays with the sensor while the scene moves on.",
        minimum=0.0,
        maximum=100.0,
    )
    marginal_weight: float = setting(
        1.0,
        "What the residuals of a keyframe that leaves the window count from then on (marginalised, "
        "with first-estimate Jacobians); 0 forgets them.",
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class DirectConfig:
    """Direct odometry."""

    photometric: StereoPhotometricConfig = group(
        StereoPhotometricConfig, "How brightness is compared."
    )
    selection: SelectionConfig = group(SelectionConfig, "Which pixels become points.")
    keyframes: DirectKeyframeConfig = group(DirectKeyframeConfig, "When a frame is kept.")
    covariance_scale: float = setting(
        1.0,
        "Factor on covariances for what the residuals do not show.",
        minimum=0.01,
        maximum=1000.0,
    )


class StereoDirectOdometry:
    """Photometric tracking against keyframes with photometric bundle adjustment."""

    # The 8-bit view is for people: the method itself compares the counts.
    requirements = Requirements(roles=_ROLES, rectified_pair=True, display=True)

    def __init__(
        self,
        config: DirectConfig,
        status: StatusConfig,
        keyframes: int,
        threads: int = 2,
        gyro: GyroIntegrator | None = None,
    ) -> None:
        self._settings = (config, status, keyframes, threads)
        self._config = config
        self._room = keyframes
        self._worker = make_worker(threads, "odometry")
        self._tracker = FrameTracker(config.photometric)
        self._timer = StageTimer()
        self._state = OdometryState(status, np.eye(4), gyro)
        self._bundle: Future[tuple[PhotometricSolution | None, float]] | None = None
        self._forget()

    def warm_up(self) -> None:
        """Run small synthetic frames through every kernel, in an instance of its own."""
        throw_away = StereoDirectOdometry(*self._settings)
        for i, dtype in enumerate((np.uint8, np.uint16, np.uint8, np.uint16)):
            if i == 2:
                throw_away.reset(np.eye(4))
            throw_away._keyframe_count = 10**6  # every frame becomes a keyframe
            throw_away.process(synthetic_pair(i * 100_000_000, dtype))

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._state.restart(T_world_rig)
        self._forget()

    def _forget(self) -> None:
        if self._bundle is not None:
            wait([self._bundle])  # what it finds, or raises, is of no use any more
        self._bundle = None
        self._unit: BrightnessUnit | None = None
        self._window: PhotometricWindow | None = None
        self._keyframe_count = 0
        self._bundle_points: PointSet | None = None
        self._brightness = np.zeros((2, 2))
        self._last_measured = self._state.pose
        self._last_measured_ns = 0
        self._tracked: Tracked | None = None

    def local_map(self) -> PointCloud:
        """The points that the last frame saw."""
        if self._window is None or self._tracked is None:
            return PointCloud.empty()
        points = self._tracked.points.take(np.flatnonzero(self._tracked.fits))
        return PointCloud(
            self._window.positions_m(points).astype(np.float32), self._window.intensities(points)
        )

    def process(self, frame: RigFrame) -> OdometryResult:
        """Align with the window; make a keyframe when the view has changed."""
        self._state.advance(frame.stamp_ns, by_bolometer=frame.has_counts)
        failure = "" if self._window is None else self._finish_bundle(self._window)
        if not frame.views:
            self._tracked = None
            result = self._state.unmeasured(TrackStats(), blindness(frame))
        elif self._window is None:
            result = self._start(frame)
        else:
            result = self._track(self._window, frame)
        return with_stages(with_reasons(result, failure), self._timer.take())

    # --- tracking ---------------------------------------------------------------------------------

    def _track(self, window: PhotometricWindow, frame: RigFrame) -> OdometryResult:
        pyramids = self._pyramids(frame)
        T_start = inverse(self._state.predicted())
        with self._timer.stage("align"):
            tracked = self._tracker.track(window, pyramids, T_start, self._brightness)
        if tracked is None:
            with self._timer.stage("search"):
                starts = starts_around(T_start, inverse(self._last_measured.T_world_rig))
                tracked = self._tracker.search(window, pyramids, starts, self._brightness)
        self._tracked = tracked
        if tracked is not None:
            return self._measured(window, frame, pyramids, tracked)
        result = self._state.unmeasured(TrackStats(), "the image does not fit the keyframes")
        if result.status is TrackingStatus.LOST and len(frame.views) == 2:
            # Nothing of the window is in sight any more: go on from where the rig was lost.
            self._begin_window(frame)
        return result

    def _measured(
        self,
        window: PhotometricWindow,
        frame: RigFrame,
        pyramids: Pyramids,
        tracked: Tracked,
    ) -> OdometryResult:
        newest = window.poses.newest_pose()
        covariance = self._config.covariance_scale * tracked.covariance
        pose = newest.moved(tracked.T_rig_world @ newest.T_world_rig, covariance)
        self._brightness = tracked.brightness
        window.note_tracking(tracked.points, tracked.seen, tracked.fits)
        both_eyes = all(pyramid is not None for pyramid in pyramids)
        is_keyframe = both_eyes and self._keyframe_is_due(window, tracked)
        stats = TrackStats(
            features=len(tracked.points),
            matches=int(tracked.seen.sum()),
            inliers=tracked.count,
            iterations=tracked.iterations,
            keyframe=is_keyframe,
        )
        T_now_before = inverse(pose.T_world_rig) @ self._last_measured.T_world_rig
        elapsed_s = (frame.stamp_ns - self._last_measured_ns) * 1e-9
        result = self._state.measured(pose, T_now_before, covariance, elapsed_s, stats)
        self._last_measured, self._last_measured_ns = pose, frame.stamp_ns
        if is_keyframe:
            with self._timer.stage("keyframe"):
                self._add_keyframe(window, frame, pyramids, tracked)
        return result

    def _pyramids(self, frame: RigFrame) -> Pyramids:
        unit = self._unit
        assert unit is not None
        smoothing_px = self._config.photometric.smoothing_px

        def build(view: CameraView | None) -> tuple[NDArray[np.float32], ...] | None:
            if view is None or not _usable(view):
                return None
            return build_gradient_pyramid(view.image, smoothing_px, unit)

        with self._timer.stage("pyramid"):
            future = self._worker.submit(build, frame.views.get(RIGHT))
            return build(frame.views.get(LEFT)), future.result()

    # --- keyframes --------------------------------------------------------------------------------

    def _keyframe_is_due(self, window: PhotometricWindow, tracked: Tracked) -> bool:
        config = self._config.keyframes
        if tracked.count < config.inlier_share * self._keyframe_count:
            return True
        mine = tracked.fits & (tracked.points.hosts == window.poses.newest)
        if int(mine.sum()) < self._config.photometric.min_inliers:
            return True
        points = tracked.points.take(np.flatnonzero(mine))
        return window.flow_px(points, tracked.T_rig_world)[1] > config.parallax_px

    def _add_keyframe(
        self,
        window: PhotometricWindow,
        frame: RigFrame,
        pyramids: Pyramids,
        tracked: Tracked | None,
    ) -> None:
        """Take the frame into the window, give it new points, start the adjustment."""
        config = self._config
        left, right = pyramids
        if left is None or right is None:
            return
        occupied_px = np.zeros((0, 2))
        covariance = np.zeros((6, 6))
        if tracked is not None:
            fitting = tracked.points.take(np.flatnonzero(tracked.fits))
            occupied_px = window.pixels_in(fitting, 0, tracked.T_rig_world)
            occupied_px = occupied_px[np.isfinite(occupied_px[:, 0])]
            covariance = config.covariance_scale * tracked.covariance
        view = frame.views[LEFT]
        camera = StereoCamera.of(view, frame.views[RIGHT])
        shift_px = camera.cx - camera.cx_right
        pixels = select_points(left[0], occupied_px, view.mask, config.selection, _OVERSAMPLING)
        disparity, _ = find_disparities(
            left, right, pixels, shift_px, shift_px + config.keyframes.max_disparity_px
        )
        good = np.isfinite(disparity)
        pixels, disparity = pixels[good], disparity[good]
        if tracked is None:
            self._brightness[1] = _relative_brightness(left, right, pixels, disparity)
        if window.poses.is_full:
            window.marginalise(window.poses.order[0], config.photometric)
        slot = window.add_keyframe(self._state.pose, covariance, pyramids, self._brightness)
        focal_baseline = camera.fx * camera.baseline_m
        rhos = np.maximum((disparity - shift_px) / focal_baseline, RHO_MIN)
        slope = left[0][pixels[:, 1], pixels[:, 0], 1].astype(np.float64)
        information = 4.0 * (focal_baseline * slope) ** 2
        counts = view.image[pixels[:, 1], pixels[:, 0]]
        window.add_points(slot, 0, left, pixels, rhos, information, counts)
        self._keyframe_count = len(pixels) + len(occupied_px)
        self._begin_bundle(window)

    def _begin_bundle(self, window: PhotometricWindow) -> None:
        if len(window.poses.order) < 2:
            return
        config = self._config
        problem, self._bundle_points = window.problem()
        self._bundle = self._worker.submit(
            timed,
            adjust_photometrically,
            problem,
            huber=config.photometric.huber,
            gate=config.photometric.gate,
            iterations=config.keyframes.bundle_iterations,
        )

    def _finish_bundle(self, window: PhotometricWindow) -> str:
        """Wait for the adjustment that the last frame started, and take it over.

        It is always taken over just before the next frame, however fast it was: timing must not
        change results.  One that failed leaves the window as it is, and the next keyframe has
        another try; returns why, else nothing.
        """
        bundle, self._bundle = self._bundle, None
        if bundle is None:
            return ""
        with self._timer.stage("wait for bundle"):
            done, failure = outcome(bundle, "the adjustment of the keyframes")
        if done is None:
            return failure
        solution, spent_ms = done
        self._timer.add("bundle", spent_ms)
        points = self._bundle_points
        if solution is not None and points is not None:
            window.apply(
                solution,
                points,
                self._config.photometric.gate,
                self._config.covariance_scale,
            )
            self._brightness = window.brightness[window.poses.newest].copy()
            # The last frame was that keyframe: the pose goes on from where it is now known to be.
            self._state.pose = self._last_measured = window.poses.newest_pose()
        return ""

    # --- start and recovery -----------------------------------------------------------------------

    def _start(self, frame: RigFrame) -> OdometryResult:
        if len(frame.views) < 2:
            return self._state.unmeasured(TrackStats(), blindness(frame))
        self._begin_window(frame)
        if self._window is None:
            return self._state.unmeasured(TrackStats(), "too few points with a depth to start from")
        points = len(self._window.points())
        if self._state.is_lost:
            return self._state.unmeasured(TrackStats(features=points), "starting again")
        return self._state.started(TrackStats(features=points, keyframe=True))

    def _begin_window(self, frame: RigFrame) -> None:
        """Begin a new window with this frame, at the pose of the state."""
        left, right = frame.views[LEFT], frame.views[RIGHT]
        self._window = None
        self._unit = BrightnessUnit.of(left.image, left.mask)
        if self._unit is None:
            return
        capacity = 4 * self._config.selection.points
        photometric = self._config.photometric
        window = PhotometricWindow(
            self._room,
            capacity,
            Rig.of([left, right]),
            photometric.trust_gradient,
            photometric.patch_offset,
        )
        self._state.prior.forget()
        self._brightness = np.zeros((2, 2))
        self._last_measured, self._last_measured_ns = self._state.pose, frame.stamp_ns
        self._add_keyframe(window, frame, self._pyramids(frame), None)
        if len(window.points()) >= 2 * self._config.photometric.min_inliers:
            self._window = window


def _usable(view: CameraView) -> bool:
    return view.mask is None or float(view.mask.mean()) > _LEAST_USABLE_SHARE


def _relative_brightness(
    left: tuple[NDArray[np.float32], ...],
    right: tuple[NDArray[np.float32], ...],
    pixels: NDArray[np.int64],
    disparity: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(2,) a and b of the right image when those of the left are zero, from matched points."""
    if len(pixels) < 10:
        return np.zeros(2)
    x, y = pixels.T
    seen_x = np.clip(np.rint(x - disparity).astype(int), 0, right[0].shape[1] - 1)
    one = left[0][y, x, 0].astype(np.float64)
    other = right[0][y, seen_x, 0].astype(np.float64)
    spread_one = float(np.subtract(*np.percentile(one, [75, 25])))
    spread_other = float(np.subtract(*np.percentile(other, [75, 25])))
    gain = spread_other / spread_one if spread_one > 0.0 and spread_other > 0.0 else 1.0
    gain = float(np.clip(gain, 0.5, 2.0))
    return np.array([np.log(gain), float(np.median(other - gain * one))])
