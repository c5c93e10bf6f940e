"""A simulated run as a recording: ``sim:PRESET``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.simulation import Simulation


class SimulatedDataset:
    """A run that is rendered while it is read; ``simulation`` knows the rest of the truth."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.name = simulation.plan.preset
        self.cameras = simulation.plan.roles

    def calibration(self) -> RigCalibration:
        """The true calibration."""
        return self.simulation.plan.rig

    def frames(self) -> Iterator[RawFrame]:
        return self.simulation.frames()

    def imu(self) -> Iterator[ImuSample]:
        """Turn rates in axes of ``base_link``."""
        for measured in self.simulation.inertial():
            yield ImuSample(measured.stamp_ns, measured.rate_rad_s, measured.force_m_s2)

    def ground_truth(self) -> Trajectory:
        return self.simulation.ground_truth()

    def instants(self) -> int:
        return self.simulation.instants


def open_simulated(preset: str, options: SourceOptions | None = None) -> SimulatedDataset:
    """The run of this name with the rate, length, seed and settings wished for.

    The seed is that of the sensors' noise; ``world.seed`` and ``flight.seed`` are settings.

    Raises SimulationError for an unknown preset and ConfigError for unknown settings.
    """
    options = options or SourceOptions()
    config = with_overrides(find_preset(preset).config, options.overrides)
    if options.rate_hz is not None:
        config = replace(config, rate_hz=options.rate_hz)
    if options.length_m is not None:
        config = replace(config, flight=replace(config.flight, length_m=options.length_m))
    return SimulatedDataset(Simulation(preset, config, options.seed))
