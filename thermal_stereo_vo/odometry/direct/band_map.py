"""The keyframes and points of a rig of two bands, and the size of the map that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.direct.band_cloud import cloud_of
from thermal_stereo_vo.odometry.direct.band_images import BandImages
from thermal_stereo_vo.odometry.direct.depth_guess import depths_around, random_depths
from thermal_stereo_vo.odometry.direct.frame_tracker import ABSENT, Pyramids, Tracked
from thermal_stereo_vo.odometry.direct.gradient_pyramid import GradientPyramid
from thermal_stereo_vo.odometry.direct.keyframe_choice import most_dispensable
from thermal_stereo_vo.odometry.direct.lag_check import LagCheck
from thermal_stereo_vo.odometry.direct.late_cameras import LateCameras
from thermal_stereo_vo.odometry.direct.map_size import SolvedWindow, variance_of_newest
from thermal_stereo_vo.odometry.direct.multispectral_config import (
    MultispectralConfig,
    ScaleConfig,
)
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    HOLD,
    PhotometricProblem,
    PhotometricSolution,
    adjust_photometrically,
)
from thermal_stereo_vo.odometry.direct.photometric_window import PhotometricWindow, PointSet
from thermal_stereo_vo.odometry.direct.point_selection import select_points
from thermal_stereo_vo.odometry.direct.rig import Rig, with_arms
from thermal_stereo_vo.odometry.direct.rig_check import RigCheck, Turn, turn_of_second
from thermal_stereo_vo.odometry.direct.scale_filter import ScaleFilter
from thermal_stereo_vo.odometry.direct.scale_search import (
    LEAST_KEYFRAMES,
    ScaleSearch,
    WindowScale,
)
from thermal_stereo_vo.odometry.direct.two_views import two_views
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

_ROOM_FACTOR = 8
_FIRST_KEYFRAMES = 8
_GUESS_SIGMA = 0.5
_LEAST_OF_NEWEST = 20
_START_DISTANCE_M = 4.0
_RIG_CHECK_EACH = 4
_TELLS_NOTHING = 0.5


@dataclass(frozen=True)
class MapUpdate:
    """What an adjustment found, and what it says of the size where that is not known yet.

    ``turn`` how far it would turn the second camera, where that was looked at.
    """

    solution: PhotometricSolution
    points: PointSet
    scale: WindowScale | None
    turn: Turn | None


class BandMap:
    """A window of keyframes whose points are followed each by the camera that hosts them.

    Until ``is_metric`` the map stands on the first camera alone, in a unit of about the mean
    distance of the scene, and the second one only tells how large that unit is.
    """

    def __init__(
        self,
        config: MultispectralConfig,
        images: BandImages,
        room: int,
        start: PoseEstimate,
        rng: np.random.Generator,
    ) -> None:
        self._config = config
        self._images = images
        self._start = start
        self._rng = rng
        cameras = len(images.roles)
        self.window = PhotometricWindow(
            room,
            _ROOM_FACTOR * config.selection.points,
            images.rig,
            config.photometric.trust_gradient,
            config.photometric.patch_offset,
        )
        self.window.is_metric = False
        self.has_been_followed = False
        """Whether any frame but the first was found in it."""
        self.scale_sigma: float | None = None
        self.rho = 1.0
        """Median inverse depth, for what needs no better."""
        self._search, self._size = _new_search(config.scale)
        self._rig_check = RigCheck(np.radians(config.rig_check_deg))
        self._lag_check = LagCheck(1e-3 * config.rig_check_ms)
        self._most = np.zeros(cameras, np.int64)
        """Points of each camera that have fitted at once since the newest keyframe."""
        self._keyframes = 0
        self._solved: SolvedWindow | None = None
        self._known_to_m = start.T_world_rig[:3, 3]
        """Where lengths were known last: what lies behind is in metres."""
        self._was_metric = False
        self._set_unit(np.log(_START_DISTANCE_M))

    @property
    def is_metric(self) -> bool:
        """Whether the size is known, and lengths are metres."""
        return self.window.is_metric

    @property
    def rig(self) -> Rig:
        """The rig with its lever arms in the unit of the map."""
        return self.window.rig

    @property
    def rig_fault(self) -> str | None:
        """What is wrong with calibration or stamps of the rig, as far as can be seen."""
        off_rad, drift_s = self._rig_check.off_rad, self._lag_check.drift_s
        faults = []
        if off_rad is not None:
            faults.append(
                f"the {self._images.roles[1]} camera does not move as the calibration of the rig "
                f"says, by about {np.degrees(off_rad):.1f} deg or more: calibrate the rig "
                "again, or check the stamps of its cameras"
            )
        if drift_s is not None:
            faults.append(
                f"the stamps of the {self._images.roles[1]} camera moved by {1e3 * drift_s:.1f} ms "
                f"against those of the {self._images.roles[0]} camera within seconds: let one "
                "clock stamp both"
            )
        return "; ".join(faults) or None

    @property
    def roles(self) -> tuple[str, ...]:
        """The cameras that the map is of."""
        return self._images.roles

    @property
    def is_looked_for_again(self) -> bool:
        """Whether the size was known once and proved wrong."""
        return self._was_metric and not self.is_metric

    @property
    def open_size(self) -> str | None:
        """Why lengths are in no unit; None where they are metres."""
        if self.is_metric:
            return None
        if len(self.roles) < 2:
            return f"lengths are in no unit: the {self.roles[0]} camera alone does not tell them"
        if self.scale_sigma is None or not self.scale_sigma < _TELLS_NOTHING:
            return "the motion so far does not tell the scale: move sideways and turn"
        known, asked = 100.0 * self.scale_sigma, 100.0 * self._config.scale.sigma
        return (
            f"the scale is known to {known:.0f} % so far, not to {asked:g} %: "
            "move sideways and turn"
        )

    @property
    def doubt(self) -> str | None:
        """Why lengths are not to be trusted now, though they were in metres before."""
        if self.is_looked_for_again:
            return "the size of the map was wrong and is looked for again: move sideways and turn"
        if self.is_metric and (self.scale_sigma or 0.0) > self._config.scale.reopen:
            percent = 100.0 * (self.scale_sigma or 0.0)
            return f"the size of what has just come into view is known to {percent:.0f} % only"
        return None

    def count(self, camera: int) -> int:
        """Number of points of a camera."""
        return int(np.count_nonzero(self.window.points().host_cameras == camera))

    def shows(self, camera: int) -> bool:
        """Whether a camera has points enough to be followed."""
        return self.count(camera) >= self._config.photometric.min_inliers

    def pose_of(self, tracked: Tracked) -> PoseEstimate:
        """World pose of a frame by the newest keyframe."""
        newest = self.window.poses.newest_pose()
        covariance = self._config.covariance_scale * tracked.covariance
        return newest.moved(tracked.T_rig_world @ newest.T_world_rig, covariance)

    def cloud(
        self, points: PointSet, frame: RigFrame, T_rig_world: NDArray[np.float64]
    ) -> PointCloud:
        """World coordinates of points, with what each camera shows of them in a frame."""
        return cloud_of(self.window, points, frame, self._images.roles, T_rig_world)

    # --- frames -----------------------------------------------------------------------------------

    def note(self, tracked: Tracked, pyramids: Pyramids, late: LateCameras) -> None:
        """Learn from a frame that was found: which points are there, and how far."""
        self.has_been_followed = True
        self.window.note_tracking(tracked.points, tracked.seen, tracked.fits)
        if self._keyframes < 2:
            return
        use = np.array([pyramid is not None for pyramid in pyramids])
        use[1:] &= self.is_metric
        self.window.filter_depths(
            tracked.points.take(np.flatnonzero(tracked.seen)),
            tracked.T_rig_world,
            tracked.brightness,
            tuple(ABSENT if pyramid is None else pyramid[0] for pyramid in pyramids),
            use,
            self._config.photometric,
            self.rig.T_camera_rig @ late.T_then_now(tracked.T_rig_world),
        )

    def start_from_two_views(self, pyramid: GradientPyramid) -> NDArray[np.float64] | None:
        """T_rig_world of a frame that is far from the only keyframe, whose depths follow.

        None where there are more, or where two views tell nothing.
        """
        window = self.window
        if len(window.poses.order) != 1 or not window.has_image[window.poses.newest, 0]:
            return None
        slot = window.poses.newest
        views = two_views(_grey(window.stacks[0][slot]), _grey(pyramid[0]), window.rig.cameras[0])
        if views is None:
            return None
        window.guess_again(0, views.pixels, views.rhos, _GUESS_SIGMA)
        T_rig_camera, T_camera_rig = window.rig.T_rig_camera[0], window.rig.T_camera_rig[0]
        moved = T_rig_camera @ views.T_second_first @ T_camera_rig
        return np.asarray(moved @ window.poses.T_k_w[slot])

    def keyframe_is_due(self, tracked: Tracked, pyramids: Pyramids) -> bool:
        """Whether the first camera that sees has too few points, or some have moved far."""
        config = self._config.keyframes
        leads = True
        for camera, pyramid in enumerate(pyramids):
            if pyramid is None or (camera > 0 and not self.is_metric):
                continue
            fits = tracked.fits & (tracked.points.host_cameras == camera)
            mine = np.flatnonzero(fits & (tracked.points.hosts == self.window.poses.newest))
            count = int(fits.sum())
            self._most[camera] = max(self._most[camera], count)
            wanted = config.inlier_share * self._most[camera] if leads else 0.0
            least = _LEAST_OF_NEWEST if leads else 0
            if count < max(wanted, _LEAST_OF_NEWEST) or len(mine) < least:
                return True
            leads = False
            if len(mine) < _LEAST_OF_NEWEST:
                continue
            flow_px, parallax_px = self.window.flow_px(
                tracked.points.take(mine), tracked.T_rig_world
            )
            if parallax_px > config.parallax_px or flow_px > config.flow_px:
                return True
        return False

    def add_keyframe(
        self,
        frame: RigFrame,
        pyramids: Pyramids,
        tracked: Tracked | None,
        late: LateCameras | None,
        brightness: NDArray[np.float64],
    ) -> None:
        """Take a frame into the window, at the start of the map if nothing was tracked."""
        window = self.window
        pose, covariance = self._start, np.zeros((6, 6))
        if tracked is not None:
            pose, covariance = self.pose_of(tracked), tracked.covariance
        T = inverse(pose.T_world_rig)
        new = [
            (camera, *self._new_points(frame, camera, pyramids, tracked, T))
            for camera in range(len(pyramids))
            if pyramids[camera] is not None
        ]
        if window.poses.is_full:
            # Before the size is known depths may be far off, and what is linearised stays so.
            alone = len(self._images.roles) == 1 and self._keyframes > 2 * _FIRST_KEYFRAMES
            if self.is_metric or alone:
                window.marginalise(self._dispensable(T), self._config.photometric)
            else:
                window.drop_keyframe(self._dispensable(T))
        claimed = self._config.covariance_scale * covariance
        slot = window.add_keyframe(pose, claimed, pyramids, brightness)
        if late is not None:
            window.twists[slot] = late.lately(T)
        for camera, pixels, rhos in new:
            pyramid = pyramids[camera]
            assert pyramid is not None
            counts = frame.views[self._images.roles[camera]].image[pixels[:, 1], pixels[:, 0]]
            information = (window.sigma / (_GUESS_SIGMA * rhos)) ** 2
            window.add_points(
                slot, camera, pyramid, pixels, rhos, information, counts, is_prior=True
            )
        if self.is_metric and self._solved is not None:
            order = window.poses.order
            self._size.carry(
                self._solved.variance_of_rest(order[:-1])
                + variance_of_newest(window.poses.T_k_w[order], covariance)
            )
            self.scale_sigma = self._size.sigma
        self._keyframes += 1
        self._most[:] = 0
        points = self._leading_points()
        self.rho = float(np.median(points.rhos)) if len(points) > 0 else 1.0

    def _new_points(
        self,
        frame: RigFrame,
        camera: int,
        pyramids: Pyramids,
        tracked: Tracked | None,
        T: NDArray[np.float64],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """(N, 2) pixels and (N,) inverse depths where a camera has no points yet."""
        window, pyramid = self.window, pyramids[camera]
        assert pyramid is not None
        occupied_px = np.zeros((0, 2))
        if tracked is not None:
            # Before the scale is known nobody looks whether points of the second camera fit.
            there = tracked.points.host_cameras == camera
            if camera == 0 or self.is_metric:
                there &= tracked.fits
            occupied_px = window.pixels_in(tracked.points.take(np.flatnonzero(there)), camera, T)
            size = np.array(window.rig.shapes[camera][::-1])
            occupied_px = occupied_px[np.all((occupied_px >= 0) & (occupied_px < size), axis=1)]
        selection = self._config.selection
        if self.is_metric and any(other is None for other in pyramids):
            # One camera has to do the work of both.
            wanted = (1.0 + self._config.second_share) * selection.points
            selection = replace(selection, points=int(wanted))
        elif camera > 0:
            selection = replace(
                selection, points=max(100, int(self._config.second_share * selection.points))
            )
        view = frame.views[self._images.roles[camera]]
        pixels = select_points(pyramid[0], occupied_px, view.mask, selection)
        known = self._leading_points()
        rhos = None
        if len(known) > 0:
            T_rig_host = (T @ window.T_world_host)[known.hosts, known.host_cameras]
            rhos = depths_around(window.rig, camera, T_rig_host, known.bearings, known.rhos, pixels)
        if rhos is None and self._keyframes > 0:
            rhos = np.full(len(pixels), self.rho)
        return pixels, random_depths(len(pixels), self._rng) if rhos is None else rhos

    def _leading_points(self) -> PointSet:
        """All points; before the size is known those of the first camera, the others' lie apart."""
        points = self.window.points()
        if self.is_metric:
            return points
        return points.take(np.flatnonzero(points.host_cameras == 0))

    def _dispensable(self, T_new: NDArray[np.float64]) -> int:
        window, order = self.window, self.window.poses.order
        points = self._leading_points()
        inside = np.zeros(len(points), np.bool_)
        for camera, (height, width) in enumerate(window.rig.shapes):
            at = window.pixels_in(points, camera, T_new)
            here = np.all((at > 0) & (at < np.array([width, height])), axis=1)
            inside |= here & (points.host_cameras == camera)
        counts = np.array([np.count_nonzero(points.hosts == slot) for slot in order])
        shown = np.array([np.count_nonzero(inside & (points.hosts == slot)) for slot in order])
        chosen = most_dispensable(
            window.poses.T_k_w[order], T_new, self.rho, counts, shown / np.maximum(counts, 1)
        )
        return order[chosen]

    # --- adjustment -------------------------------------------------------------------------------

    def adjustment(self) -> Callable[[], MapUpdate | None]:
        """The work that the newest keyframe makes, on a copy: for another thread."""
        problem, points = self.window.problem()
        first = self._keyframes <= _FIRST_KEYFRAMES
        return lambda: self._adjust(problem, points, first)

    def _adjust(
        self, problem: PhotometricProblem, points: PointSet, first: bool
    ) -> MapUpdate | None:
        config = self._config
        photometric, keyframes = config.photometric, config.keyframes
        if len(problem.slots) < 2:
            return None
        alone = problem
        if self.is_metric:
            hold = (self.window.sigma / self._size.hold) ** 2
        else:
            seen = problem.seen.copy()
            seen[problem.host_cameras > 0] = False
            seen[..., 1:] = False
            alone = replace(problem, seen=seen)
            hold = HOLD
        solution = adjust_photometrically(
            alone,
            huber=photometric.huber,
            gate=photometric.gate,
            iterations=keyframes.first_iterations if first else keyframes.bundle_iterations,
            free_lag=self.is_metric,
            hold=hold,
        )
        if solution is None:
            return None
        scale = None
        two = len(self._images.roles) == 2
        if two and not self.is_metric and len(problem.slots) >= LEAST_KEYFRAMES:
            scale = self._search.look(problem, solution, self._log_unit, photometric)
        turn = None
        if two and (
            scale is not None or (self.is_metric and self._keyframes % _RIG_CHECK_EACH == 0)
        ):
            arms = 1.0 if scale is None else np.exp(self._log_unit - scale.log_scale)
            turn = turn_of_second(
                replace(problem, rhos=solution.rhos),
                solution.T_k_w,
                with_arms(problem.T_rig_camera, arms)[1],
                photometric.gate,
                solution.sigma,
            )
        return MapUpdate(solution, points, scale, turn)

    def take(self, update: MapUpdate) -> float | None:
        """Take an adjustment over; the factor of all lengths when they become metres."""
        config, window = self._config, self.window
        spare = () if self.is_metric else tuple(range(1, len(self._images.roles)))
        window.apply(
            update.solution,
            update.points,
            config.photometric.gate,
            config.covariance_scale,
            spare,
        )
        solution = update.solution
        self._solved = SolvedWindow(tuple(window.poses.order), solution.T_k_w, solution.covariance)
        if update.turn is not None:
            self._rig_check.add(update.turn, has_told_scale=self.is_metric)
        if update.scale is not None:
            joint = update.scale.joint
            self._lag_check.add(float(self.rig.lags_s[1]) + joint.lag_s, joint.lag_sigma_s)
        if self.is_metric:
            self._shift_lag(update.solution.lag_s)
            if len(self.roles) > 1:
                self._lag_check.add(float(self.rig.lags_s[1]), update.solution.lag_sigma_s)
            self._watch(update.solution)
            return None
        if update.scale is None:
            return None
        self._search.add(update.scale)
        self._size.update(update.scale.log_scale, update.scale.sigma)
        self.scale_sigma = self._size.sigma
        told = self._size.count >= config.scale.windows and self._size.agrees
        if not told or self.scale_sigma > config.scale.sigma or self.rig_fault is not None:
            return None
        window.take_camera(update.scale.joint, update.points, 1)
        self._shift_lag(update.scale.joint.lag_s)
        factor = float(np.exp(self._size.log_scale))
        window.rescale(factor, self._known_to_m)
        self.rho /= factor
        window.is_metric = self._was_metric = True
        self._size.settle()
        self._search = ScaleSearch(config.scale)
        self._set_unit(0.0)
        return factor

    def _watch(self, solution: PhotometricSolution) -> None:
        """Admit that the size is wrong where many windows say so."""
        self._size.update(0.0, solution.log_scale_sigma)
        self.scale_sigma = self._size.sigma
        self._search.note(solution.log_scale)
        if self._search.contradicts():
            self.window.is_metric = False
            poses = self.window.poses
            self._known_to_m = inverse(poses.T_k_w[poses.order[0]])[:3, 3]
            self.window.forget_prior()
            self._search, self._size = _new_search(self._config.scale)

    def _set_unit(self, log_unit: float) -> None:
        """Let the lever arms be as long as if a unit of the map were exp(``log_unit``) metres."""
        self._log_unit = log_unit
        rig = self._images.rig.with_arms(np.exp(-log_unit))
        if len(self._images.roles) == 1:
            rig = self._images.rig.with_arms(0.0)
        self.window.rig = replace(rig, lags_s=self.window.rig.lags_s)

    def _shift_lag(self, lag_s: float) -> None:
        rig = self.rig
        self.window.rig = replace(rig, lags_s=rig.lags_s + lag_s * rig.bolometers)


def _new_search(config: ScaleConfig) -> tuple[ScaleSearch, ScaleFilter]:
    return ScaleSearch(config), ScaleFilter(config.drift, config.first_drift)


def _grey(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W) picture of a pyramid level, for corners."""
    return np.asarray(np.clip(128.0 + image[..., 0], 0, 255).astype(np.uint8))
