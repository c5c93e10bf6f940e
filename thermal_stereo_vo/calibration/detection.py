"""Where the points of a target are in an image, whatever the kind of board."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from thermal_stereo_vo.calibration.normalisation import without_bad_pixels
from thermal_stereo_vo.calibration.targets import Target, TargetKind
from thermal_stereo_vo.calibration.views import Detection
from thermal_stereo_vo.core.errors import FrameError


def detect(image: NDArray[Any], target: Target) -> Detection:
    """Find the board in an (H, W) image of counts: uint8, uint16 or float.

    Never raises for image content: a refused view carries its reason.
    """
    if image.ndim != 2:
        raise FrameError(
            f"a board is looked for in single-channel images, not in shape {image.shape}"
        )
    if image.size == 0 or image.max() == image.min():
        return Detection(None, "the image is empty or uniform")
    image = without_bad_pixels(image)
    if target.kind is TargetKind.CHESSBOARD:
        from thermal_stereo_vo.calibration.chessboard_detection import detect_chessboard

        return detect_chessboard(image, target)
    if target.kind is TargetKind.MASK:
        from thermal_stereo_vo.calibration.mask_detection import detect_mask

        return detect_mask(image, target)
    from thermal_stereo_vo.calibration.circle_detection import detect_circles

    return detect_circles(image, target)
