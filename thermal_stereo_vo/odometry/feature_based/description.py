"""FREAK descriptors (Alahi, Ortiz, Vandergheynst, CVPR 2012) of interest points, from OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.odometry.feature_based.fast_hessian import InterestPoints

WORDS = 8
"""A descriptor is 512 bits: 8 words of 64.  The first two words hold the coarsest comparisons."""


@dataclass(frozen=True)
class DescriptionConfig:
    """How interest points are described."""

    rotation_invariant: bool = setting(
        False,
        "Turn each descriptor to its own orientation; upright ones tell more apart and cost less "
        "while the rig rolls less than about 20 degrees between frames.",
    )
    pattern_scale: float = setting(
        22.0, "Size of the FREAK sampling pattern.", minimum=8.0, maximum=60.0
    )


@dataclass(frozen=True)
class Features:
    """Described points.

    ``pixels`` (N, 2) float32, ``descriptors`` (N, 8) uint64, ``response`` (N,) float32, ``bright``
    (N,) bool.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint64]
    response: NDArray[np.float32]
    bright: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.pixels)


class FreakDescriber:
    """Describes the points of one image at a time."""

    def __init__(self, config: DescriptionConfig) -> None:
        self._freak = cv2.xfeatures2d.FREAK_create(  # type: ignore[attr-defined]
            config.rotation_invariant, True, config.pattern_scale, 4
        )

    def describe(self, image: NDArray[np.uint8], points: InterestPoints) -> Features:
        """Features of an (H, W) 8-bit image; points too near to the border are dropped."""
        keypoints = [
            cv2.KeyPoint(x, y, size, -1, 0, 0, i)
            for i, ((x, y), size) in enumerate(
                zip(points.pixels.tolist(), points.size_px.tolist(), strict=True)
            )
        ]
        keypoints, descriptors = self._freak.compute(image, keypoints)
        if descriptors is None or len(keypoints) == 0:
            kept = np.zeros(0, np.int64)
            words = np.zeros((0, WORDS), np.uint64)
        else:
            kept = np.array([keypoint.class_id for keypoint in keypoints], np.int64)
            words = np.ascontiguousarray(descriptors).view(np.uint64)
        return Features(points.pixels[kept], words, points.response[kept], points.bright[kept])
