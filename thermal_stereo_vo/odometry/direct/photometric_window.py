"""The keyframes of a direct method: images, brightness, and the points they host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.direct.depth_filter import filter_depths
from thermal_stereo_vo.odometry.direct.gradient_pyramid import GradientPyramid
from thermal_stereo_vo.odometry.direct.photometric import PIXELS, take_patches
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    PhotometricProblem,
    PhotometricSolution,
    left_behind,
    moved_by,
)
from thermal_stereo_vo.odometry.direct.photometric_config import PhotometricConfig
from thermal_stereo_vo.odometry.direct.rig import Rig
from thermal_stereo_vo.odometry.direct.window_prior import WindowPrior
from thermal_stereo_vo.odometry.feature_based.image_pyramid import LEVELS
from thermal_stereo_vo.odometry.keyframe_poses import KeyframePoses
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

_INFORMATION_GAIN = 0.2
_MEASURED = 0.25
"""A distance is measured that is known better than that, relatively, 1 sigma."""
MOST_MISSES = 3
"""A point that should be in sight but does not fit this many times in a row is given up."""


@dataclass(frozen=True)
class PointSet:
    """A selection of points: ``index`` (N,) in the window, sorted by host keyframe and camera.

    ``hosts`` and ``host_cameras`` (N,), ``bearings`` (N, 3), ``rhos`` (N,) 1/m with
    ``rho_information`` (N,) for a noise of one unit of brightness.
    """

    index: NDArray[np.int64]
    hosts: NDArray[np.int64]
    host_cameras: NDArray[np.int64]
    bearings: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_information: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index)

    def take(self, chosen: NDArray[np.intp]) -> PointSet:
        """Those at the positions ``chosen``."""
        return PointSet(
            self.index[chosen],
            self.hosts[chosen],
            self.host_cameras[chosen],
            self.bearings[chosen],
            self.rhos[chosen],
            self.rho_information[chosen],
        )


class PhotometricWindow:
    """Fixed room for ``keyframes`` keyframes and ``capacity`` points; slots are used again.

    ``brightness`` (slots, C, 2) a and b of each image; ``has_image`` (slots, C), for a camera may
    be blind at a keyframe; ``stacks`` one (slots, H, W, 3) float32 per camera.  ``patch_offset`` is
    how far patches may be off as a whole, in standard deviations of a pixel's noise; of two bands,
    in images of bolometers alone.
    """

    def __init__(
        self,
        keyframes: int,
        capacity: int,
        rig: Rig,
        trust_gradient: float,
        patch_offset: float,
    ) -> None:
        cameras = len(rig.cameras)
        self.rig = rig
        self.poses = KeyframePoses(keyframes)
        self._trust_gradient = trust_gradient
        self.looseness = np.full(cameras, patch_offset**2)
        if rig.bands:
            self.looseness[~rig.bolometers] = 0.0
        self.brightness = np.zeros((keyframes, cameras, 2))
        self.twists = np.zeros((keyframes, 6))
        self.has_image = np.zeros((keyframes, cameras), np.bool_)
        self.stacks = tuple(np.zeros((keyframes, *shape, 3), np.float32) for shape in rig.shapes)
        self._hosts = np.full(capacity, -1, np.int64)
        self._host_cameras = np.zeros(capacity, np.int64)
        self._px = np.zeros((capacity, 2))
        self._bearings = np.zeros((capacity, 3))
        self._rhos = np.zeros(capacity)
        self._rho_information = np.zeros(capacity)
        self._rho_priors = np.zeros(capacity)
        self._prior_information = np.zeros(capacity)
        self._patches = np.zeros((LEVELS, capacity, PIXELS))
        self._trusts = np.zeros((LEVELS, capacity, PIXELS))
        self._misses = np.zeros(capacity, np.int64)
        self._intensity = np.zeros(capacity, np.float32)
        self._prior: WindowPrior | None = None
        self.is_metric = True
        """Whether lengths are metres.

        Until then nothing else than first depths carries the size on to what comes into view, and
        each counts as if it erred by itself.  After, those of a camera of a keyframe err together.
        """
        self.sigma = 5.0
        """Noise of a pixel's residual as the last adjustment found it."""

    def clear(self) -> None:
        """Forget all keyframes and points; the room stays."""
        self.poses.clear()
        self._hosts[:] = -1
        self._prior = None

    def points(self) -> PointSet:
        """All points."""
        index = np.flatnonzero(self._hosts >= 0)
        index = index[np.lexsort((self._host_cameras[index], self._hosts[index]))]
        return PointSet(
            index,
            self._hosts[index],
            self._host_cameras[index],
            self._bearings[index],
            self._rhos[index],
            self._rho_information[index],
        )

    def patches(
        self, points: PointSet, level: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Brightness and trusts (N, 8) at a pyramid level."""
        return self._patches[level][points.index], self._trusts[level][points.index]

    @property
    def T_rig_host(self) -> NDArray[np.float64]:
        """(slots, C, 4, 4) rig at the stamp of each keyframe from each camera when it looked."""
        return invert_all(moved_by(self.twists, self.rig.lags_s)) @ self.rig.T_rig_camera

    @property
    def T_world_host(self) -> NDArray[np.float64]:
        """(slots, C, 4, 4) world from each camera of each keyframe."""
        return invert_all(self.poses.T_k_w)[:, None] @ self.T_rig_host

    def positions_m(self, points: PointSet) -> NDArray[np.float64]:
        """(N, 3) world coordinates."""
        T = self.T_world_host[points.hosts, points.host_cameras]
        in_host = points.bearings / points.rhos[:, None]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], in_host) + T[:, :3, 3])

    def are_measured(self, points: PointSet) -> NDArray[np.bool_]:
        """(N,) whether distances are known to a quarter or better, which no guess claims to be."""
        sigmas = self.sigma / np.sqrt(np.maximum(points.rho_information, 1e-12))
        return np.asarray(sigmas < _MEASURED * points.rhos)

    def intensities(self, points: PointSet) -> NDArray[np.float32]:
        """(N,) counts of the points' pixels."""
        return self._intensity[points.index]

    def pixels_in(
        self, points: PointSet, camera: int, T_rig_world: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 2) where points appear in one camera of a rig at ``T_rig_world``; NaN behind it."""
        # One motion for each host and camera, not for each point.
        T = self.rig.T_camera_rig[camera] @ T_rig_world @ self.T_world_host
        T_camera_host = T[points.hosts, points.host_cameras]
        return self.rig.project(camera, T_camera_host, points.bearings, points.rhos)

    def flow_px(self, points: PointSet, T_rig_world: NDArray[np.float64]) -> tuple[float, float]:
        """Median motion of the newest keyframe's points since then: in all, and by translation."""
        newest = self.poses.newest
        T = T_rig_world @ inverse(self.poses.T_k_w[newest])
        T_turn = T.copy()
        T_turn[:3, 3] = 0.0
        # Translations count in the camera that hosts the point; its lever arm is part of both.
        camera = int(points.host_cameras[0])
        mine = points.take(np.flatnonzero(points.host_cameras == camera))
        T_rig_host = self.T_rig_host[newest, camera]
        there = self.rig.pixels_of(camera, T_rig_host, mine.bearings, mine.rhos)
        here = self.rig.pixels_of(camera, T @ T_rig_host, mine.bearings, mine.rhos)
        turned = self.rig.pixels_of(camera, T_turn @ T_rig_host, mine.bearings, mine.rhos)
        all_px = np.linalg.norm(here - there, axis=1)
        moved_px = np.linalg.norm(here - turned, axis=1)
        if not np.any(np.isfinite(all_px)):
            return np.inf, np.inf
        return float(np.nanmedian(all_px)), float(np.nanmedian(moved_px))

    def note_tracking(
        self, points: PointSet, seen: NDArray[np.bool_], fits: NDArray[np.bool_]
    ) -> None:
        """Give up points that were ``seen`` (N,) but did not fit (N,) too many times in a row."""
        self._misses[points.index[fits]] = 0
        missed = points.index[seen & ~fits]
        self._misses[missed] += 1
        self._drop(missed[self._misses[missed] > MOST_MISSES])

    def add_keyframe(
        self,
        pose: PoseEstimate,
        relative_covariance: NDArray[np.float64],
        pyramids: tuple[GradientPyramid | None, ...],
        brightness: NDArray[np.float64],
    ) -> int:
        """Take a frame in, the oldest out where there is no room; returns its slot."""
        if self.poses.is_full:
            self.drop_keyframe(self.poses.order[0])
        slot = self.poses.append(pose, relative_covariance)
        self.brightness[slot] = brightness
        if self._prior is not None:
            self._prior = self._prior.with_newest(self.poses.T_k_w[slot], brightness)
        self.twists[slot] = 0.0
        for camera, pyramid in enumerate(pyramids):
            self.has_image[slot, camera] = pyramid is not None
            if pyramid is not None:
                self.stacks[camera][slot] = pyramid[0]
        return slot

    def guess_again(
        self,
        camera: int,
        pixels: NDArray[np.float64],
        rhos: NDArray[np.float64],
        relative_sigma: float,
    ) -> None:
        """Give the points of a camera the inverse depths (N,) of ``pixels`` (N, 2) near by."""
        mine = np.flatnonzero((self._hosts >= 0) & (self._host_cameras == camera))
        away = np.sum((self._px[mine][:, None] - pixels[None]) ** 2, axis=2)
        near = np.argsort(away, axis=1)[:, :3]
        found = np.median(rhos[near], axis=1)
        information = (self.sigma / (relative_sigma * found)) ** 2
        self._rhos[mine] = self._rho_priors[mine] = found
        self._rho_information[mine] = self._prior_information[mine] = information

    def drop_keyframe(self, slot: int) -> None:
        """Forget a keyframe and its points, but not what others left behind of the rest."""
        if self._prior is not None:
            self._prior = self._prior.without(self.poses.order.index(slot))
        self._drop(np.flatnonzero(self._hosts == slot))
        self.poses.drop(slot)

    def marginalise(self, slot: int, config: PhotometricConfig) -> None:
        """Forget a keyframe and its points, but not what they say of the other keyframes."""
        if config.marginal_weight == 0.0:
            self.drop_keyframe(slot)
            return
        mine = self.points()
        mine = mine.take(np.flatnonzero(mine.hosts == slot))
        problem, _ = self.problem(mine)
        self._prior = left_behind(
            problem,
            self.poses.order.index(slot),
            huber=config.huber,
            gate=config.gate,
            weight=config.marginal_weight,
        )
        if self.has_image[self.poses.newest].all():
            # Windows with all cameras tell the lag anew, which may grow; else the past must.
            self._prior = self._prior.forgetting_lag()
        # The keyframe itself is out of the prior already.
        self._drop(mine.index)
        self.poses.drop(slot)

    def forget_prior(self) -> None:
        """Believe no longer what keyframes said that have left."""
        self._prior = None

    def add_points(
        self,
        slot: int,
        camera: int,
        pyramid: GradientPyramid,
        pixels: NDArray[np.generic],
        rhos: NDArray[np.float64],
        rho_information: NDArray[np.float64],
        intensity: NDArray[np.generic],
        *,
        is_prior: bool = False,
    ) -> int:
        """Give a keyframe (N, 2) new points with inverse depths (N,); returns how many it took."""
        free = np.flatnonzero(self._hosts < 0)[: len(pixels)]
        count = len(free)
        pixels = pixels[:count]
        self._px[free] = pixels
        self._bearings[free] = self.rig.bearings(camera, pixels)
        self._rhos[free] = rhos[:count]
        self._rho_information[free] = rho_information[:count]
        self._rho_priors[free] = rhos[:count]
        self._prior_information[free] = rho_information[:count] if is_prior else 0.0
        self._misses[free] = 0
        self._intensity[free] = intensity[:count]
        self._host_cameras[free] = camera
        patches, trusts = np.zeros((count, PIXELS)), np.zeros((count, PIXELS))
        for level in range(LEVELS):
            trusts[:] = 0.0
            take_patches(
                pyramid[level], pixels.astype(np.float64), 0.5**level, self._trust_gradient,
                patches, trusts,
            )  # fmt: skip
            self._patches[level][free] = patches
            self._trusts[level][free] = trusts
        usable = self._trusts[0][free].sum(axis=1) > 0.0
        self._hosts[free[usable]] = slot
        return int(usable.sum())

    def problem(self, points: PointSet | None = None) -> tuple[PhotometricProblem, PointSet]:
        """A copy of everything the adjustment needs (images aside), and its points (default all).

        Each keyframe looks for the points of the others with the camera that hosts them.  The other
        camera sees them in their own keyframe (static stereo), or in all others when it is of
        another band.
        """
        points = self.points() if points is None else points
        slots = np.array(self.poses.order)
        rank = np.zeros(len(self.has_image), np.int64)
        rank[slots] = np.arange(len(slots))
        ordered = np.lexsort((points.host_cameras, rank[points.hosts]))
        points = points.take(ordered)
        hosts = rank[points.hosts]
        at_home = (hosts[:, None] == np.arange(len(slots)))[:, :, None]
        own = (points.host_cameras[:, None] == np.arange(len(self.rig.cameras)))[:, None, :]
        seen = own & ~at_home
        if self.rig.bands:
            seen = seen | (~own & ~at_home & self.has_image[points.hosts][:, None, :])
        else:
            seen = seen | (~own & at_home)
        seen &= self.has_image[slots]
        patches, trusts = self.patches(points, 0)
        for t, slot in enumerate(slots):
            for camera, (height, width) in enumerate(self.rig.shapes):
                x, y = self.pixels_in(points, camera, self.poses.T_k_w[slot]).T
                seen[:, t, camera] &= (x > 4) & (x < width - 5) & (y > 4) & (y < height - 5)
        return (
            PhotometricProblem(
                self.stacks,
                slots,
                self.poses.T_k_w[slots].copy(),
                self.twists[slots].copy(),
                self.rig.lags_s,
                self.brightness[slots].copy(),
                self.rig.cameras,
                self.rig.T_rig_camera,
                hosts,
                points.host_cameras,
                points.bearings,
                points.rhos,
                self._rho_priors[points.index],
                self._prior_information[points.index],
                patches,
                trusts,
                seen,
                self.rig.bands,
                self.rig.bolometers,
                self._trust_gradient,
                self.looseness,
                self.is_metric,
                self._prior,
            ),
            points,
        )

    def filter_depths(
        self,
        points: PointSet,
        T_rig_world: NDArray[np.float64],
        brightness: NDArray[np.float64],
        images: tuple[NDArray[np.float32], ...],
        use: NDArray[np.bool_],
        config: PhotometricConfig,
        T_camera_rig: NDArray[np.float64],
    ) -> int:
        """Refine the inverse depths of ``points`` by an aligned frame; returns how many.

        ``images`` one (H, W, 3) per camera, ``use`` (C,) which of them count; ``T_camera_rig``
        (C, 4, 4) of that frame.
        """
        rhos, information = points.rhos.copy(), points.rho_information.copy()
        refined = filter_depths(
            T_rig_world, brightness, images, use, self.rig.cameras, T_camera_rig,
            self.poses.T_k_w, self.brightness, self.T_rig_host, points.hosts,
            points.host_cameras, points.bearings, self.rig.steps, *self.patches(points, 0),
            self.rig.bolometers, config.huber, config.gate, self.sigma, _INFORMATION_GAIN,
            rhos, information,
        )  # fmt: skip
        self._rhos[points.index] = rhos
        self._rho_information[points.index] = information
        return int(refined)

    def rescale(self, factor: float, about_m: NDArray[np.float64]) -> None:
        """Multiply all lengths but the lever arms of the rig; ``about_m`` (3,) stays in place."""
        self.poses.rescale(factor, about_m)
        if self._prior is not None:
            self._prior = self._prior.rescaled(factor, about_m)
        self.twists[:, :3] *= factor
        self._rhos /= factor
        self._rho_information *= factor**2
        self._rho_priors /= factor
        self._prior_information *= factor**2

    def apply(
        self,
        solution: PhotometricSolution,
        points: PointSet,
        gate: float,
        covariance_scale: float,
        spare: tuple[int, ...] = (),
    ) -> None:
        """Take refined poses, brightness and depths over; give up points that fit nowhere.

        Points of cameras in ``spare``, which had no part, stay as they are.
        """
        slots = np.array(self.poses.order)
        self.poses.refine(solution.T_k_w, covariance_scale * solution.covariance)
        self.brightness[slots] = solution.brightness
        part = ~np.isin(points.host_cameras, spare)
        self._rhos[points.index[part]] = solution.rhos[part]
        self._rho_information[points.index[part]] = solution.rho_information[part]
        self.sigma = solution.sigma
        fits = np.sum(solution.energies < gate * gate, axis=(1, 2))
        fails = np.sum(solution.energies >= gate * gate, axis=(1, 2))
        self._drop(points.index[part & ((fits == 0) | (fails > 2 * fits))])

    def take_camera(self, solution: PhotometricSolution, points: PointSet, camera: int) -> None:
        """Take over only the brightness and the depths of one camera."""
        self.brightness[self.poses.order, camera] = solution.brightness[:, camera]
        mine = points.host_cameras == camera
        self._rhos[points.index[mine]] = solution.rhos[mine]

    def drop_camera(self, camera: int) -> None:
        """Give up all points of a camera."""
        self._drop(np.flatnonzero(self._host_cameras == camera))

    def _drop(self, index: NDArray[np.int64]) -> None:
        self._hosts[index] = -1


def invert_all(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses of rigid motions (..., 4, 4)."""
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", out[..., :3, :3], T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out
