"""The cameras of a rig as the kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import CameraView
from thermal_stereo_vo.core.transforms import inverse


@dataclass(frozen=True)
class Rig:
    """C cameras without distortion.

    ``cameras`` (C, 4) fx fy cx cy in px; ``T_rig_camera`` and ``T_camera_rig`` (C, 4, 4);
    ``shapes`` (height, width) of each image.  With ``bands`` they see different bands, so that only
    images of one and the same camera look alike.  ``bolometers`` (C,) bool which of them have an
    unbounded range of brightness and are ``lags_s`` (C,) late.
    """

    cameras: NDArray[np.float64]
    T_rig_camera: NDArray[np.float64]
    T_camera_rig: NDArray[np.float64]
    shapes: tuple[tuple[int, int], ...]
    bands: bool
    bolometers: NDArray[np.bool_]
    lags_s: NDArray[np.float64]

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
            False,
            np.zeros(len(views), np.bool_),
            np.zeros(len(views)),
        )

    def of_bands(self, bolometers: Sequence[bool]) -> Rig:
        """The same cameras, of different bands."""
        return replace(self, bands=True, bolometers=np.array(bolometers))

    def with_arms(self, factor: float) -> Rig:
        """The same cameras, lever arms ``factor`` times as long."""
        T_rig_camera = with_arms(self.T_rig_camera, factor)
        T_camera_rig = np.stack([inverse(T) for T in T_rig_camera])
        return replace(self, T_rig_camera=T_rig_camera, T_camera_rig=T_camera_rig)

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
        return self.project(camera, self.T_camera_rig[camera] @ T_rig_host, bearings, rhos)

    def project(
        self,
        camera: int,
        T_camera_host: NDArray[np.float64],
        bearings: NDArray[np.float64],
        rhos: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """As ``pixels_of``, from the camera itself: ``T_camera_host`` (4, 4) or (N, 4, 4)."""
        fx, fy, cx, cy = self.cameras[camera]
        T = T_camera_host
        turned = np.einsum("...ij,...j->...i", T[..., :3, :3], bearings)
        q = turned + rhos[:, None] * T[..., :3, 3]
        z = np.where(q[:, 2] > 1e-3, q[:, 2], np.nan)
        return np.stack([fx * q[:, 0] / z + cx, fy * q[:, 1] / z + cy], axis=1)


def with_arms(T_rig_camera: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """(C, 4, 4) the same cameras, lever arms ``factor`` times as long."""
    out = T_rig_camera.copy()
    out[:, :3, 3] *= factor
    return out
