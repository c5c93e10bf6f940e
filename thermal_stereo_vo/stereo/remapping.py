"""The image of one camera as an ideal pinhole would have taken it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera, DistortionModel
from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.frames import CameraView, RadiometricFrame


class RemappedCamera:
    """Turns frames of one raw camera into views through ``ideal``, a pinhole without distortion.

    ``R_ideal_raw`` (3, 3) turns axes of the raw camera into those of the ideal one; None leaves the
    images as they are.  Counts stay linear: bilinear interpolation, rounded to the input type, so
    that a chain of nodes and a replay see the same numbers.  ``T_rig_camera`` (4, 4) says where the
    ideal camera is; ``origin`` names the calibration for messages.
    """

    def __init__(
        self,
        raw: Camera,
        ideal: Camera,
        R_ideal_raw: NDArray[np.float64] | None,
        T_rig_camera: NDArray[np.float64],
        origin: str,
    ) -> None:
        self.camera = ideal
        self.T_rig_camera = T_rig_camera
        self._raw_size = raw.size
        self._origin = origin
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        self._mask: NDArray[np.bool_] | None = None
        if R_ideal_raw is not None:
            self._maps = _undistortion_maps(raw, R_ideal_raw, ideal)
            self._mask = _seen(self._maps[0], raw.size)

    def process(self, frame: RadiometricFrame, role: str) -> CameraView | None:
        """The view of a frame, or None while the camera is blind.

        Raises FrameError for an image of another size than the calibration's.
        """
        if frame.image is None:
            return None
        height, width = frame.image.shape
        if (width, height) != self._raw_size:
            raise FrameError(
                f"camera '{role}' gives {width}x{height} pixels, but the calibration "
                f"{self._origin} is for {self._raw_size[0]}x{self._raw_size[1]}: use "
                "the calibration of this camera and video mode"
            )
        image, mask = frame.image, frame.mask
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
            whole = self._mask
            if mask is not None:
                given = cv2.remap(mask.astype(np.uint8) * 255, *self._maps, cv2.INTER_LINEAR) == 255
                whole = given if whole is None else given & whole
            mask = whole
        return CameraView(
            image=image,
            camera=self.camera,
            T_rig_camera=self.T_rig_camera,
            mask=mask,
            epoch=frame.epoch,
            gap=frame.gap,
        )


def coefficients(camera: Camera) -> NDArray[np.float64]:
    """The distortion as OpenCV takes it."""
    if camera.model is DistortionModel.NONE:
        return np.zeros(5)
    return np.array(camera.distortion, dtype=np.float64)


def _undistortion_maps(
    raw: Camera, R: NDArray[np.float64], ideal: Camera
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    build = (
        cv2.fisheye.initUndistortRectifyMap
        if raw.model is DistortionModel.EQUIDISTANT
        else cv2.initUndistortRectifyMap
    )
    map_x, map_y = build(raw.matrix, coefficients(raw), R, ideal.matrix, ideal.size, cv2.CV_16SC2)
    return map_x, map_y


def _seen(map_xy: NDArray[np.int16], raw_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) True where all four neighbours of the sample lie in the raw image."""
    width, height = raw_size
    x, y = map_xy[..., 0], map_xy[..., 1]
    return (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
