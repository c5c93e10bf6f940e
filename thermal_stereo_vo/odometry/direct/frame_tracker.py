"""Where a new frame is: aligned with all patches of the window, checked before it is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.direct.frame_alignment import POSE, align_frame
from thermal_stereo_vo.odometry.direct.gradient_pyramid import GradientPyramid
from thermal_stereo_vo.odometry.direct.late_cameras import LateCameras
from thermal_stereo_vo.odometry.direct.photometric_config import PhotometricConfig
from thermal_stereo_vo.odometry.direct.photometric_window import PhotometricWindow, PointSet
from thermal_stereo_vo.odometry.feature_based.image_pyramid import LEVELS
from thermal_stereo_vo.odometry.information import inverse_information

Pyramids = tuple[GradientPyramid | None, ...]
"""One per camera in the order of the roles; None for a blind one."""

ABSENT = np.zeros((1, 1, 3), np.float32)
_LARGEST_GAIN = 1.5
"""Logarithm: beyond this it is another scene, or none."""
_TURN_RAD = 0.04


@dataclass(frozen=True)
class Tracked:
    """What one frame saw.

    ``seen`` and ``fits`` (N,) bool of ``points``; ``T_rig_world`` (4, 4) with the (6, 6)
    ``covariance`` of its left perturbation given the keyframes; ``brightness`` (C, 2); ``sigma``
    noise of a pixel.
    """

    points: PointSet
    seen: NDArray[np.bool_]
    fits: NDArray[np.bool_]
    T_rig_world: NDArray[np.float64]
    covariance: NDArray[np.float64]
    brightness: NDArray[np.float64]
    sigma: float
    iterations: int

    @property
    def count(self) -> int:
        """Number of patches that fit."""
        return int(self.fits.sum())

    def fit_by(self, camera: int, config: PhotometricConfig) -> bool:
        """Whether the patches of one camera fit as well as those of all must; few tell nothing."""
        mine = self.seen & (self.points.host_cameras == camera)
        shown = int(mine.sum())
        fitting = int((mine & self.fits).sum())
        return shown < config.min_inliers or fitting >= config.min_inlier_share * shown


class FrameTracker:
    """Coarse-to-fine alignment of frames with a window."""

    def __init__(self, config: PhotometricConfig) -> None:
        self._config = config

    def track(
        self,
        window: PhotometricWindow,
        pyramids: Pyramids,
        T_start: NDArray[np.float64],
        brightness: NDArray[np.float64],
        late: LateCameras | None = None,
        top: int = LEVELS - 1,
    ) -> Tracked | None:
        """The pose that makes the patches fit, looked for around ``T_start`` T_rig_world.

        ``late`` tells where cameras that were late looked from; ``top`` is the pyramid level to
        begin with.
        """
        points = window.points()
        if len(points) < self._config.min_inliers:
            return None
        attempt = _Attempt(self._config, window, points, pyramids, late)
        T, light = attempt.descend(T_start, brightness, top, 0)
        return attempt.check(T, light)

    def approach(
        self,
        window: PhotometricWindow,
        pyramids: Pyramids,
        T_start: NDArray[np.float64],
        brightness: NDArray[np.float64],
        late: LateCameras | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pose (4, 4) and brightness (C, 2) by the coarse levels alone, not checked."""
        attempt = _Attempt(self._config, window, window.points(), pyramids, late)
        return attempt.descend(T_start, brightness, LEVELS - 1, 1)

    def search(
        self,
        window: PhotometricWindow,
        pyramids: Pyramids,
        T_starts: list[NDArray[np.float64]],
        brightness: NDArray[np.float64],
        late: LateCameras | None = None,
    ) -> Tracked | None:
        """As ``track``, from the best of several starts and small turns of each."""
        points = window.points()
        if len(points) < self._config.min_inliers:
            return None
        attempt = _Attempt(self._config, window, points, pyramids, late)
        axes = np.eye(6)[3:] * _TURN_RAD
        turns = np.concatenate([np.zeros((1, 6)), axes, -axes])
        best: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
        for T_start in T_starts:
            for turn in turns:
                T, light = attempt.descend(
                    exp_se3(turn) @ T_start, brightness, LEVELS - 1, LEVELS - 2
                )
                if best is None or attempt.cost < best[0]:
                    best = attempt.cost, T, light
        assert best is not None
        T, light = attempt.descend(best[1], best[2], LEVELS - 2, 0)
        return attempt.check(T, light)


