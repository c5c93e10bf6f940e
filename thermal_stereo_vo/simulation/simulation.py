"""A simulated run as a stream of frames, with everything that is known about it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import VISIBLE
from thermal_stereo_vo.core.frames import CameraView, RawFrame, RigFrame
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import inverse
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain
from thermal_stereo_vo.simulation.navigation import (
    Fix,
    Inertial,
    inertial_measurements,
    satellite_fixes,
)
from thermal_stereo_vo.simulation.presets import plan_run
from thermal_stereo_vo.simulation.radiance_cache import cached_signals
from thermal_stereo_vo.simulation.schedule import (
    Exposure,
    camera_times,
    corrections,
    in_order,
    instants_in,
    stamp_ns,
)
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.thermal_camera import ThermalCamera
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature
from thermal_stereo_vo.simulation.visible_camera import VisibleCamera


class Simulation:
    """World, motion, rig and sensors of one run.

    ``seed`` draws the noise of all sensors; world and flight have seeds of their own in the
    settings, so that sensors can be tried again without rendering again.

    Raises SimulationError for an unknown preset or a flight that cannot be flown.
    """

    def __init__(self, preset: str, config: SimulationConfig, seed: int = 0) -> None:
        self.plan = plan_run(preset, config)
        self.config = config
        self.seed = seed
        self.instants = instants_in(self.plan.motion.duration_s, config)
        self.duration_s = (self.instants - 1) / config.rate_hz
        self._exposures = [
            camera_times(config.timing, config.rate_hz, self.instants, camera, seed)
            for camera in range(len(self.plan.roles))
        ]

    def fpa(self, camera: int) -> FpaTemperature:
        """Temperature of the focal plane of one camera."""
        return FpaTemperature.of(
            self.plan.weather.air_kelvin, self.config.thermal, self.seed, camera
        )

    def corrections_s(self, camera: int) -> tuple[float, ...]:
        """Start times (s) of the flat-field corrections of one camera."""
        return corrections(self.config.ffc, self.fpa(camera), self.duration_s, camera, self.seed)

    def ground_truth(self) -> Trajectory:
        """Poses of the rig at the frames of the first camera, relative to the first."""
        first = self._exposures[0]
        poses = np.array([self.plan.T_map_rig(exposure.time_s) for exposure in first])
        stamps = np.array([stamp_ns(exposure.time_s) for exposure in first], dtype=np.int64)
        return Trajectory(stamps, inverse(poses[0]) @ poses)

    def inertial(self) -> Iterator[Inertial]:
        """Measurements of the inertial unit, in axes of ``base_link``."""
        return inertial_measurements(
            self.plan.motion, self.duration_s, self.config.navigation, self.seed
        )

    def fixes(self) -> Iterator[Fix]:
        """Fixes of the satellite receiver."""
        return satellite_fixes(self.plan.motion, self.duration_s, self.config.navigation, self.seed)

    def frames(self) -> Iterator[RawFrame]:
        """All frames of all cameras in order of their stamps."""
        sensors = [self.sensor(camera) for camera in range(len(self.plan.roles))]
        kept = [e for e in in_order(self._exposures) if not e.dropped]
        seen = [e for e in kept if not sensors[e.camera].blind(e)]
        signals = cached_signals(self.plan, seen, self.instants)
        try:
            for exposure in kept:
                sensor = sensors[exposure.camera]
                signal = None if sensor.blind(exposure) else next(signals)
                frame = sensor.frame(signal, exposure)
                if frame is not None:
                    yield frame
        finally:
            signals.close()

    def sensor(self, camera: int, *, corrections: bool = True) -> VisibleSensor | ThermalSensor:
        """A fresh sensor of one camera, with or without its flat-field corrections."""
        if self.plan.roles[camera] == VISIBLE:
            return VisibleSensor(self, camera)
        return ThermalSensor(self, camera, self.corrections_s(camera) if corrections else ())


class ThermalSensor:
    """A thermal camera of the rig; 8-bit output goes through a gain control of its own."""

    def __init__(
        self, simulation: Simulation, camera: int, corrections_s: tuple[float, ...]
    ) -> None:
        config, plan = simulation.config, simulation.plan
        self._role = plan.roles[camera]
        self._lens = plan.rig[self._role].camera
        self._telemetry = config.thermal.telemetry
        self._core = ThermalCamera(
            config.thermal,
            config.ffc,
            (self._lens.height, self._lens.width),
            simulation.fpa(camera),
            corrections_s,
            (simulation.seed, 20, camera),
        )
        self._gain: AutomaticGain | None = None
        if config.thermal.output == "agc":
            self._gain = AutomaticGain(
                AgcConfig(mode="plateau", damping=config.thermal.agc_damping)
            )
        self._grey: NDArray[np.uint8] | None = None

    def blind(self, exposure: Exposure) -> bool:
        return self._core.is_correcting(exposure.time_s)

    def frame(self, signal: NDArray[np.uint16] | None, exposure: Exposure) -> RawFrame | None:
        reading = self._core.expose(signal, exposure.time_s, exposure.index)
        if reading is None:
            return None
        image: NDArray[np.uint8] | NDArray[np.uint16] = reading.counts
        if self._gain is not None:
            if not reading.correcting or self._grey is None:
                view = CameraView(reading.counts, self._lens)
                shown = self._gain.process(RigFrame(exposure.stamp_ns, {self._role: view}))
                self._grey = shown.views[self._role].display
            assert self._grey is not None
            image = self._grey
        telemetry = reading.telemetry if self._telemetry else None
        return RawFrame(image, exposure.stamp_ns, self._role, exposure.index, telemetry)


class VisibleSensor:
    """The visible camera of the rig."""

    def __init__(self, simulation: Simulation, camera: int) -> None:
        self._illumination = simulation.plan.weather.illumination
        self._config = simulation.config.visible
        self._camera = VisibleCamera(
            simulation.config.visible, self._illumination, (simulation.seed, 21, camera)
        )

    def blind(self, exposure: Exposure) -> bool:
        return False

    def frame(self, signal: NDArray[np.uint16] | None, exposure: Exposure) -> RawFrame:
        assert signal is not None
        lit = self._config.sees_light(exposure.time_s)
        image = self._camera.expose(signal, self._illumination if lit else 0.0, exposure.index)
        return RawFrame(image, exposure.stamp_ns, VISIBLE, exposure.index)
