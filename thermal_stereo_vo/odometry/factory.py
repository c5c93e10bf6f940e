"""Which method runs: an explicit table."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import (
    FrameToFrameOdometry,
)
from thermal_stereo_vo.odometry.interface import Odometry
from thermal_stereo_vo.odometry.solvers import DOUBLE_DOGLEG, SOLVERS
from thermal_stereo_vo.odometry.status_machine import StatusConfig

METHODS = ("feature",)


@dataclass(frozen=True)
class OdometryConfig:
    """Choice of the method and its settings."""

    method: str = setting("feature", "Odometry method.", choices=METHODS)
    window: int = setting(
        0, "Keyframes optimised together; 0 goes from frame to frame as P1.", minimum=0, maximum=0
    )
    solver: str = setting(DOUBLE_DOGLEG, "Minimiser of the frame-to-frame motion.", choices=SOLVERS)
    seed: int = setting(0, "Seed of every random choice.", minimum=0, maximum=2**31 - 1)
    status: StatusConfig = group(StatusConfig, "Statuses and coasting.")
    feature: FeatureConfig = group(FeatureConfig, "Features and their matching.")


def create_odometry(config: OdometryConfig) -> Odometry:
    """The method that the settings name."""
    if config.method == "feature":
        return FrameToFrameOdometry(config.feature, config.status, config.solver, config.seed)
    raise ConfigError(f"there is no odometry method '{config.method}'")
