"""The way of a frame: the stages in order, one object for replay and for the onboard node.

RawFrame -> front end -> pairer -> rectifier -> 8-bit view -> odometry -> observers

What the method requires decides between rectified eyes and cameras undistorted one by one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.core.frames import RadiometricFrame, RawFrame, RigFrame
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.results import OdometryResult
from thermal_stereo_vo.observers import Observer, ObserverList, StageTimer
from thermal_stereo_vo.odometry.factory import (
    OdometryConfig,
    create_gyro,
    create_odometry,
    methods_for,
    requirements_of,
)
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain
from thermal_stereo_vo.radiometry.front_end import FrontEndConfig, create_front_end
from thermal_stereo_vo.radiometry.thermometer import ThermometerConfig
from thermal_stereo_vo.stereo.dense import DenseConfig
from thermal_stereo_vo.stereo.pairing import Pair, PairingConfig, StereoPairer
from thermal_stereo_vo.stereo.rectification import (
    RectificationConfig,
    Rectifier,
    RigRectifier,
    assemble,
)
from thermal_stereo_vo.stereo.undistortion import Undistorter


@dataclass(frozen=True)
class Config:
    """Every setting of the pipeline."""

    front_end: FrontEndConfig = group(FrontEndConfig, "From raw to linear counts.")
    pairing: PairingConfig = group(PairingConfig, "Which images belong together.")
    rectification: RectificationConfig = group(RectificationConfig, "Row-aligned images.")
    agc: AgcConfig = group(AgcConfig, "The 8-bit view.")
    odometry: OdometryConfig = group(OdometryConfig, "Visual odometry.")
    dense: DenseConfig = group(DenseConfig, "Dense clouds, made beside the way of the frame.")
    thermometer: ThermometerConfig = group(ThermometerConfig, "Temperatures of dense clouds.")


def rig_rectifier(config: Config, calibration: RigCalibration) -> RigRectifier:
    """What turns raw images of this rig into those that the method of the settings works on.

    Raises CalibrationError for a rig that lacks a camera the method needs, or that cannot be
    rectified.
    """
    needed = requirements_of(config.odometry)
    if not set(needed.roles) <= set(calibration.cameras):
        fitting = methods_for(calibration.cameras)
        raise CalibrationError(
            f"the method '{config.odometry.method}' needs the cameras {' and '.join(needed.roles)},"
            f" but {calibration.origin or 'the calibration'} has {', '.join(calibration.cameras)}: "
            + (f"choose --method {' or '.join(fitting)}" if fitting else "give another calibration")
        )
    if needed.rectified_pair:
        return Rectifier(calibration, config.rectification)
    return Undistorter(calibration, needed.roles, config.rectification.alpha)


class Pipeline:
    """Strings the stages together.  Close it, also after an error, so that files are finished."""

    def __init__(
        self,
        config: Config,
        calibration: RigCalibration,
        observers: Sequence[Observer] = (),
    ) -> None:
        self._config = config
        self.rectifier = rig_rectifier(config, calibration)
        self.gyro = create_gyro(config.odometry, self.rectifier.rectified_calibration)
        self.odometry = create_odometry(config.odometry, self.gyro)
        self._roles = self.odometry.requirements.roles
        self._observers = ObserverList(observers)
        self.front_ends = {
            role: create_front_end(config.front_end, role, self._observers.on_gate_event)
            for role in self._roles
        }
        self._pairer: StereoPairer[RadiometricFrame] = StereoPairer(config.pairing)
        self._gain = AutomaticGain(config.agc)
        self._timer = StageTimer()

    def warm_up(self) -> None:
        """Compile or load every kernel before the first frame."""
        # Two cameras of a kind share their kernels.
        for front_end in {type(f): f for f in self.front_ends.values()}.values():
            front_end.warm_up()
        self._gain.warm_up()
        self.odometry.warm_up()

    def push(self, raw: RawFrame) -> Iterator[OdometryResult]:
        """Feed one image; yields a result for each rig frame that it completes.

        Raises FrameError for a camera that the method does not use, OutOfOrderError for stamps
        that do not increase.
        """
        frame = self._correct(raw)
        if frame is None:
            return
        for pair in self._pairer.push(self._roles.index(raw.camera), frame):
            yield self.process(pair)

    def push_pair(self, pair: Pair[RawFrame]) -> OdometryResult | None:
        """Feed raw images that were paired elsewhere, as a node does that drops whole pairs.

        Returns None when neither is news.  Raises what ``push`` raises.
        """
        first, second = (
            None if raw is None else self._correct(raw) for raw in (pair.first, pair.second)
        )
        if first is None and second is None:
            return None
        return self.process(Pair(first, second))

    def push_imu(self, sample: ImuSample) -> None:
        """Feed one inertial measurement, before the frames that come after it."""
        if self.gyro is not None:
            self.gyro.push(sample.stamp_ns, sample.rate_rad_s, sample.force_m_s2)

    def flush(self) -> Iterator[OdometryResult]:
        """The source has ended: frames that still wait for a partner go on alone."""
        for pair in self._pairer.flush():
            yield self.process(pair)

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose; any stamp may follow."""
        for front_end in self.front_ends.values():
            front_end.reset()
        self._pairer = StereoPairer(self._config.pairing)
        self._gain.reset()
        if self.gyro is not None:
            self.gyro.reset()
        self.odometry.reset(T_world_rig)

    def close(self) -> None:
        """Close the observers."""
        self._observers.close()

    def process(self, pair: Pair[RadiometricFrame]) -> OdometryResult:
        """Feed what was paired elsewhere, as a node does that must not fall behind."""
        with self._timer.stage("rectify"):
            frame = assemble(self.rectifier, pair.first, pair.second, pair.stamp_ns)
        if self.odometry.requirements.display:
            with self._timer.stage("agc"):
                frame = self._gain.process(frame)
        return self._estimate(frame)

    def _correct(self, raw: RawFrame) -> RadiometricFrame | None:
        """Linear counts; None for a repeat, where the link is faster than the sensor."""
        if raw.camera not in self._roles:
            raise FrameError(
                f"camera '{raw.camera}' is not one of {', '.join(self._roles)}, which the method "
                "needs"
            )
        with self._timer.stage("front end"):
            return self.front_ends[raw.camera].process(raw)

    def _estimate(self, frame: RigFrame) -> OdometryResult:
        self._observers.on_rig_frame(frame)
        result = self.odometry.process(frame)
        self._observers.on_result(result)
        if self._observers.wants_points and result.T_world_rig is not None:
            self._observers.on_points(frame.stamp_ns, self.odometry.local_map())
        return result

    def take_stage_ms(self) -> dict[str, float]:
        """Stage -> milliseconds since the last call, without the odometry's own stages."""
        return self._timer.take()
