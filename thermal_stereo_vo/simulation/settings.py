"""Everything about a simulated run that ``--set`` may change."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.simulation.weather import WEATHERS


@dataclass(frozen=True)
class ThermalCameraConfig:
    """A Tau 2: uncooled, 14 bits."""

    netd_mk: float = setting(
        50.0, "Temporal noise of a pixel at 300 K.", unit="mK", minimum=0.0, maximum=1000.0
    )
    counts_per_kelvin: float = setting(
        30.0, "Responsivity at 300 K.", unit="counts/K", minimum=1.0, maximum=200.0
    )
    offset_counts: float = setting(
        5000.0, "Counts of a scene that does not radiate.", unit="counts", minimum=0.0,
        maximum=12000.0,
    )  # fmt: skip


@dataclass(frozen=True)
class SimulationConfig:
    """One simulated run."""

    rate_hz: float = setting(10.0, "Frames a second.", unit="Hz", minimum=0.5, maximum=1000.0)
    length_m: float | None = setting(
        None, "Distance flown; empty keeps the preset's.", unit="m", minimum=1.0, maximum=20000.0
    )
    weather: str = setting("cloudy_day", "Weather and time of day.", choices=tuple(WEATHERS))
    air_celsius: float | None = setting(
        None, "Air temperature; empty keeps the weather's.", unit="degC", minimum=-40.0,
        maximum=50.0,
    )  # fmt: skip
    scale: float = setting(
        1.0, "Image size relative to 640x480.", unit="-", minimum=0.1, maximum=1.0
    )
    workers: int = setting(
        2, "Processes that render; 0 renders in this one.", unit="processes", minimum=0, maximum=64
    )
    thermal: ThermalCameraConfig = group(ThermalCameraConfig, "The thermal cameras.")
