"""The cameras of a rig as the kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.core.transforms import inverse


@dataclass(frozen=True)
class Rig:
    """C cameras without distortion.

    ``cameras`` (C, 4) fx fy cx cy in px; ``T_rig_camera`` and ``T_camera_rig`` (C, 4, 4);
    ``shapes`` (height, width) of each image.
    """

    cameras: NDArray[np.float64]
    T_rig_camera: NDArray[np.float64]
    T_camera_rig: NDArray[np.float64]
    shapes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, views: Sequence[CameraView]) -> Rig:
        """The rig that these views make up.  Raises CalibrationError for a lens that bends rays."""
        for view in views:
            if view.camera.has_distortion:
                raise CalibrationError(
                    "the direct methods need images of lenses that do not bend rays: rectify first"
                )
        parameters = [[v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy] for v in views]
        T_rig_camera = np.stack([np.asarray(v.T_rig_camera, np.float64) for v in views])
        return cls(
            np.array(parameters, np.float64),
            T_rig_camera,
            np.stack([inverse(T) for T in T_rig_camera]),
            tuple(v.image.shape for v in views),
        )

    @property
    def steps(self) -> NDArray[np.float64]:
        """(C, 2) how far one pixel is in the normalised plane of each camera."""
        return 1.0 / self.cameras[:, :2]

    def bearings(self, camera: int, pixels: NDArray[np.generic]) -> NDArray[np.float64]:
        """(N, 3) directions (x, y, 1) of (N, 2) pixels of one camera."""
        fx, fy, cx, cy = self.cameras[camera]
        x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
        return np.stack([x, y, np.ones(len(pixels))], axis=1)

    def pixels_of(
        self,
        camera: int,
        T_rig_host: NDArray[np.float64],
        bearings: NDArray[np.float64],
        rhos: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """(N, 2) pixels of points given by bearing (N, 3) and inverse depth (N,) in a host camera.

        ``T_rig_host`` (4, 4), or (N, 4, 4) one for each.  NaN behind the camera.
        """
        fx, fy, cx, cy = self.cameras[camera]
        T = self.T_camera_rig[camera] @ T_rig_host
        turned = np.einsum("...ij,...j->...i", T[..., :3, :3], bearings)
        q = turned + rhos[:, None] * T[..., :3, 3]
        z = np.where(q[:, 2] > 1e-3, q[:, 2], np.nan)
        return np.stack([fx * q[:, 0] / z + cx, fy * q[:, 1] / z + cy], axis=1)
