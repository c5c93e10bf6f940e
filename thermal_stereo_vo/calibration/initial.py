"""First guesses: lens by OpenCV, board poses by homography, the rig by the most agreed sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.calibration.targets import Target, TargetKind
from thermal_stereo_vo.calibration.views import BoardView, camera_called
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse, log_so3, make_transform

Array = NDArray[np.float64]

_MAX_INITIAL_VIEWS = 20
_FOCAL_WIDTHS = (0.7, 1.2, 2.0)


def initial_lens(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], lens: Lens, role: str
) -> Array:
    """Lens parameters of one camera from a spread of its views, by ``cv2.calibrateCamera``.

    Its own first guess needs well tilted boards; some more focal lengths are tried beside it, as
    a wrong valley is left by no later step.

    Raises CalibrationError when OpenCV finds no camera that could have taken them.
    """
    step = max(1, -(-len(views) // _MAX_INITIAL_VIEWS))
    some = list(views)[::step]
    points = target.points_m.astype(np.float32)
    start = Lens.RADTAN2 if lens is Lens.EQUIDISTANT else lens
    width, height = size
    guesses: list[Array | None] = [None]
    guesses += [
        np.array([[f * width, 0.0, 0.5 * width], [0.0, f * width, 0.5 * height], [0.0, 0.0, 1.0]])
        for f in _FOCAL_WIDTHS
    ]
    found, trouble = [], ""
    for guess in guesses:
        flags = start.calibration_flags
        try:
            rms, matrix, coefficients, _, _ = cv2.calibrateCamera(
                [points[view.ids] for view in some],
                [view.pixels.astype(np.float32) for view in some],
                size,
                guess,
                None if guess is None else np.zeros(start.opencv_count),
                flags=flags if guess is None else flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            )
            found.append((float(rms), matrix, coefficients))
        except cv2.error as error:
            trouble = error.err.strip()
    if not found:
        raise CalibrationError(
            f"the views of {camera_called(role)} do not determine a camera ({trouble}): tilt the "
            "board in different directions"
        )
    sane = [f for f in found if _is_sane(f[1], width)]
    _, matrix, coefficients = min(sane or found, key=lambda f: f[0])
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    if not sane:
        raise CalibrationError(
            f"the views of {camera_called(role)} do not determine its focal length (OpenCV says "
            f"{fx:.0f} x {fy:.0f} px): tilt the board by 20 to 45 degrees in different directions"
        )
    vector = np.zeros(len(lens.names))
    vector[:4] = fx, fy, float(np.clip(cx, 0, width)), float(np.clip(cy, 0, height))
    if lens is not Lens.EQUIDISTANT:
        known = coefficients.ravel()[: len(vector) - 4]
        vector[4 : 4 + len(known)] = known
    return vector


def _is_sane(matrix: Array, width: int) -> bool:
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    return 0.2 * width < fx < 20.0 * width and 0.5 < fx / fy < 2.0


def board_pose(camera: Camera, points_m: Array, pixels: Array) -> Array:
    """(4, 4) T_camera_board of a flat board from points (K, 3) and pixels (K, 2).

    Of the two poses that look alike from afar the one that reprojects better.
    """
    rays = camera.unproject(pixels)[:, :2]
    object_points = np.ascontiguousarray(points_m).reshape(-1, 1, 3)
    image_points = np.ascontiguousarray(rays).reshape(-1, 1, 2)
    count, rotations, translations, errors = cv2.solvePnPGeneric(
        object_points, image_points, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    candidates = [
        (float(np.ravel(errors[i])[0]), rotations[i], translations[i]) for i in range(count)
    ]
    candidates.sort(key=lambda candidate: candidate[0])
    for _, rotation, translation in candidates:
        _, rotation, translation = cv2.solvePnP(
            object_points,
            image_points,
            np.eye(3),
            None,
            rotation,
            translation,
            useExtrinsicGuess=True,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
        if translation.ravel()[2] > 0:
            return make_transform(cv2.Rodrigues(rotation)[0], translation.ravel())
    raise CalibrationError("no pose of the board explains one of the views: check the board size")


def half_turn(view: BoardView, target: Target) -> BoardView:
    """The same view with the board numbered from the other end."""
    return BoardView(
        ids=np.ascontiguousarray((target.count - 1 - view.ids)[::-1]),
        pixels=np.ascontiguousarray(view.pixels[::-1]),
        sigma_px=np.ascontiguousarray(view.sigma_px[::-1]),
        blur_px=view.blur_px,
        contrast=view.contrast,
    )


def has_half_turn(target: Target) -> bool:
    """Whether half a turn of the board goes unnoticed, as shades may swap in thermal images."""
    return target.kind in (TargetKind.CHESSBOARD, TargetKind.CIRCLES)


def agreed_place(samples: Mapping[int, Sequence[Array]]) -> tuple[Array, dict[int, int]]:
    """The place most shots agree on, and which sample of each shot is nearest to it.

    ``samples`` holds for each shot (by its index) the (4, 4) T_second_first under each numbering of
    the board.
    """
    flat = [(name, k, T) for name, options in samples.items() for k, T in enumerate(options)]
    best, T_best = np.inf, flat[0][2]
    for _, _, T in flat:
        apart = [min(_apart(T, other) for other in options) for options in samples.values()]
        score = float(np.median(apart))
        if score < best:
            best, T_best = score, T
    chosen = {
        name: int(np.argmin([_apart(T_best, T) for T in options]))
        for name, options in samples.items()
    }
    return T_best, chosen


def _apart(T_a: Array, T_b: Array) -> float:
    """Radians of rotation plus translation in units of the longer one."""
    turn = float(np.linalg.norm(log_so3(T_a[:3, :3].T @ T_b[:3, :3])))
    length = max(float(np.linalg.norm(T_a[:3, 3])), float(np.linalg.norm(T_b[:3, 3])), 1e-6)
    return turn + float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])) / length


def relative_place(T_first_board: Array, T_second_board: Array) -> Array:
    """(4, 4) T_second_first from one shot."""
    return T_second_board @ inverse(T_first_board)
