"""The keyframes that are kept, their points, and where each keyframe saw each point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import (
    RHO_MIN,
    BundleProblem,
    BundleSolution,
)
from thermal_stereo_vo.odometry.feature_based.image_pyramid import KeyframeImages, Pyramid
from thermal_stereo_vo.odometry.feature_based.inverse_depth import predict_pixels
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera
from thermal_stereo_vo.odometry.keyframe_poses import KeyframePoses
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate

BORDER_PX = 8.0
"""Nearer to the border a patch may be missed without blame."""
NO_GUESS = -1
MEASURED = 0.25
"""Share of the information of a disparity from which a guessed depth counts as measured."""
DISPARITY_SIGMA_PX = 0.4
"""What a measured disparity is about worth, to weigh a guessed one against it."""


@dataclass(frozen=True)
class WindowPoints:
    """A selection of points: ``index`` (N,) in the window, sorted by host; see KeyframeWindow.

    ``guesser`` (N,): NO_GUESS, or the eye (0 left, 1 right) that saw a point alone and whose guess
    of the depth nothing has confirmed yet.
    """

    index: NDArray[np.int64]
    hosts: NDArray[np.int64]
    host_px: NDArray[np.float64]
    bearings: NDArray[np.float64]
    rhos: NDArray[np.float64]
    rho_information: NDArray[np.float64]
    guesser: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.index)

    def take(self, chosen: NDArray[np.intp]) -> WindowPoints:
        """Those at the positions ``chosen``."""
        return WindowPoints(
            self.index[chosen],
            self.hosts[chosen],
            self.host_px[chosen],
            self.bearings[chosen],
            self.rhos[chosen],
            self.rho_information[chosen],
            self.guesser[chosen],
        )


def positions_m(points: WindowPoints, T_keyframe_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) world coordinates of points of keyframes with these poses (slots, 4, 4)."""
    in_host = points.bearings / points.rhos[:, None]
    T_world_host = np.stack([inverse(T) for T in T_keyframe_world])[points.hosts]
    turned = np.einsum("nij,nj->ni", T_world_host[:, :3, :3], in_host)
    return np.asarray(turned + T_world_host[:, :3, 3])


