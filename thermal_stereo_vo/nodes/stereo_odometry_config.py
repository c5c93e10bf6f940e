"""Settings of the odometry node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.transforms import (
    make_transform,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
)
from thermal_stereo_vo.odometry.factory import OdometryConfig, requirements_of
from thermal_stereo_vo.pipeline import Config as PipelineConfig
from thermal_stereo_vo.radiometry.agc import AgcConfig
from thermal_stereo_vo.radiometry.thermometer import ThermometerConfig
from thermal_stereo_vo.stereo.dense import DenseConfig
from thermal_stereo_vo.stereo.pairing import PairingConfig

_AHEAD_QUAT_XYZW = tuple(map(float, quat_xyzw_from_rotation(default_T_base_rig()[:3, :3])))


@dataclass(frozen=True)
class MountConfig:
    """Where the rig, which is the rectified left camera of two eyes, sits on the vehicle."""

    position_m: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "Optical centre in base_link (x forward, y left, z up).", unit="m"
    )
    quat_xyzw: tuple[float, ...] = setting(
        _AHEAD_QUAT_XYZW,
        "Rotation from the optical frame (z forward) to base_link; the default looks ahead.",
    )

    @property
    def T_base_rig(self) -> NDArray[np.float64]:
        """(4, 4).  Raises ConfigError for numbers that are no pose."""
        if len(self.position_m) != 3 or len(self.quat_xyzw) != 4:
            raise ConfigError(
                "mount.position_m takes 3 numbers and mount.quat_xyzw 4 (x, y, z, w), got "
                f"{list(self.position_m)} and {list(self.quat_xyzw)}"
            )
        try:
            return make_transform(rotation_from_quat_xyzw(self.quat_xyzw), self.position_m)
        except ValueError as error:
            raise ConfigError(f"mount.quat_xyzw: {error}") from None


@dataclass(frozen=True)
class StereoOdometryNodeConfig:
    """Settings of the node."""

    pairing: PairingConfig = group(PairingConfig, "Which images belong together.")
    agc: AgcConfig = group(AgcConfig, "The 8-bit view.")
    odometry: OdometryConfig = group(OdometryConfig, "Visual odometry.")
    dense: DenseConfig = group(DenseConfig, "Dense clouds.")
    thermometer: ThermometerConfig = group(ThermometerConfig, "Temperatures of dense clouds.")
    mount: MountConfig = group(MountConfig, "The left camera on the vehicle.")
    process_all: bool = setting(
        False,
        "Process every pair, reliably and in order (recordings); else the newest pair wins and "
        "those that come too fast are dropped and counted (flight).",
    )
    gated: bool = setting(
        False,
        "The images come from thermal_correction: wait for what its status says of each, so that "
        "gaps and corrections are known, and an eye that is blind is known to be.",
    )
    rig_calibration: str = setting(
        "",
        "rig.yaml of a visible and a thermal camera, file:///PATH, package://PACKAGE/PATH or a "
        "path: where they are on the rig (odometry.method multispectral).",
    )
    odom_before_scale: bool = setting(
        False,
        "Publish odom and points also while the scale is not known yet, in an arbitrary unit "
        "(odometry.method multispectral).",
    )
    odom_frame: str = setting("odom", "Frame of the poses (REP-105).")
    base_frame: str = setting("base_link", "Frame of the vehicle (REP-105).")
    publish_tf: bool = setting(
        False, "Broadcast odom_frame -> base_frame; only one node may do so."
    )

    @property
    def roles(self) -> tuple[str, str]:
        """The cameras that the method listens to."""
        return requirements_of(self.odometry).roles

    @property
    def pipeline(self) -> PipelineConfig:
        """The part that the replay knows too."""
        return PipelineConfig(
            pairing=self.pairing,
            agc=self.agc,
            odometry=self.odometry,
            dense=self.dense,
            thermometer=self.thermometer,
        )
