"""The images of a rig of two bands as pyramids in a common measure of contrast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import THERMAL
from thermal_stereo_vo.core.frames import CameraView, GapReason, RigFrame
from thermal_stereo_vo.odometry.direct.bolometer import camera_twist, without_memory
from thermal_stereo_vo.odometry.direct.gradient_pyramid import (
    BrightnessUnit,
    GradientPyramid,
    build_gradient_pyramid,
)
from thermal_stereo_vo.odometry.direct.multispectral_config import BandPhotometricConfig
from thermal_stereo_vo.odometry.direct.rig import Rig

_LEAST_USABLE_SHARE = 0.05
_FLAT = 1.0
"""Contrast of a scene is 60."""


def usable_roles(frame: RigFrame, roles: Sequence[str]) -> tuple[str, ...]:
    """Those of ``roles`` that show something in this frame."""
    return tuple(role for role in roles if role in frame.views and is_usable(frame.views[role]))


def blindness(frame: RigFrame, roles: Sequence[str]) -> str:
    """Why none of ``roles`` can be used, for people."""
    reasons = [
        "shows nothing" if role in frame.views else frame.blind.get(role, GapReason.DROPPED).value
        for role in roles
    ]
    return ", ".join(
        f"{role} camera: {reason}" for role, reason in zip(roles, reasons, strict=True)
    )


def is_usable(view: CameraView) -> bool:
    """Whether enough of an image may be looked at."""
    return view.mask is None or float(view.mask.mean()) > _LEAST_USABLE_SHARE


class BandImages:
    """Cameras with the units of their brightness, as the first frame showed it.

    ``rig`` has its lever arms in metres.
    """

    def __init__(
        self,
        roles: tuple[str, ...],
        rig: Rig,
        units: tuple[BrightnessUnit, ...],
        smoothing_px: tuple[float, ...],
        lag_s: float,
    ) -> None:
        self.roles = roles
        self.rig = rig
        self._units = units
        self._smoothing_px = smoothing_px
        self._lag_s = lag_s
        self._room: list[GradientPyramid | None] = [None] * len(roles)
        self._sharp = [np.empty(shape, np.float32) for shape in rig.shapes]

    @classmethod
    def of(
        cls, frame: RigFrame, roles: tuple[str, ...], config: BandPhotometricConfig, lag_s: float
    ) -> BandImages | None:
        """The cameras in ``roles`` by their views; None where one of them is flat."""
        views = [frame.views[role] for role in roles]
        found = [BrightnessUnit.of(view.image, view.mask) for view in views]
        units = tuple(unit for unit in found if unit is not None)
        if len(units) < len(roles):
            return None
        is_thermal = [role == THERMAL for role in roles]
        smoothing_px = tuple(
            config.thermal_smoothing_px if thermal else config.smoothing_px
            for thermal in is_thermal
        )
        return cls(roles, Rig.of(views).of_bands(is_thermal), units, smoothing_px, lag_s)

    def pyramid(
        self,
        frame: RigFrame,
        camera: int,
        velocity: NDArray[np.float64] | None,
        rho: float,
        rig: Rig,
    ) -> GradientPyramid | None:
        """Pyramid of one camera, until the next one of it is asked for.

        None where it is blind, or its picture is all black or white.

        With the rig's ``velocity`` (6,) per second images of bolometers lose their smear.  It is in
        one unit with the inverse depth ``rho`` of the scene and the lever arms of ``rig``.
        """
        view = frame.views.get(self.roles[camera])
        if view is None or not is_usable(view):
            return None
        image = view.image
        if self.rig.bolometers[camera] and velocity is not None and self._lag_s > 0.0:
            twist = camera_twist(velocity, rig.T_camera_rig[camera])
            sharp = self._sharp[camera]
            without_memory(image, self._lag_s, twist, rho, self.rig.cameras[camera], sharp)
            image = sharp
        room = build_gradient_pyramid(
            image, self._smoothing_px[camera], self._units[camera], self._room[camera]
        )
        self._room[camera] = room
        return None if float(room[-1][..., 0].std()) < _FLAT else room
