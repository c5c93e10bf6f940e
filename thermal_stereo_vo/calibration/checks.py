"""Mistakes that a small reprojection error hides: turned the wrong way, swapped, wrongly scaled.

Table III of P1 holds an example: one tool reached the third best reprojection error (0.22 px) and
an epipolar error of 9.7 px, with a rotation vector of opposite sign to the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.figures import PairView, StereoErrors, stereo_errors
from thermal_stereo_vo.calibration.result import PairResult
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.core.cameras import Camera, RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse, make_transform

Array = NDArray[np.float64]

_MUCH_BETTER = 0.4
_SCALE_LIMIT = 0.01
_YAW_LIMIT_RAD = 1e-3


@dataclass(frozen=True)
class Verdict:
    """How a given calibration explains the views, and what is wrong with it.

    ``alternatives`` are the figures with one mistake undone: transposed rotation, inverse motion,
    swapped eyes, translation of the other sign.
    """

    errors: StereoErrors
    alternatives: Mapping[str, StereoErrors]
    findings: tuple[str, ...]


def verify(
    calibration: RigCalibration,
    roles: Sequence[str],
    target: Target,
    views: Sequence[PairView],
) -> Verdict:
    """Judge a calibration, from wherever it came, by board views of the same rig.

    Raises CalibrationError when the calibration lacks a camera or there are no views.
    """
    if not views:
        raise CalibrationError("no view shows the board to both cameras: nothing to verify with")
    first, second = (calibration[role].camera for role in roles)
    T = inverse(calibration.T_a_b(roles[0], roles[1]))
    errors = stereo_errors(first, second, T, target, views)
    swapped = [PairView(v.name, v.ids, v.second, v.first) for v in views]
    alternatives = {
        "rotation transposed": _tried(first, second, _transposed(T), target, views),
        "motion inverted": _tried(first, second, inverse(T), target, views),
        "translation reversed": _tried(first, second, _reversed(T), target, views),
        "eyes swapped": _tried(first, second, T, target, swapped),
    }
    return Verdict(errors, alternatives, tuple(_findings(errors, alternatives, T, target)))


def check_known_baseline(pair: PairResult, target: Target, known_m: float) -> None:
    """Raise CalibrationError when a baseline measured otherwise contradicts the board's scale."""
    ratio = pair.baseline_m / known_m
    allowed = max(_SCALE_LIMIT, 3.0 * pair.baseline_sigma_m / known_m)
    if abs(ratio - 1.0) > allowed:
        raise CalibrationError(
            f"the cameras come out {1e3 * pair.baseline_m:.1f} mm apart, but {1e3 * known_m:.1f} "
            f"mm are known ({100 * (ratio - 1):+.1f} %): with squares of "
            f"{1e3 * target.spacing_m / ratio:.2f} mm instead of {1e3 * target.spacing_m:.2f} mm "
            "both would agree; measure the board and correct --board (or --baseline)"
        )


def check_eyes(pair: PairResult, roles: Sequence[str]) -> None:
    """Raise CalibrationError when the right camera comes out to the left of the left one."""
    if tuple(roles) != ("left", "right"):
        return
    offset_m = inverse(pair.T_second_first)[:3, 3]
    if offset_m[0] < 0.0 and abs(offset_m[0]) > 0.5 * pair.baseline_m:
        raise CalibrationError(
            f"the eyes are swapped: the right camera lies {1e3 * pair.baseline_m:.1f} mm to the "
            "LEFT of the left one; exchange the two sources (or topics)"
        )


def _tried(
    first: Camera, second: Camera, T: Array, target: Target, views: Sequence[PairView]
) -> StereoErrors:
    return stereo_errors(first, second, T, target, views)


def _transposed(T: Array) -> Array:
    return make_transform(T[:3, :3].T, T[:3, 3])


def _reversed(T: Array) -> Array:
    return make_transform(T[:3, :3], -T[:3, 3])


def _epipolar(errors: StereoErrors) -> float:
    return 0.5 * (errors.epipolar_12_px + errors.epipolar_21_px)


def _behind(sound: Mapping[str, StereoErrors]) -> str:
    """Which mistake put the points behind the cameras: the one that explains them best undone."""
    advice = {
        "eyes swapped": "exchange the left and the right images (or cameras)",
        "motion inverted": "the file gives the motion from right to left: invert it",
        "translation reversed": "turn the sign of the translation",
    }
    # Eyes of like lenses cannot tell an inverted motion from exchanged images: name both then.
    best_px = min((_epipolar(sound[name]) for name in advice if name in sound), default=0.0)
    likely = [n for n in advice if n in sound and _epipolar(sound[n]) <= 1.2 * best_px + 0.02]
    if not likely:
        return "the points come out behind the cameras: the motion is wrong"
    return (
        f"{' or '.join(likely)}: the points come out behind the cameras, and in front with this "
        f"undone; {', or '.join(advice[name] for name in likely)}"
    )


def _findings(
    errors: StereoErrors, alternatives: Mapping[str, StereoErrors], T: Array, target: Target
) -> list[str]:
    found: list[str] = []
    usual_px = _epipolar(errors)
    sound = {
        name: other
        for name, other in alternatives.items()
        if other.in_front > 0.9 and _epipolar(other) < max(2.0 * usual_px, 1.0)
    }
    if errors.in_front < 0.5:
        return [_behind(sound)]
    transposed = alternatives["rotation transposed"]
    if _epipolar(transposed) < _MUCH_BETTER * usual_px and usual_px > 0.5:
        found.append(
            f"rotation transposed: the epipolar error of {usual_px:.2f} px falls to "
            f"{_epipolar(transposed):.2f} px with the transposed rotation; the file was written "
            "with row vectors where column vectors are meant, or the other way round"
        )
        return found
    scale = 1.0 + errors.spacing_error_percent / 100.0
    if abs(scale - 1.0) > _SCALE_LIMIT:
        baseline_m = float(np.linalg.norm(T[:3, 3]))
        found.append(
            f"wrong scale: corners lie {100 * (scale - 1):+.1f} % apart; either the squares are "
            f"{1e3 * target.spacing_m * scale:.2f} mm and not {1e3 * target.spacing_m:.2f} mm, or "
            f"the baseline is {1e3 * baseline_m / scale:.1f} mm and not {1e3 * baseline_m:.1f} mm"
        )
    if abs(errors.yaw_error_rad) > _YAW_LIMIT_RAD:
        found.append(
            f"relative yaw off by {1e3 * errors.yaw_error_rad:+.2f} mrad: distances by both eyes "
            "and by one drift apart as the board goes away, which no epipolar error shows"
        )
    return found
