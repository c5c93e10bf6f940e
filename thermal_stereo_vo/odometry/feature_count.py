"""How many interest points an image offers: a measure of the image, not of a method's success."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.feature_based.fast_hessian import FastHessian, FastHessianConfig

_WITHOUT_END = 20_000


def fast_hessian_counter(threshold: float) -> Callable[[NDArray[np.uint8]], int]:
    """A function that counts the points of an (H, W) 8-bit image above a determinant.

    No cell is ever full, so that the count is that of the image alone.
    """
    detector = FastHessian(FastHessianConfig(threshold=threshold, features=_WITHOUT_END))
    return lambda image: len(detector.detect(image))
