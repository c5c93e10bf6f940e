"""Stereo odometry from OpenCV's parts alone, to measure the same machine in the same minute.

Shi-Tomasi corners, pyramidal Lucas-Kanade from left to right and from frame to frame, and
``solvePnPRansac``: what one would write in an afternoon.  Times of different machines, or of one
machine at different hours, can be compared by their ratio to this.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import inverse, make_transform

Pixels = NDArray[np.float32]

CORNERS = 1000
QUALITY = 0.005
MIN_DISTANCE_PX = 8.0
WINDOW_PX = 15
TOP_LEVEL = 3
ROW_TOLERANCE_PX = 1.5
MIN_DISPARITY_PX = 0.5
INLIER_PX = 1.0
MIN_INLIERS = 10
RANSAC_ITERATIONS = 200
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)


@dataclass(frozen=True)
class _Reference:
    """Corners of the last frame: (N, 2) px in its left image, (N, 3) m in its left camera."""

    image: NDArray[np.uint8]
    pixels: Pixels
    points_m: NDArray[np.float64]


class OpenCvBaseline:
    """Frame to frame: corners, optical flow, perspective-n-point.

    Takes rectified frames with an 8-bit view.  A motion that cannot be measured is the last one
    again (status GAP).
    """

    def __init__(self) -> None:
        self._reference: _Reference | None = None
        self._T_world_rig = np.eye(4)
        self._T_current_previous = np.eye(4)

    def process(self, frame: RigFrame) -> OdometryResult:
        """Estimate the pose of the left camera at this frame.

        Raises FrameError when a view is missing or has no 8-bit form.
        """
        left, right = _display(frame, LEFT), _display(frame, RIGHT)
        views = frame.views[LEFT], frame.views[RIGHT]
        status, inliers = TrackingStatus.INITIALISING, 0
        if self._reference is not None:
            found = self._measure(self._reference, left, views[0].camera.matrix)
            status = TrackingStatus.GAP
            if found is not None:
                self._T_current_previous, inliers = found
                status = TrackingStatus.TRACKING
            self._T_world_rig = self._T_world_rig @ inverse(self._T_current_previous)
        self._reference = _look(left, right, *views)
        stats = TrackStats(features=len(self._reference.pixels), inliers=inliers)
        return OdometryResult(frame.stamp_ns, status, self._T_world_rig.copy(), None, stats=stats)

    def _measure(
        self, reference: _Reference, image: NDArray[np.uint8], K: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int] | None:
        """(4, 4) T_current_previous and the number of inliers, or None."""
        if len(reference.pixels) < MIN_INLIERS:
            return None
        pixels, found = _flow(reference.image, image, reference.pixels)
        if int(found.sum()) < MIN_INLIERS:
            return None
        points_m = reference.points_m[found].astype(np.float64)
        seen_px = pixels[found].astype(np.float64)
        cv2.setRNGSeed(0)
        solved, rotation, translation, chosen = cv2.solvePnPRansac(
            points_m,
            seen_px,
            K,
            None,
            iterationsCount=RANSAC_ITERATIONS,
            reprojectionError=INLIER_PX,
            confidence=0.999,
        )
        if not solved or chosen is None or len(chosen) < MIN_INLIERS:
            return None
        index = chosen.ravel()
        rotation, translation = cv2.solvePnPRefineLM(
            points_m[index], seen_px[index], K, None, rotation, translation
        )
        T = make_transform(cv2.Rodrigues(rotation)[0], translation.ravel())
        return T, len(index)


def _look(
    left: NDArray[np.uint8], right: NDArray[np.uint8], left_view: CameraView, right_view: CameraView
) -> _Reference:
    """Corners of the left image whose partner in the right image gives a depth."""
    mask = None if left_view.mask is None else left_view.mask.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(left, CORNERS, QUALITY, MIN_DISTANCE_PX, mask=mask)
    if corners is None:
        return _Reference(left, np.zeros((0, 2), np.float32), np.zeros((0, 3)))
    pixels = corners.reshape(-1, 2)
    partners, found = _flow(left, right, pixels)
    a, b = left_view.camera, right_view.camera
    disparity = (pixels[:, 0] - a.cx) - (partners[:, 0] - b.cx)
    found &= np.abs(pixels[:, 1] - partners[:, 1]) < ROW_TOLERANCE_PX
    found &= disparity > MIN_DISPARITY_PX
    pixels, disparity = pixels[found], disparity[found]
    depth_m = a.fx * float(right_view.T_rig_camera[0, 3]) / disparity
    rays = (pixels - (a.cx, a.cy)) / (a.fx, a.fy)
    points_m = np.column_stack([rays * depth_m[:, None], depth_m])
    return _Reference(left, pixels, points_m)


def _flow(
    image: NDArray[np.uint8], other: NDArray[np.uint8], pixels: Pixels
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Where (N, 2) pixels of one image lie in the other, and which were found."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        image,
        other,
        pixels.reshape(-1, 1, 2),
        None,
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=TOP_LEVEL,
        criteria=_STOP,
    )
    found = status.ravel() == 1
    moved = moved.reshape(-1, 2)
    height, width = other.shape
    found &= np.all((moved >= 0) & (moved <= (width - 1, height - 1)), axis=1)
    return moved, found


def _display(frame: RigFrame, role: str) -> NDArray[np.uint8]:
    view = frame.views.get(role)
    if view is None or view.display is None:
        raise FrameError(
            f"the OpenCV baseline needs an 8-bit view of the {role} eye: run the frame through "
            "the AGC, and leave out frames on which an eye is blind"
        )
    return view.display
