"""What is left of the stereo extrinsics after rectification, watched and refined in flight.

A yaw of the right eye by a tenth of a milliradian shifts all disparities by 0.05 px at a focal
length of 500 px, which is 0.5 % of the scale for points at a disparity of 10 px.  Pitch and roll
show in the rows at once.  Yaw does not: points of different depth must agree on the motion of the
rig, which bundle adjustment tells.  Images cannot tell the length of the baseline: it stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.odometry.feature_based.bundle_adjustment import BundleSolution
from thermal_stereo_vo.odometry.feature_based.frame_pose import robust_sigma
from thermal_stereo_vo.odometry.feature_based.keyframe_window import KeyframeWindow
from thermal_stereo_vo.odometry.information import inverse_information

LEAST_ROWS = 12
PLENTY = 50
"""Times the information that an angle needs: so much is remembered."""


@dataclass(frozen=True)
class ExtrinsicsConfig:
    """Whether, and how far, the rotation of the right camera is refined in flight."""

    refine: bool = setting(
        True, "Refine pitch, yaw and roll of the right eye while flying; the baseline stays."
    )
    sigma_mrad: float = setting(
        0.1,
        "How far each angle of the calibration may be off (1 sigma).",
        unit="mrad",
        minimum=0.001,
        maximum=20.0,
    )
    images_sigma_mrad: float = setting(
        0.1,
        "How well images can tell an angle at best, however many there are (1 sigma): what the "
        "calibration leaves of the lens distortion looks like a turn too.",
        unit="mrad",
        minimum=0.001,
        maximum=20.0,
    )
    scale_share: float = setting(
        0.15,
        "Share of odometry.status.scale_sigma that remains where the rotation is refined: baseline "
        "and focal length, which a board tells to 0.03 %, without the yaw.",
        minimum=0.0,
        maximum=1.0,
    )


class ExtrinsicsRefiner:
    """Gathers what rows and bundle adjustments say of the turn of the right eye.

    ``turn_rad`` (3,) pitch, yaw and roll (about x, y, z) is the estimate: between the calibration,
    which says none, and what the images say.
    """

    def __init__(self, config: ExtrinsicsConfig, keyframes: int) -> None:
        self._config = config
        # A point stays in sight for about as many keyframes as the window holds; what it says of
        # the turn is the same each time.
        self._share = 1.0 / keyframes
        self._most = 1.0 / (1e-3 * config.images_sigma_mrad) ** 2
        self._prior = 1.0 / (1e-3 * config.sigma_mrad) ** 2
        self.turn_rad = np.zeros(3)
        self._images_rad = np.zeros(3)
        self._information = np.zeros(3)

    @property
    def turn_mrad(self) -> tuple[float, float, float]:
        """The estimate for people: pitch, yaw, roll."""
        pitch, yaw, roll = (1e3 * self.turn_rad).tolist()
        return pitch, yaw, roll

    def learn(self, window: KeyframeWindow, solution: BundleSolution) -> None:
        """Take in a window that was just adjusted with the present turn."""
        if not self._config.refine:
            return
        pitch_roll, row_information = turn_in_rows(window, window.seen_by_newest())
        yaw_information = float(solution.turn_information[1, 1])
        yaw = float(solution.turn_score[1]) / yaw_information if yaw_information > 0.0 else 0.0
        missing = np.array([pitch_roll[0], yaw, pitch_roll[1]])
        information = self._share * np.array(
            [row_information[0], max(yaw_information, 0.0), row_information[1]]
        )
        if not (np.all(np.isfinite(missing)) and np.all(np.isfinite(information))):
            return
        total = np.maximum(self._information + information, 1e-9)
        told = self.turn_rad + missing
        self._images_rad = self._images_rad + (told - self._images_rad) * information / total
        # Once there is plenty, the old fades as the new comes.
        self._information = np.minimum(total, PLENTY * self._most)
        weight = np.minimum(total, self._most)
        self.turn_rad = self._images_rad * weight / (weight + self._prior)


def turn_in_rows(
    window: KeyframeWindow, observed: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What (N, 4) observations say of pitch and roll beyond the window's present turn.

    Returns (2,) rad and the (2,) 1/rad^2 information of each; zeros where there are too few.  To
    first order the row of the right eye is that of the left plus ``fy (-(1 + y^2), x y, x) . turn``
    at the tangents (x, y) of the right eye.
    """
    both = observed[np.all(np.isfinite(observed), axis=1)]
    if len(both) < LEAST_ROWS:
        return np.zeros(2), np.zeros(2)
    camera = window.camera
    x = (both[:, 2] - camera.cx_right) / camera.fx
    y = (both[:, 3] - camera.cy) / camera.fy
    J = camera.fy * np.stack([-(1.0 + y * y), x * y, x], axis=1)
    residuals = both[:, 3] - both[:, 1] - J @ window.right_turn_rad
    centre_px = float(np.median(residuals))
    sigma_px = max(robust_sigma(residuals - centre_px), 0.02)
    good = np.abs(residuals - centre_px) < 3.0 * sigma_px
    J, residuals = J[good][:, [0, 2]], residuals[good]
    A = J.T @ J
    covariance = inverse_information(A)
    if covariance is None:
        return np.zeros(2), np.zeros(2)
    return covariance @ (J.T @ residuals), 1.0 / (sigma_px**2 * np.diag(covariance))
