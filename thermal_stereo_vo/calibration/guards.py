"""Refusals and warnings: too few views, views all alike, views badly spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.views import BoardView, camera_called
from thermal_stereo_vo.core.errors import CalibrationError

if TYPE_CHECKING:
    from thermal_stereo_vo.calibration.result import CameraResult

Array = NDArray[np.float64]

MIN_VIEWS = 5
_GOOD_VIEWS = 12
_ALIKE_FRACTION = 0.01
_MIN_COVERAGE = 0.6
_MIN_TILT_RAD = np.radians(25.0)
_FOCAL_WARNING, _FOCAL_REFUSAL = 0.005, 0.05


def check_enough(views: Sequence[BoardView], who: str) -> None:
    """Raise CalibrationError for fewer than five views."""
    if len(views) < MIN_VIEWS:
        count = "no view" if not views else f"only {len(views)} view{'s' * (len(views) > 1)}"
        raise CalibrationError(
            f"{count} of the board usable for {who}: at least {MIN_VIEWS} are needed, 20 to 25 are "
            "good; the reasons for refused views are listed above each"
        )


def check_distinct(views: Sequence[BoardView], role: str, size: tuple[int, int]) -> None:
    """Raise CalibrationError when the views are all alike."""
    distinct = count_distinct(views, _ALIKE_FRACTION * size[0])
    if distinct < MIN_VIEWS:
        raise CalibrationError(
            f"the {len(views)} views of {camera_called(role)} are all alike (more than "
            f"{_ALIKE_FRACTION * size[0]:.0f} px apart: {distinct}): move and tilt the board"
        )


def count_distinct(views: Sequence[BoardView], apart_px: float) -> int:
    """Views that differ from each earlier distinct one by ``apart_px`` RMS on common points."""
    distinct: list[BoardView] = []
    for view in views:
        if all(_distance(view, other) > apart_px for other in distinct):
            distinct.append(view)
    return len(distinct)


def _distance(a: BoardView, b: BoardView) -> float:
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(i) == 0:
        return float("inf")
    return float(np.sqrt(np.mean(np.sum((a.pixels[i] - b.pixels[j]) ** 2, axis=1))))


def tilt_range(rotations: Sequence[Array]) -> float:
    """Largest angle (rad) between two board normals, from (3, 3) R_camera_board."""
    normals = np.array([R[:, 2] for R in rotations])
    return float(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))


def spread_warnings(camera: CameraResult, role: str, views: int) -> list[str]:
    """What is wrong with the number, place and tilt of the views of one camera."""
    warnings = []
    if views < _GOOD_VIEWS:
        warnings.append(f"{role}: only {views} views; 20 to 25 make the figures trustworthy")
    covered = float(camera.coverage.mean())
    if covered < _MIN_COVERAGE:
        warnings.append(
            f"{role}: the board covered {100 * covered:.0f} % of the image; show it in the empty "
            "parts of the coverage map too, else distortion is a guess there"
        )
    if camera.tilt_range_rad < _MIN_TILT_RAD:
        warnings.append(
            f"{role}: the board was tilted by {np.degrees(camera.tilt_range_rad):.0f} deg at most; "
            "tilt it by 20 to 45 deg in different directions, else focal length and distance "
            "cannot be told apart"
        )
    return warnings


def uncertainty_warnings(camera: CameraResult, role: str) -> list[str]:
    """Warn of an uncertain focal length.  Raises CalibrationError when it is useless."""
    relative = float(camera.sigma[0] / camera.camera.fx)
    if relative > _FOCAL_REFUSAL:
        raise CalibrationError(
            f"the views do not determine {camera_called(role)}: focal length "
            f"{camera.camera.fx:.0f} +- {camera.sigma[0]:.0f} px; tilt the board by 20 to 45 "
            "deg in different directions and show it in all parts of the image"
        )
    if relative > _FOCAL_WARNING:
        return [
            f"{role}: the focal length is known to {100 * relative:.1f} % only "
            f"({camera.camera.fx:.1f} +- {camera.sigma[0]:.1f} px)"
        ]
    return []
