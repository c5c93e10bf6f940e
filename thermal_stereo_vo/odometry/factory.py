"""Which method runs: an explicit choice."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.odometry.direct.multispectral_config import MultispectralConfig
from thermal_stereo_vo.odometry.direct.multispectral_method import MultispectralOdometry
from thermal_stereo_vo.odometry.direct.stereo_method import DirectConfig, StereoDirectOdometry
from thermal_stereo_vo.odometry.feature_based.feature_matching import FeatureConfig
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import FrameToFrameOdometry
from thermal_stereo_vo.odometry.feature_based.windowed import WindowedConfig, WindowedOdometry
from thermal_stereo_vo.odometry.gyro import AccelerometerConfig, GyroConfig, GyroIntegrator
from thermal_stereo_vo.odometry.interface import Odometry, Requirements
from thermal_stereo_vo.odometry.solvers import DOUBLE_DOGLEG, SOLVERS
from thermal_stereo_vo.odometry.status_machine import StatusConfig

METHODS = ("feature", "direct", "multispectral")


@dataclass(frozen=True)
class OdometryConfig:
    """Choice of the method and its settings."""

    method: str = setting("feature", "Odometry method.", choices=METHODS)
    window: int = setting(
        7, "Keyframes optimised together; 0 goes from frame to frame as P1.", minimum=0, maximum=20
    )
    solver: str = setting(DOUBLE_DOGLEG, "Minimiser of the frame-to-frame motion.", choices=SOLVERS)
    seed: int = setting(0, "Seed of every random choice.", minimum=0, maximum=2**31 - 1)
    threads: int = setting(
        2,
        "Threads that share the work of a frame; the results are the same.",
        minimum=1,
        maximum=2,
    )
    status: StatusConfig = group(StatusConfig, "Statuses and coasting.")
    gyro: GyroConfig = group(GyroConfig, "Guidance by an IMU.")
    accelerometer: AccelerometerConfig = group(AccelerometerConfig, "And by its forces.")
    feature: FeatureConfig = group(FeatureConfig, "Features and their matching.")
    windowed: WindowedConfig = group(WindowedConfig, "Tracking against keyframes.")
    direct: DirectConfig = group(DirectConfig, "Direct odometry.")
    multispectral: MultispectralConfig = group(
        MultispectralConfig, "Direct visible + thermal odometry."
    )


def requirements_of(config: OdometryConfig) -> Requirements:
    """What the method that the settings name asks of its frames."""
    if config.method == "direct":
        return StereoDirectOdometry.requirements
    if config.method == "multispectral":
        return MultispectralOdometry.requirements
    return (
        FrameToFrameOdometry.requirements if config.window == 0 else WindowedOdometry.requirements
    )


def methods_for(roles: Collection[str]) -> tuple[str, ...]:
    """The methods that can work with the cameras in ``roles``."""
    needed = {method: requirements_of(OdometryConfig(method=method)).roles for method in METHODS}
    return tuple(method for method in METHODS if set(needed[method]) <= set(roles))


def create_gyro(config: OdometryConfig, rig: RigCalibration) -> GyroIntegrator | None:
    """The guidance by an IMU where ``rig`` has it, or None when it is not wanted."""
    if not config.gyro.enabled:
        return None
    # Visible + thermal odometry does not know from the start how long a metre is.
    by_force = config.accelerometer.enabled and config.method != "multispectral"
    accelerometer = config.accelerometer if by_force else None
    return GyroIntegrator(config.gyro, rig.R_rig_imu, accelerometer, rig.imu_position_m)


def create_odometry(config: OdometryConfig, gyro: GyroIntegrator | None = None) -> Odometry:
    """Build the method that the settings name; a ``gyro`` guides its predictions.

    Raises ConfigError for a window of one keyframe, which could adjust nothing.
    """
    if config.method in ("direct", "multispectral") and config.window < 2:
        raise ConfigError(
            f"odometry.window = {config.window} leaves the {config.method} method nothing to "
            "optimise: give 2 and more"
        )
    if config.method == "multispectral":
        return MultispectralOdometry(
            config.multispectral, config.status, config.window, config.threads, gyro, config.seed
        )
    if config.method == "direct":
        return StereoDirectOdometry(
            config.direct, config.status, config.window, config.threads, gyro
        )
    if config.window == 0:
        return FrameToFrameOdometry(
            config.feature, config.status, config.solver, config.seed, config.threads, gyro
        )
    if config.window == 1:
        raise ConfigError(
            "odometry.window = 1 leaves nothing to optimise: give 0 (frame to frame) or 2 and more"
        )
    return WindowedOdometry(
        config.windowed,
        config.feature,
        config.status,
        config.solver,
        config.window,
        config.seed,
        config.threads,
        gyro,
    )


def describe(config: OdometryConfig) -> str:
    """The method in a few words, for titles and tables."""
    if config.window == 0:
        return f"{config.method}, frame to frame, {config.solver.replace('_', ' ')}"
    return f"{config.method}, window of {config.window} keyframes"
