"""Points in the world with what cameras of two bands show of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.odometry.direct.photometric_window import PhotometricWindow, PointSet


def cloud_of(
    window: PhotometricWindow,
    points: PointSet,
    frame: RigFrame,
    roles: tuple[str, ...],
    T_rig_world: NDArray[np.float64],
) -> PointCloud:
    """The points, each with the grey level and the counts of the nearest pixel of a frame.

    NaN where a camera does not show it; ``T_rig_world`` (4, 4) of the frame.
    """
    shown = {role: np.full(len(points), np.nan, np.float32) for role in (VISIBLE, THERMAL)}
    for camera, role in enumerate(roles):
        view = frame.views.get(role)
        if view is None:
            continue
        height, width = view.image.shape
        at = window.pixels_in(points, camera, T_rig_world)
        inside = np.flatnonzero(np.all((at >= 0) & (at <= [width - 1, height - 1]), axis=1))
        x, y = np.rint(at[inside]).astype(int).T
        shown[role][inside] = view.image[y, x]
    return PointCloud(
        window.positions_m(points).astype(np.float32),
        shown[VISIBLE],
        thermal_counts=shown[THERMAL],
    )
