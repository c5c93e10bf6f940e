"""Direct odometry with a visible and a thermal camera, without matching one against the other.

After Dai et al. (2019): each camera follows points in its own images.  The first one alone makes a
map of unknown size; how the second one moves on its lever arm tells the size.  From then on both
take part alike, and either can go on alone while the other is blind.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.observers import StageTimer
from thermal_stereo_vo.odometry.direct.band_images import BandImages, blindness, usable_roles
from thermal_stereo_vo.odometry.direct.band_map import BandMap, MapUpdate
from thermal_stereo_vo.odometry.direct.frame_tracker import (
    FrameTracker,
    Pyramids,
    Tracked,
    starts_around,
)
from thermal_stereo_vo.odometry.direct.late_cameras import LateCameras
from thermal_stereo_vo.odometry.direct.multispectral_config import MultispectralConfig
from thermal_stereo_vo.odometry.direct.photometric_window import PhotometricWindow
from thermal_stereo_vo.odometry.gyro import GyroIntegrator
from thermal_stereo_vo.odometry.interface import Requirements
from thermal_stereo_vo.odometry.odometry_state import Lag, OdometryState, with_reasons, with_stages
from thermal_stereo_vo.odometry.status_machine import StatusConfig
from thermal_stereo_vo.odometry.workers import make_worker, outcome, timed

_ROLES = (VISIBLE, THERMAL)
_TOP, _SECOND_TOP = 3, 1
_UNKNOWN = 1e6
"""Variance (square of any unit) of lengths whose unit is unknown."""
_TIME_FOR_UPDATE = 2
"""An adjustment has until so many frames after its keyframe."""


class MultispectralOdometry:
    """Photometric tracking in two bands with photometric bundle adjustment.

    With one camera alone, or before the scale is known, lengths are in a unit of about the mean
    distance of the scene at the start; poses are then those of the first camera that is there, in
    axes of the rig.
    """

    requirements = Requirements(roles=_ROLES, rectified_pair=False, display=False)

    def __init__(
        self,
        config: MultispectralConfig,
        status: StatusConfig,
        keyframes: int,
        threads: int = 2,
        gyro: GyroIntegrator | None = None,
        seed: int = 0,
    ) -> None:
        self._settings = (config, status, keyframes, threads)
        self._config = config
        self._room = keyframes
        self._seed = seed
        self._lag_s = 1e-3 * status.bolometer_lag_ms
        self._worker = make_worker(threads, "odometry")
        self._tracker = FrameTracker(config.photometric)
        self._timer = StageTimer()
        exposure = Lag(1e-3 * config.exposure_lag_ms, 1e-3 * config.exposure_lag_sigma_ms)
        self._state = OdometryState(status, np.eye(4), gyro, exposure)
        self._patience_ns = round(1e9 * status.coast_max_s)
        self._update: Future[tuple[MapUpdate | None, float]] | None = None
        self._forget()

    def warm_up(self) -> None:
        """Run small synthetic frames through every kernel, in an instance of its own."""
        from thermal_stereo_vo.odometry.direct.band_warm_up import synthetic_flight

        throw_away = MultispectralOdometry(*self._settings)
        for frame in synthetic_flight():
            throw_away.process(frame)

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""
        self._state.restart(T_world_rig)
        self._forget()

    def _forget(self) -> None:
        self._awaited_update()
        self._rng = np.random.default_rng(self._seed)
        self._images: BandImages | None = None
        self._map: BandMap | None = None
        self._tracked: Tracked | None = None
        self._frame: RigFrame | None = None
        self._twist_before: tuple[NDArray[np.float64], float] | None = None
        self._frames_since = 0
        """Frames since the newest keyframe."""
        self._failure = ""
        """Why the last adjustment found nothing, until it is told."""
        self._contradicts = False
        """Whether the second camera is there and shows something else than its points."""
        self._contradicts_since_ns: int | None = None

    def local_map(self) -> PointCloud:
        """The points that the last frame saw, with what both cameras show of them.

        Those whose distance is no more than guessed stay out.
        """
        if self._map is None or self._tracked is None or self._frame is None:
            return PointCloud.empty()
        shown = self._tracked.fits & self._map.window.are_measured(self._tracked.points)
        points = self._tracked.points.take(np.flatnonzero(shown))
        return self._map.cloud(points, self._frame, self._tracked.T_rig_world)

    def process(self, frame: RigFrame) -> OdometryResult:
        """Align with the window; make a keyframe when the view has changed."""
        # The rig is where its first camera saw it from, which is no bolometer.
        self._state.advance(frame.stamp_ns, by_bolometer=False)
        self._frame = frame
        here = usable_roles(frame, _ROLES)
        self._frames_since += 1
        if self._map is not None and (self._frames_since >= _TIME_FOR_UPDATE or not here):
            self._finish_update(self._map)
        if not here:
            self._tracked = None
            result = self._state.unmeasured(TrackStats(), blindness(frame, _ROLES))
        elif self._map is None or self._images is None:
            result = self._start(frame)
        else:
            result = self._track(self._map, self._images, frame)
        return self._explained(with_stages(result, self._timer.take()))

    def _explained(self, result: OdometryResult) -> OdometryResult:
        """With all that there is to say of it."""
        reasons, self._failure = [self._failure], ""
        if self._map is None or not self._map.is_metric:
            result = without_unit(result)
        else:
            result = replace(result, scale_converged=True)
        if self._map is not None and result.status is TrackingStatus.TRACKING:
            fault = self._map.rig_fault or self._map.doubt
            reasons.append(fault or self._map.open_size or "")
            if fault is not None:
                result = replace(result, status=TrackingStatus.DEGRADED)
        return with_reasons(result, *reasons)

    # --- tracking ---------------------------------------------------------------------------------

    def _track(self, band_map: BandMap, images: BandImages, frame: RigFrame) -> OdometryResult:
        T_last, last_ns = self._last
        elapsed_s = (frame.stamp_ns - last_ns) * 1e-9
        late = LateCameras.after(band_map.rig.lags_s, T_last, elapsed_s, self._twist_before)
        pyramids, tracked = self._locate(band_map, images, frame, late)
        if self._update is not None and (
            tracked is None or band_map.keyframe_is_due(tracked, pyramids)
        ):
            # A keyframe stands on the one before, and what is not found may be found after it.
            self._finish_update(band_map)
            return self._track(band_map, images, frame)
        self._tracked = tracked
        here = usable_roles(frame, _ROLES)
        if tracked is None:
            self._shown = np.zeros(len(images.roles), np.bool_)
            missing = [role for role in images.roles if role not in here]
            reason = blindness(frame, missing) or "the image does not fit the keyframes"
            result = self._state.unmeasured(TrackStats(), reason)
            if result.status is TrackingStatus.LOST or not band_map.has_been_followed:
                self._begin(frame)
            return result
        if not band_map.is_metric and len(here) > len(images.roles):
            # One camera had to begin alone; a map of both is worth more than one without size.
            result = self._state.unmeasured(TrackStats(), "starting again with both cameras")
            self._begin(frame)
            return result
        return self._measured(band_map, frame, pyramids, tracked, late)

    def _locate(
        self, band_map: BandMap, images: BandImages, frame: RigFrame, late: LateCameras
    ) -> tuple[Pyramids, Tracked | None]:
        """First by the first camera, then by all: its motion takes the smear from the others."""
        self._contradicts = False
        T_start = inverse(self._state.predicted())
        rho, rig = band_map.rho, band_map.rig
        cameras = len(images.roles)
        window, light, tracked = band_map.window, self._brightness, None
        with self._timer.stage("pyramid"):
            first = images.pyramid(frame, 0, late.twist(T_start), rho, rig)
        alone: Pyramids = (first, *[None] * (cameras - 1))
        leads = first is not None and band_map.shows(0)
        joins = cameras > 1 and images.roles[1] in usable_roles(frame, _ROLES)
        joins = joins and band_map.is_metric and band_map.shows(1)
        if leads and joins:
            # Both will find the place: it is enough that the first one finds the way.
            with self._timer.stage("align"):
                T, near = self._tracker.approach(window, alone, T_start, light, late)
            with self._timer.stage("pyramid"):
                pyramids = first, images.pyramid(frame, 1, late.twist(T), rho, rig)
            tracked = self._join(window, pyramids, T, near, late)
            if tracked is not None:
                return pyramids, tracked
        if leads:
            tracked = self._find(band_map, alone, T_start, light, late)
        if cameras == 1:
            return alone, tracked
        led = tracked is not None
        T = T_start if tracked is None else tracked.T_rig_world
        with self._timer.stage("pyramid"):
            pyramids = first, images.pyramid(frame, 1, late.twist(T), rho, rig)
        if not joins:
            self._shown[1] = False
            return pyramids, tracked
        if tracked is None:
            tracked = self._find(band_map, pyramids, T_start, light, late)
            if tracked is None:
                return pyramids, None
            # The smear was taken off by the predicted motion: once more by the measured one.
            T = tracked.T_rig_world
            with self._timer.stage("pyramid"):
                pyramids = first, images.pyramid(frame, 1, late.twist(T), rho, rig)
        both = self._join(window, pyramids, T, tracked.brightness, late)
        if both is not None:
            return pyramids, both
        # Nothing is learnt from a picture that contradicts the first camera.
        self._contradicts = led
        return alone if led else pyramids, tracked

    def _join(
        self,
        window: PhotometricWindow,
        pyramids: Pyramids,
        T: NDArray[np.float64],
        brightness: NDArray[np.float64],
        late: LateCameras,
    ) -> Tracked | None:
        top = _SECOND_TOP if self._shown[1] else _TOP
        with self._timer.stage("align both"):
            tracked = self._tracker.track(window, pyramids, T, brightness, late, top)
        fits = tracked is not None and tracked.fit_by(1, self._config.photometric)
        self._shown[1] = fits
        return tracked if fits else None

    def _find(
        self,
        band_map: BandMap,
        pyramids: Pyramids,
        T_start: NDArray[np.float64],
        brightness: NDArray[np.float64],
        late: LateCameras,
    ) -> Tracked | None:
        window = band_map.window
        with self._timer.stage("align"):
            tracked = self._tracker.track(window, pyramids, T_start, brightness, late, _TOP)
        if tracked is None and pyramids[0] is not None:
            T_between = band_map.start_from_two_views(pyramids[0])
            if T_between is not None:
                tracked = self._tracker.track(window, pyramids, T_between, brightness, late, _TOP)
        if tracked is None:
            with self._timer.stage("search"):
                starts = starts_around(T_start, self._last[0])
                tracked = self._tracker.search(window, pyramids, starts, brightness, late)
        return tracked

    def _measured(
        self,
        band_map: BandMap,
        frame: RigFrame,
        pyramids: Pyramids,
        tracked: Tracked,
        late: LateCameras,
    ) -> OdometryResult:
        self._brightness = tracked.brightness
        with self._timer.stage("depths"):
            band_map.note(tracked, pyramids, late)
        pose = band_map.pose_of(tracked)
        is_keyframe = band_map.keyframe_is_due(tracked, pyramids)
        stats = TrackStats(
            features=len(tracked.points),
            matches=int(tracked.seen.sum()),
            inliers=tracked.count,
            iterations=tracked.iterations,
            keyframe=is_keyframe,
            scale_sigma=band_map.scale_sigma,
        )
        T = tracked.T_rig_world
        covariance = self._config.covariance_scale * tracked.covariance
        motion = T @ inverse(late.T_before)
        result = self._state.measured(pose, motion, covariance, late.elapsed_s, stats)
        result = replace(result, reason=self._contradiction(band_map, frame))
        self._twist_before = late.mean_twist(T), late.elapsed_s
        self._last = T, frame.stamp_ns
        if is_keyframe:
            with self._timer.stage("keyframe"):
                band_map.add_keyframe(frame, pyramids, tracked, late, self._brightness)
                self._update = self._worker.submit(timed, band_map.adjustment())
                self._frames_since = 0
        return result

    def _contradiction(self, band_map: BandMap, frame: RigFrame) -> str:
        """Says so where the second camera's picture is not used as it does not fit.

        After a while its points are given up instead: the next keyframe begins with it anew.
        """
        if not self._contradicts:
            self._contradicts_since_ns = None
            return ""
        if self._contradicts_since_ns is None:
            self._contradicts_since_ns = frame.stamp_ns
        if frame.stamp_ns - self._contradicts_since_ns > self._patience_ns:
            self._contradicts_since_ns = None
            band_map.window.drop_camera(1)
        return f"what the {band_map.roles[1]} camera shows does not fit, and is left out"

    def _awaited_update(self) -> MapUpdate | None:
        """What the adjustment under way has found; None where there is none, or where it failed.

        The next keyframe has another try.
        """
        update, self._update = self._update, None
        if update is None:
            return None
        with self._timer.stage("wait for bundle"):
            done, self._failure = outcome(update, "the adjustment of the keyframes")
        if done is None:
            return None
        found, spent_ms = done
        self._timer.add("bundle", spent_ms)
        return found

    def _finish_update(self, band_map: BandMap) -> None:
        """Wait for the adjustment of the newest keyframe, and take it over.

        It is always taken over before the second frame after, however fast it was, or before the
        first one where that does not fit or becomes a keyframe: timing must not change results.
        """
        update = self._awaited_update()
        if update is None:
            return
        window = band_map.window
        newest = window.poses.newest
        T_last_newest = self._last[0] @ inverse(window.poses.T_k_w[newest])
        begins_again = band_map.is_looked_for_again
        factor = band_map.take(update)
        T_last_newest[:3, 3] *= factor or 1.0
        # The pose goes on from where the keyframe is now known to be.
        self._last = T_last_newest @ window.poses.T_k_w[newest], self._last[1]
        pose = window.poses.newest_pose()
        if self._frames_since < _TIME_FOR_UPDATE or self._tracked is None:
            self._brightness = window.brightness[newest].copy()
        else:
            lengths = np.array([factor or 1.0] * 3 + [1.0] * 3)
            covariance = self._config.covariance_scale * self._tracked.covariance
            pose = pose.moved(T_last_newest, covariance * np.outer(lengths, lengths))
        if factor is None:
            self._state.pose = pose
            return
        self._state.rescale(factor, pose, is_reset=begins_again)
        if self._twist_before is not None:
            self._twist_before[0][:3] *= factor

    # --- start and recovery -----------------------------------------------------------------------

    def _start(self, frame: RigFrame) -> OdometryResult:
        self._begin(frame)
        if self._map is None:
            return self._state.unmeasured(TrackStats(), "too few points to start from")
        points = len(self._map.window.points())
        if self._state.is_lost:
            return self._state.unmeasured(TrackStats(features=points), "starting again")
        return self._state.started(TrackStats(features=points, keyframe=True))

    def _begin(self, frame: RigFrame) -> None:
        """Begin a new map with this frame, at the pose of the state."""
        self._awaited_update()
        self._images = self._map = None
        roles = usable_roles(frame, _ROLES)
        images = BandImages.of(frame, roles, self._config.photometric, self._lag_s)
        if images is None:
            return
        band_map = BandMap(self._config, images, self._room, self._state.pose, self._rng)
        with self._timer.stage("pyramid"):
            pyramids = tuple(
                images.pyramid(frame, camera, None, 1.0, band_map.rig)
                for camera in range(len(images.roles))
            )
        self._brightness = np.zeros((len(images.roles), 2))
        self._shown = np.zeros(len(images.roles), np.bool_)
        self._twist_before = None
        self._last = inverse(self._state.pose.T_world_rig), frame.stamp_ns
        self._state.prior.forget()
        band_map.add_keyframe(frame, pyramids, None, None, self._brightness)
        if band_map.count(0) >= 2 * self._config.photometric.min_inliers:
            self._images, self._map = images, band_map


def without_unit(result: OdometryResult) -> OdometryResult:
    """A result in an arbitrary unit: its covariances say that lengths are worth nothing."""

    def blurred(covariance: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        if covariance is None:
            return None
        out = covariance.copy()
        out[:3, :] = out[:, :3] = 0.0
        out[:3, :3] = _UNKNOWN * np.eye(3)
        return out

    return replace(
        result,
        scale_converged=False,
        covariance=blurred(result.covariance),
        twist_covariance=blurred(result.twist_covariance),
    )
