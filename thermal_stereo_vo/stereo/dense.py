"""Dense disparity of a rectified pair of low-contrast thermal images.

Semi-global matching (H. Hirschmueller, PAMI 2008, as OpenCV has it) on a view made for matching,
refined to sub-pixels on linear counts, with everything rejected that is not worth a point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.stereo.dense_refinement import Map, Refined, Refinement
from thermal_stereo_vo.stereo.dense_view import fine_noise, matching_view, sky, smoothed

_FINE_PX = 0.7
"""Gaussian under the sub-pixel step."""
_STEPS = 16
"""Disparity steps in a pixel, and the multiple that the number of disparities must have."""


@dataclass(frozen=True)
class DenseConfig:
    """From a rectified pair to disparities."""

    rate_hz: float = setting(
        5.0, "Live: disparity maps a second, at most.", unit="Hz", minimum=0.1, maximum=60.0
    )
    max_range_m: float = setting(
        40.0, "Live: farther points are left out of clouds.", unit="m", minimum=0.5, maximum=1000.0
    )
    point_step: int = setting(
        2, "Live: every so many pixels and rows a point.", unit="px", minimum=1, maximum=32
    )
    disparities: int = setting(
        96, "Search range from zero, in whole steps of 16.", unit="px", minimum=16, maximum=512
    )
    smoothing_px: float = setting(
        1.5, "Gaussian over the counts before matching.", unit="px", minimum=0.0, maximum=5.0
    )
    window_px: int = setting(41, "Window of the local contrast.", unit="px", minimum=3, maximum=301)
    noise_floor: float = setting(
        5.0, "Local contrast below so many times the pixel noise is not amplified.", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip
    block_px: int = setting(
        9, "Block of semi-global matching, odd.", unit="px", minimum=1, maximum=21
    )
    small_step: float = setting(
        8.0, "Penalty of a change by one disparity, per pixel of the block.", minimum=0.0,
        maximum=200.0,
    )  # fmt: skip
    large_step: float = setting(
        32.0, "Penalty of a larger change, per pixel of the block.", minimum=0.0, maximum=1000.0
    )
    refinement_px: int = setting(
        15, "Window of the sub-pixel step on counts, odd.", unit="px", minimum=5, maximum=61
    )
    uniqueness_percent: int = setting(
        10, "How much better than any other the best match must be.", unit="%", minimum=0,
        maximum=100,
    )  # fmt: skip
    left_right_px: int = setting(
        1, "Largest difference between matches from left and from right; -1 does not ask.",
        unit="px", minimum=-1, maximum=16,
    )  # fmt: skip
    max_sigma_px: float = setting(
        0.55, "Largest standard deviation of a disparity; rejects sky and bare surfaces.",
        unit="px", minimum=0.01, maximum=100.0,
    )  # fmt: skip
    speckle_px: int = setting(
        300, "Patches of fewer pixels are rejected.", unit="px", minimum=0, maximum=100_000
    )
    speckle_range_px: float = setting(
        1.0, "Neighbours in a patch differ by at most so much.", unit="px", minimum=0.1,
        maximum=16.0,
    )  # fmt: skip
    sky_contrast: float = setting(
        3.0, "Pixels beside an empty area that reaches the upper border, with less contrast than "
        "so many times the noise, are sky; 0 does not look for it.", minimum=0.0, maximum=100.0,
    )  # fmt: skip
    min_disparity_px: float = setting(
        1.0, "Smaller disparities (things too far away) are rejected.", unit="px", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip


@dataclass(frozen=True)
class DisparityMap:
    """Disparities of the left image.

    ``disparity_px`` (H, W) float32, ``x_left - x_right``, NaN where rejected; ``sigma_px`` (H, W)
    float32 its standard deviation, NaN where nothing was matched.  ``limits_px`` is the range that
    was searched.  ``camera`` is the rectified left one; ``right_cx`` the right one's principal
    point, ``baseline_m`` its distance.  ``counts`` (H, W) are those of the left image.
    """

    stamp_ns: int
    disparity_px: Map
    sigma_px: Map
    limits_px: tuple[float, float]
    camera: Camera
    right_cx: float
    baseline_m: float
    counts: NDArray[Any]

    @property
    def depth_m(self) -> Map:
        """(H, W) float32 along the optical axis; NaN where rejected, inf at and beyond infinity."""
        parallax = self.disparity_px - np.float32(self.camera.cx - self.right_cx)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.float32(self.camera.fx * self.baseline_m) / parallax
        return np.where(parallax > 0.0, depth, np.where(np.isnan(parallax), parallax, np.inf))

    @property
    def density(self) -> float:
        """Share of pixels with a disparity."""
        return float(np.isfinite(self.disparity_px).mean())


class DenseStereo:
    """Makes disparity maps; keeps scratch memory of one image size: one thread at a time."""

    def __init__(self, config: DenseConfig) -> None:
        self._config = config
        self._range = -(-config.disparities // _STEPS) * _STEPS
        block = config.block_px // 2 * 2 + 1
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._range,
            blockSize=block,
            P1=round(config.small_step * block * block),
            P2=round(max(config.large_step, config.small_step) * block * block) + 1,
            disp12MaxDiff=config.left_right_px,
            preFilterCap=63,
            uniquenessRatio=config.uniqueness_percent,
            speckleWindowSize=0,
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )
        self._refinement: Refinement | None = None
        self._shape: tuple[int, ...] = ()

    def process(self, frame: RigFrame) -> DisparityMap | None:
        """Disparities of a rectified frame, or None while an eye is blind."""
        config = self._config
        if LEFT not in frame.views or RIGHT not in frame.views:
            return None
        left, right = frame.views[LEFT], frame.views[RIGHT]
        rough = self._match(left.image, right.image)
        fine_left = smoothed(left.image, _FINE_PX)
        refined = self._refine(rough, fine_left, smoothed(right.image, _FINE_PX))
        disparity_px, sigma_px, noise_counts = refined
        self._reject(disparity_px, sigma_px, left, right)
        if config.sky_contrast > 0.0:
            disparity_px[sky(disparity_px, fine_left, config.sky_contrast * noise_counts)] = np.nan
        return DisparityMap(
            stamp_ns=frame.stamp_ns,
            disparity_px=disparity_px,
            sigma_px=sigma_px,
            limits_px=(0.0, float(self._range - 1)),
            camera=left.camera,
            right_cx=right.camera.cx,
            baseline_m=float(right.T_rig_camera[0, 3] - left.T_rig_camera[0, 3]),
            counts=left.image,
        )

    def _match(self, left: NDArray[Any], right: NDArray[Any]) -> Map:
        """(H, W) float32 disparities of the matcher, NaN where it has none."""
        config = self._config
        floor = config.noise_floor * max(fine_noise(left), fine_noise(right))
        window = config.window_px // 2 * 2 + 1
        # The matcher leaves out as many columns at the left as it searches.
        views = (
            cv2.copyMakeBorder(
                matching_view(smoothed(image, config.smoothing_px), window, floor),
                0, 0, self._range, 0, cv2.BORDER_REPLICATE,
            )
            for image in (left, right)
        )  # fmt: skip
        steps = self._matcher.compute(*views)[:, self._range :]
        matched = steps.astype(np.float32)
        matched *= 1.0 / _STEPS
        matched[steps < 0] = np.nan
        return np.asarray(matched, np.float32)

    def _refine(self, rough: Map, left: Map, right: Map) -> Refined:
        """Disparities and standard deviations after the step on counts."""
        if self._refinement is None or self._shape != rough.shape:
            self._shape = rough.shape
            height, width = rough.shape
            self._refinement = Refinement(height, width, self._config.refinement_px // 2 * 2 + 1)
        evened = np.where(np.isnan(rough), _FAR_AWAY, rough)
        evened = cv2.bilateralFilter(evened, 9, 1.0, 3.0)
        evened = np.where(np.isnan(rough), rough, evened)
        return self._refinement.refine(evened, left, right)

    def _reject(self, disparity: Map, sigma: Map, left: CameraView, right: CameraView) -> None:
        """Make NaN of what is not worth a point."""
        config = self._config
        columns = np.arange(disparity.shape[1], dtype=np.float32)
        with np.errstate(invalid="ignore"):
            good = (
                (sigma <= config.max_sigma_px)
                & (disparity >= config.min_disparity_px)
                & (disparity <= columns)
            )
        if left.mask is not None:
            good &= left.mask
        if right.mask is not None:
            seen_at = np.where(good, columns - disparity, 0.0).astype(np.intp)
            good &= np.take_along_axis(right.mask, seen_at, axis=1)
        disparity[~good] = np.nan
        if config.speckle_px > 0:
            steps = np.where(good, disparity * _STEPS, -_STEPS).astype(np.int16)
            cv2.filterSpeckles(
                steps, -_STEPS, config.speckle_px, round(config.speckle_range_px * _STEPS)
            )
            disparity[steps < 0] = np.nan


_FAR_AWAY = np.float32(-1000.0)
"""A disparity so different that a bilateral filter does not mix it with any other."""
