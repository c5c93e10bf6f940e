"""One frame of a run for people: the pictures of both cameras, and the points in them."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.radiometry.agc import AutomaticGain

NEAR_M, FAR_M = 3.0, 60.0
DEPTH_PERCENTILES = (2.0, 98.0)


class Snapshot(Observer):
    """Keeps the latest frame with points up to the ``wanted``-th.

    Of two eyes ``first_image`` (H, W) uint8 is the left view and ``second_image`` (H, W, 3) uint8
    BGR the points that both see; of other rigs they are the depth maps of the first and the second
    camera, (H, W, 3) uint8 BGR.  None before the first.
    """

    wants_points = True

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._seen = 0
        self._frame: RigFrame | None = None
        self._T_world_rig: NDArray[np.float64] | None = None
        self._gain = AutomaticGain()
        self.roles: tuple[str, ...] = ()
        self.first_image: NDArray[np.uint8] | None = None
        self.second_image: NDArray[np.uint8] | None = None

    @property
    def depth_maps(self) -> dict[str, NDArray[np.uint8]]:
        """Role -> picture, where there are any."""
        images = (self.first_image, self.second_image)
        if self.roles == (LEFT, RIGHT):
            return {}
        return {
            role: image
            for role, image in zip(self.roles, images, strict=False)
            if image is not None
        }

    def on_rig_frame(self, frame: RigFrame) -> None:
        self._seen += 1
        self._frame = frame

    def on_result(self, result: OdometryResult) -> None:
        self._T_world_rig = result.T_world_rig

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        frame, T_world_rig = self._frame, self._T_world_rig
        late = self._seen > self._wanted and self.second_image is not None
        if late or frame is None or T_world_rig is None or len(cloud.xyz) == 0:
            return
        if len(frame.views) < 2:
            return
        self.roles = tuple(frame.views)
        frame = with_display(frame, self._gain)
        if self.roles == (LEFT, RIGHT):
            self.first_image = frame.views[LEFT].display
            self.second_image = draw_matches(frame, T_world_rig, cloud)
        else:
            first, second = self.roles
            self.first_image = draw_depths(frame, first, T_world_rig, cloud)
            self.second_image = draw_depths(frame, second, T_world_rig, cloud)


def with_display(frame: RigFrame, gain: AutomaticGain) -> RigFrame:
    """The frame with 8-bit views, by ``gain`` where the method did without."""
    return gain.process(frame) if any(v.display is None for v in frame.views.values()) else frame


def draw_points(
    frame: RigFrame, roles: tuple[str, str], T_world_rig: NDArray[np.float64], cloud: PointCloud
) -> NDArray[np.uint8] | None:
    """(H, W, 3) BGR: the matches of two eyes, the depths in the first camera of another rig.

    None while the views it needs are missing.
    """
    if roles == (LEFT, RIGHT):
        both = all(role in frame.views for role in roles)
        return draw_matches(frame, T_world_rig, cloud) if both else None
    return draw_depths(frame, roles[0], T_world_rig, cloud) if roles[0] in frame.views else None


def draw_depths(
    frame: RigFrame, role: str, T_world_rig: NDArray[np.float64], cloud: PointCloud
) -> NDArray[np.uint8]:
    """(H, W, 3) BGR: the 8-bit view of a camera with a dot at each point of the cloud.

    Near points are warm, far ones cold in colour, over the range of depths in the picture: the unit
    of length may be arbitrary.
    """
    view = frame.views[role]
    assert view.display is not None
    picture = cv2.cvtColor(view.display, cv2.COLOR_GRAY2BGR)
    in_camera = transform_points(inverse(T_world_rig @ view.T_rig_camera), cloud.xyz)
    pixels = view.camera.project(in_camera)
    inside = np.all((pixels >= 0.0) & (pixels <= np.subtract(view.camera.size, 1)), axis=1)
    if not np.any(inside):
        return np.asarray(picture, np.uint8)
    pixels, nearness = pixels[inside], 1.0 / in_camera[inside, 2]
    low, high = np.percentile(nearness, DEPTH_PERCENTILES)
    shares = (nearness - low) / max(high - low, 1e-12)
    for i in np.argsort(nearness):  # near points lie over far ones
        x, y = np.rint(pixels[i]).astype(int)
        cv2.circle(picture, (int(x), int(y)), 2, _colour(shares[i]), -1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


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
    for a, b, share in zip(here, there, np.nan_to_num(nearness), strict=True):
        if np.all(np.isfinite(a)) and np.all(np.isfinite(b)) and np.all(np.abs(a) < 1e4):
            start, colour = (round(a[0]), round(a[1])), _colour(share)
            cv2.line(picture, start, (round(b[0]), round(b[1])), colour, 1, cv2.LINE_AA)
            cv2.circle(picture, start, 3, colour, -1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def _colour(share: float) -> tuple[int, int, int]:
    """BGR of a share of nearness, 0 (cold) to 1 (warm)."""
    blue, green, red = _turbo()[int(255.0 * min(max(share, 0.0), 1.0)), 0].tolist()
    return blue, green, red


@functools.cache
def _turbo() -> NDArray[np.uint8]:
    """(256, 1, 3) BGR."""
    shades = np.arange(256, dtype=np.uint8).reshape(-1, 1)
    return np.asarray(cv2.applyColorMap(shades, cv2.COLORMAP_TURBO), np.uint8)