class KeyframeWindow:
    """Fixed room for ``keyframes`` keyframes and ``capacity`` points; slots are used again.

    A point belongs to the keyframe whose patch it is (its host), by a pixel there and an inverse
    depth rho (1/m); rho_information is in px^2 m^2, to be divided by the noise variance in px^2.
    """

    def __init__(
        self, keyframes: int, capacity: int, shape: tuple[int, int], camera: StereoCamera
    ) -> None:
        self.camera = camera
        self.right_turn_rad = np.zeros(3)
        """(3,) what is left of the extrinsics: the right eye sees a point p at p + turn x p."""
        self._poses = KeyframePoses(keyframes)
        self.images = KeyframeImages(keyframes, shape)
        self._hosts = np.full(capacity, -1, np.int64)
        self._host_px = np.zeros((capacity, 2))
        self._rhos = np.zeros(capacity)
        self._rho_information = np.zeros(capacity)
        self._observed = np.full((keyframes, capacity, 4), np.nan)
        self._misses = np.zeros(capacity, np.int64)
        self._intensity = np.zeros(capacity, np.float32)
        self._depth_trust = np.ones(capacity)
        """Weight of the disparity in the host: 1 where an eye measured it, little for a guess."""
        self._guesser = np.full(capacity, NO_GUESS, np.int8)

    @property
    def eyes(self) -> NDArray[np.float64]:
        """(9,) fx fy cx cy cx_right baseline_m, turn of the right eye, as the kernels take it."""
        return np.concatenate([self.camera.parameters, self.right_turn_rad])

    @property
    def newest(self) -> int:
        """Slot of the newest keyframe."""
        return self._poses.newest

    @property
    def order(self) -> list[int]:
        """Slots, oldest keyframe first."""
        return self._poses.order

    @property
    def T_keyframe_world(self) -> NDArray[np.float64]:
        """(slots, 4, 4) poses of the keyframes."""
        return self._poses.T_k_w

    def clear(self) -> None:
        """Forget all keyframes and points; the room stays."""
        self._poses.clear()
        self._hosts[:] = -1
        self._observed[:] = np.nan

    def newest_pose(self) -> PoseEstimate:
        """World pose of the newest keyframe with its covariance."""
        return self._poses.newest_pose()

    def points(self) -> WindowPoints:
        """All points, sorted by host so that each relative pose is computed once."""
        index = np.flatnonzero(self._hosts >= 0)
        index = index[np.argsort(self._hosts[index], kind="stable")]
        measured = MEASURED * (self.camera.fx * self.camera.baseline_m) ** 2
        return WindowPoints(
            index,
            self._hosts[index],
            self._host_px[index],
            self._bearings(self._host_px[index]),
            self._rhos[index],
            self._rho_information[index],
            np.where(self._rho_information[index] < measured, self._guesser[index], NO_GUESS),
        )

    def seen_by_newest(self) -> NDArray[np.float64]:
        """(N, 4) px where the newest keyframe saw points, NaN where not."""
        return np.asarray(self._observed[self.newest, self._hosts >= 0])

    def positions_m(self, points: WindowPoints) -> NDArray[np.float64]:
        """(N, 3) world coordinates."""
        return positions_m(points, self.T_keyframe_world)

    def intensities(self, points: WindowPoints) -> NDArray[np.float32]:
        """(N,) counts of the points' pixels."""
        return self._intensity[points.index]

    def predict(
        self, points: WindowPoints, T_camera_world: NDArray[np.float64], step_px: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where points should appear, (N, 4) px, and the (N, 2, 2) warp of a patch of that size."""
        predicted = np.full((len(points), 4), np.nan)
        warps = np.zeros((len(points), 2, 2))
        predict_pixels(
            T_camera_world,
            self.T_keyframe_world,
            points.hosts,
            points.bearings,
            points.rhos,
            self.eyes,
            step_px,
            predicted,
            warps,
        )
        return predicted, warps

    def count_in_sight(self, T_camera_world: NDArray[np.float64]) -> int:
        """How many points the left eye has before it there."""
        return int(np.sum(self._in_sight(self.points(), T_camera_world)))

    def parallax_px(self, points: WindowPoints, T_camera_world: NDArray[np.float64]) -> float:
        """Median flow of points of the newest keyframe since then, less what is due to rotation."""
        T = T_camera_world @ inverse(self.T_keyframe_world[self.newest])
        focal_px = (self.camera.fx, self.camera.fy)
        turned = points.bearings @ T[:3, :3].T
        moved = turned + points.rhos[:, None] * T[:3, 3]
        flow_px = (moved[:, :2] / moved[:, 2:] - turned[:, :2] / turned[:, 2:]) * focal_px
        return float(np.median(np.linalg.norm(flow_px, axis=1)))

    def radial_weights(
        self, host_px: NDArray[np.float64], observed: NDArray[np.float64], trust: float
    ) -> NDArray[np.float64]:
        """Weights of observations (..., 4) of points (N, 2) by their angles from the optical axis.

        What calibration leaves of the lens distortion grows towards the border, in the host as in
        the frame that sees the point; ``trust`` is the tangent at which it equals the noise.
        """
        if trust == 0.0:
            return np.ones(observed.shape[:-1])
        left = np.isfinite(observed[..., :1])
        here = self._radius_squared(np.where(left, observed[..., :2], observed[..., 2:]))
        here = np.where(np.isfinite(here), here, 0.0) + self._radius_squared(host_px)
        return np.asarray(1.0 / (1.0 + here / trust**2))

    def note_tracking(
        self,
        points: WindowPoints,
        good: NDArray[np.bool_],
        T_camera_world: NDArray[np.float64],
        most_misses: int,
    ) -> None:
        """Drop points that should be in sight but were missed too many times in a row."""
        in_sight = self._in_sight(points, T_camera_world)
        self._misses[points.index[good]] = 0
        missed = points.index[in_sight & ~good]
        self._misses[missed] += 1
        self._drop(missed[self._misses[missed] > most_misses])

    def add_keyframe(
        self,
        pose: PoseEstimate,
        relative_covariance: NDArray[np.float64],
        pyramid: Pyramid,
        points: WindowPoints | None = None,
        observed: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Take a frame in, the oldest keyframe out when there is no room.

        ``relative_covariance`` (6, 6) is that of the frame's left perturbation given the newest
        keyframe; the first has none but its own.  ``observed`` (N, 4) is where it saw ``points``.
        Returns the (M, 2) left pixels of those points that are still in the window.
        """
        if self._poses.is_full:
            self._forget_oldest()
        slot = self._poses.append(pose, relative_covariance)
        self.images.store(slot, pyramid)
        self._observed[slot] = np.nan
        if points is None or observed is None:
            return np.zeros((0, 2))
        still = self._hosts[points.index] >= 0
        self._observed[slot, points.index[still]] = observed[still]
        pixels = observed[still, :2]
        return pixels[np.isfinite(pixels[:, 0])]

    def add_points(
        self,
        pixels: NDArray[np.int64],
        right_x_px: NDArray[np.float64],
        intensity: NDArray[Any],
    ) -> None:
        """Give the newest keyframe (N, 2) new points with the column (N,) seen by its right eye."""
        free = np.flatnonzero(self._hosts < 0)[: len(pixels)]
        pixels, right_x_px = pixels[: len(free)], right_x_px[: len(free)]
        camera, slot = self.camera, self.newest
        x = (right_x_px - camera.cx_right) / camera.fx
        y = (pixels[:, 1] - camera.cy) / camera.fy
        turn = self.right_turn_rad
        shift = turn[1] * (1.0 + x * x) - turn[0] * x * y - turn[2] * y
        disparity = (pixels[:, 0] - camera.cx) - camera.fx * (x - shift)
        gain = camera.fx * camera.baseline_m
        self._hosts[free] = slot
        self._host_px[free] = pixels
        self._rhos[free] = np.maximum(disparity / gain, RHO_MIN)
        self._rho_information[free] = gain**2
        self._observed[:, free] = np.nan
        self._observed[slot, free, 0] = pixels[:, 0]
        self._observed[slot, free, 1] = pixels[:, 1]
        self._observed[slot, free, 2] = right_x_px
        self._misses[free] = 0
        self._intensity[free] = intensity[: len(free)]
        self._depth_trust[free] = 1.0
        self._guesser[free] = NO_GUESS

    def add_guessed_points(
        self,
        pixels: NDArray[np.int64],
        rhos: NDArray[np.float64],
        sigmas: NDArray[np.float64],
        intensity: NDArray[Any],
        eye: int,
    ) -> None:
        """Give the newest keyframe (N, 2) new points that only this eye saw (0 left, 1 right).

        Their inverse depths (N,) are guesses with these standard deviations (N,) in 1/m: as good
        as a disparity that is as much less trusted than a measured one.
        """
        camera = self.camera
        gain = camera.fx * camera.baseline_m
        right_x_px = pixels[:, 0] - camera.cx + camera.cx_right - gain * rhos
        free = np.flatnonzero(self._hosts < 0)[: len(pixels)]
        self.add_points(pixels, right_x_px, intensity)
        trust = (DISPARITY_SIGMA_PX / (gain * sigmas[: len(free)])) ** 2
        self._depth_trust[free] = np.minimum(trust, 1.0)
        self._rho_information[free] *= self._depth_trust[free]
        self._guesser[free] = eye

    def bundle_problem(self, radial_trust: float) -> tuple[BundleProblem, NDArray[np.int64]]:
        """A copy of everything bundle adjustment needs, and the (N,) index of its points."""
        points = self.points()
        slots = np.array(self.order)
        rank = np.zeros(len(self.T_keyframe_world), np.int64)
        rank[slots] = np.arange(len(slots))
        observed = self._observed[slots][:, points.index]
        hosts = rank[points.hosts]
        weights = self.radial_weights(points.host_px, observed, radial_trust)
        weights[hosts, np.arange(len(hosts))] *= self._depth_trust[points.index]
        return (
            BundleProblem(
                self.T_keyframe_world[slots].copy(),
                hosts,
                points.bearings,
                points.rhos,
                np.ascontiguousarray(observed),
                weights,
                self.eyes,
            ),
            points.index,
        )

    def apply(
        self, solution: BundleSolution, index: NDArray[np.int64], outlier_sigmas: float
    ) -> None:
        """Take the refined poses and depths over; forget observations that do not fit."""
        slots = np.array(self.order)
        self._poses.refine(solution.T_k_w, solution.covariance)
        self._rhos[index] = solution.rhos
        self._rho_information[index] = solution.rho_information
        limit_px = outlier_sigmas * solution.sigma_px
        wrong = np.any(np.abs(solution.residuals) > limit_px, axis=2)
        guessed = self._guesser[index] != NO_GUESS
        for k, slot in enumerate(slots):
            # A guess of a depth may be far off; it is no observation.
            wrong[k] &= ~(guessed & (self._hosts[index] == slot))
            self._observed[slot, index[wrong[k]]] = np.nan
        # A point that its own host's right eye contradicts has no depth to speak of.
        hosts = self._hosts[index]
        in_host = np.isnan(self._observed[hosts, index, 2])
        seen = np.sum(np.isfinite(self._observed[slots][:, index, 0]), axis=0)
        self._drop(index[in_host & (seen < 3)])

    def _in_sight(
        self, points: WindowPoints, T_camera_world: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """(N,) whether each point should appear in the left image."""
        predicted, _ = self.predict(points, T_camera_world, 1.0)
        height, width = self.images.stacks[0].shape[1:]
        x, y = predicted[:, 0], predicted[:, 1]
        in_sight = (x > BORDER_PX) & (x < width - BORDER_PX)
        in_sight &= (y > BORDER_PX) & (y < height - BORDER_PX)
        return np.asarray(in_sight)

    def _forget_oldest(self) -> None:
        oldest = self._poses.drop_oldest()
        self._drop(np.flatnonzero(self._hosts == oldest))
        self._observed[oldest] = np.nan

    def _drop(self, index: NDArray[np.int64]) -> None:
        self._hosts[index] = -1

    def _bearings(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        camera = self.camera
        return np.stack(
            [
                (pixels[:, 0] - camera.cx) / camera.fx,
                (pixels[:, 1] - camera.cy) / camera.fy,
                np.ones(len(pixels)),
            ],
            axis=1,
        )

    def _radius_squared(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        camera = self.camera
        x = (pixels[..., 0] - camera.cx) / camera.fx
        y = (pixels[..., 1] - camera.cy) / camera.fy
        return np.asarray(x * x + y * y)
