"""One frame of a run for people: the left picture, and the points that both eyes see in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.observers import Observer

NEAR_M, FAR_M = 3.0, 60.0


class Snapshot(Observer):
    """Keeps the latest frame with points up to the ``wanted``-th.

    ``left_image`` (H, W) uint8 and ``matches_image`` (H, W, 3) uint8 BGR, None before the first.
    """

    wants_points = True

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._seen = 0
        self._frame: RigFrame | None = None
        self._T_world_rig: NDArray[np.float64] | None = None
        self.left_image: NDArray[np.uint8] | None = None
        self.matches_image: NDArray[np.uint8] | None = None

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._seen += 1
        self._frame = frame

    def on_result(self, result: OdometryResult) -> None:
        self._T_world_rig = result.T_world_rig

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        frame, T_world_rig = self._frame, self._T_world_rig
        late = self._seen > self._wanted and self.matches_image is not None
        if late or frame is None or T_world_rig is None or len(cloud.xyz) == 0:
            return
        left = frame.views.get(LEFT)
        if left is None or left.display is None or RIGHT not in frame.views:
            return
        self.left_image = left.display
        self.matches_image = draw_matches(frame, T_world_rig, cloud)


def draw_matches(
    frame: RigFrame, T_world_rig: NDArray[np.float64], cloud: PointCloud
) -> NDArray[np.uint8]:
    """(H, W, 3) BGR: the left eye's 8-bit view with a dot at each point of the cloud.

    Near points are warm, far ones cold in colour; a line leads to the column of the right eye.
    """
    left, right = frame.views[LEFT], frame.views[RIGHT]
    assert left.display is not None
    picture = cv2.cvtColor(left.display, cv2.COLOR_GRAY2BGR)
    in_rig = transform_points(inverse(T_world_rig), cloud.xyz)
    here = left.camera.project(transform_points(inverse(left.T_rig_camera), in_rig))
    there = right.camera.project(transform_points(inverse(right.T_rig_camera), in_rig))
    with np.errstate(invalid="ignore", divide="ignore"):
        nearness = np.log(in_rig[:, 2] / FAR_M) / np.log(NEAR_M / FAR_M)
    shades = np.nan_to_num(255.0 * np.clip(nearness, 0.0, 1.0)).astype(np.uint8)
    colours = cv2.applyColorMap(shades.reshape(-1, 1), cv2.COLORMAP_TURBO).reshape(-1, 3)
    for a, b, colour in zip(here, there, colours.tolist(), strict=True):
        if np.all(np.isfinite(a)) and np.all(np.isfinite(b)) and np.all(np.abs(a) < 1e4):
            start = (round(a[0]), round(a[1]))
            cv2.line(picture, start, (round(b[0]), round(b[1])), colour, 1, cv2.LINE_AA)
            cv2.circle(picture, start, 3, colour, -1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)