class _Attempt:
    """The patches of a window and one frame, ready to be aligned."""

    def __init__(
        self,
        config: PhotometricConfig,
        window: PhotometricWindow,
        points: PointSet,
        pyramids: Pyramids,
        late: LateCameras | None,
    ) -> None:
        self._late = late
        self._config = config
        self._window = window
        self._points = points
        self._pyramids = pyramids
        self._use = np.array([pyramid is not None for pyramid in pyramids])
        cameras = len(pyramids)
        self._A = np.zeros((POSE + 2 * cameras, POSE + 2 * cameras))
        self._g = np.zeros(POSE + 2 * cameras)
        self._energies = np.full((cameras, len(points)), np.nan)
        self._T_rig_host = window.T_rig_host
        self.cost = np.inf
        self.iterations = 0

    def descend(
        self,
        T_start: NDArray[np.float64],
        brightness: NDArray[np.float64],
        top: int,
        bottom: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pose and brightness after the levels from ``top`` to ``bottom``."""
        T, light = T_start.copy(), brightness.copy()
        if top == LEVELS - 1:
            self._level_out(T, light)
        for level in range(top, bottom - 1, -1):
            self._align(T, light, level)
        return T, light

    def check(self, T: NDArray[np.float64], light: NDArray[np.float64]) -> Tracked | None:
        """What was found, or None when the patches do not agree to it."""
        config, points = self._config, self._points
        newest = self._window.brightness[self._window.poses.newest]
        if np.any(np.abs(light[self._use, 0] - newest[self._use, 0]) > _LARGEST_GAIN):
            return None
        patches, _ = self._window.patches(points, 0)
        host_a = self._window.brightness[points.hosts, points.host_cameras, 0]
        gain = np.exp(light[:, :1] - host_a)
        variance = gain**2 * patches.var(axis=1)
        seen = np.isfinite(self._energies)
        limit = np.minimum(config.gate**2, (1.0 - config.min_explained) * variance)
        limit[self._explained(variance)] = config.gate**2
        with np.errstate(invalid="ignore"):
            good = self._energies < limit
        in_sight = np.asarray(np.any(seen, axis=0))
        fits = np.asarray(np.any(good, axis=0))
        needed = max(config.min_inliers, config.min_inlier_share * int(in_sight.sum()))
        if int(fits.sum()) < needed:
            return None
        unit_covariance = inverse_information(self._A[:POSE, :POSE] - self._brightness_part())
        if unit_covariance is None:
            return None
        sigma = float(np.sqrt(np.mean(self._energies[good])))
        return Tracked(
            points, in_sight, fits, T, sigma**2 * unit_covariance, light, sigma, self.iterations
        )

    def _explained(self, variance: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(C,) bolometers whose patches explain their ``variance`` (C, N) all together.

        Each of them may be as faint as the noise.
        """
        seen = np.isfinite(self._energies)
        left = np.sum(self._energies, axis=1, where=seen)
        there = np.sum(variance, axis=1, where=seen)
        together = left < (1.0 - self._config.min_explained) * there
        return np.asarray(self._window.rig.bolometers & together)

    def _brightness_part(self) -> NDArray[np.float64]:
        """(6, 6) what not knowing the brightness takes from the information of the pose."""
        used = POSE + np.flatnonzero(np.repeat(self._use, 2))
        B, D = self._A[:POSE, used], self._A[np.ix_(used, used)]
        return np.asarray(B @ np.linalg.lstsq(D, B.T, rcond=None)[0])

    def _align(self, T: NDArray[np.float64], light: NDArray[np.float64], level: int) -> None:
        config, window, points = self._config, self._window, self._points
        images = tuple(ABSENT[None] if p is None else p[level][None] for p in self._pyramids)
        T_camera_rig = window.rig.T_camera_rig
        if self._late is not None:
            T_camera_rig = T_camera_rig @ self._late.T_then_now(T)
        use = self._use.copy()
        if level > 0 and not window.rig.bands:  # one eye finds the way, both find the place
            use[1 + int(np.argmax(use)) :] = False
        self.cost, _, iterations = align_frame(
            T, light, images, use, window.rig.cameras, T_camera_rig, 0.5**level,
            window.poses.T_k_w, window.brightness, self._T_rig_host, points.hosts,
            points.host_cameras, points.bearings, points.rhos, points.rho_information,
            window.rig.steps * 2.0**level, *window.patches(points, level), window.rig.bands,
            window.rig.bolometers, window.looseness, config.huber,
            config.gate * (1.0 + level), level == 0, config.iterations, self._A, self._g,
            self._energies,
        )  # fmt: skip
        self.iterations += int(iterations)

    def _level_out(self, T: NDArray[np.float64], light: NDArray[np.float64]) -> None:
        """Set the offsets so that the median residual is zero.

        After a flat-field correction they may be anywhere, and every patch would be an outlier.
        """
        window, points = self._window, self._points
        level = LEVELS - 1
        patches, _ = window.patches(points, level)
        host = window.brightness[points.hosts, points.host_cameras]
        for camera, pyramid in enumerate(self._pyramids):
            if pyramid is None:
                continue
            image = pyramid[level][..., 0]
            at = window.pixels_in(points, camera, T) * 0.5**level
            inside = (at >= 0) & (at < np.array(image.shape[::-1]) - 1)
            inside_all = np.flatnonzero(
                inside.all(axis=1) & ((points.host_cameras == camera) | (not window.rig.bands))
            )
            if len(inside_all) < self._config.min_inliers:
                continue
            x, y = np.rint(at[inside_all]).astype(int).T
            gain = np.exp(light[camera, 0] - host[inside_all, 0])
            expected = gain * (patches[inside_all].mean(axis=1) - host[inside_all, 1])
            light[camera, 1] = float(np.median(image[y, x] - expected))


def starts_around(
    T_predicted: NDArray[np.float64], T_last: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Places to look for a frame that was not where it was expected: T_rig_world (4, 4) each."""
    motion = T_predicted @ inverse(T_last)
    return [T_predicted, T_last, motion @ T_predicted]
