"""Flights by name: where they lead, when, and in which weather."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.town import crossing
from thermal_stereo_vo.simulation.trajectory import Hover, Leg, Limits, Motion, fly


@dataclass(frozen=True)
class Preset:
    """A named run: its settings, and how to fly it."""

    name: str
    summary: str
    config: SimulationConfig
    motion: Callable[[SimulationConfig, np.random.Generator], Motion]


def find_preset(name: str) -> Preset:
    """The preset of that name.  Raises SimulationError that lists the known ones."""
    presets = {preset.name: preset for preset in _presets()}
    if name not in presets:
        raise SimulationError(f"there is no preset '{name}': choose one of {', '.join(presets)}")
    return presets[name]


def preset_names() -> tuple[str, ...]:
    """All names, in order."""
    return tuple(preset.name for preset in _presets())


_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
_OBLONG = ((0, 0), (1, 0), (1, 2), (0, 2))
_WIDE = ((0, 0), (2, 0), (2, 1), (0, 1))
_LARGE = ((0, 0), (2, 0), (2, 2), (0, 2))
_STAIRS = ((0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (0, 2))


def _circuit(
    corners: tuple[tuple[int, int], ...], height_m: float = 3.0, speed_m_s: float = 4.5
) -> Callable[[SimulationConfig, np.random.Generator], Motion]:
    """Round and round through these crossings, until the length is flown."""

    def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
        assert config.length_m is not None
        ring = [crossing(*corner, height_m) for corner in corners]
        lap_m = sum(
            float(np.linalg.norm(np.subtract(a, b)))
            for a, b in zip(ring, ring[1:] + ring[:1], strict=True)
        )
        laps = int(config.length_m / (0.9 * lap_m)) + 1
        points = (ring[1:] + ring[:1]) * laps
        start, first = np.array(ring[0]), np.array(ring[1])
        yaw = float(np.arctan2(*(first - start)[1::-1]))
        return fly(
            start, yaw, [Leg(tuple(points))], Limits(speed_m_s), rng, length_m=config.length_m
        )

    return motion


def _hover(config: SimulationConfig, rng: np.random.Generator) -> Motion:
    return fly(crossing(0.3, 0, 3.0), 0.0, [Hover(6.0)], Limits(), rng)


def _turn(config: SimulationConfig, rng: np.random.Generator) -> Motion:
    return fly(crossing(0, 0, 3.0), 0.3, [Hover(2.0, 360.0)], Limits(), rng)


def _presets() -> tuple[Preset, ...]:
    def flight(
        name: str, summary: str, length_m: float, weather: str, air_celsius: float,
        corners: tuple[tuple[int, int], ...], speed_m_s: float = 4.5,
    ) -> Preset:  # fmt: skip
        config = SimulationConfig(length_m=length_m, weather=weather, air_celsius=air_celsius)
        return Preset(name, summary, config, _circuit(corners, speed_m_s=speed_m_s))

    return (
        flight("seq1", "687 m, 11 am, cloudy and cold", 687.0, "cloudy_day", 4.0, _LARGE),
        flight("seq2", "497 m, 10 am, foggy", 497.0, "foggy_day", 13.0, _WIDE),
        flight("seq3", "701 m, 9 am, foggy", 701.0, "foggy_day", 12.0, _STAIRS),
        flight("seq4", "460 m, 11 am, cloudy and cold", 460.0, "cloudy_day", 4.0, _OBLONG),
        flight("seq5", "882 m, 10 am, cloudy and warm", 882.0, "cloudy_day", 18.0, _LARGE, 5.5),
        flight(
            "seq6", "489 m, 9 pm, clear and very cold", 489.0, "clear_cold_night", -8.0, _OBLONG
        ),
        flight("seq7", "399 m, 10 pm, cloudy and cold", 399.0, "cloudy_night", 3.0, _WIDE),
        flight("seq8", "314 m, 10.30 pm, cloudy and cold", 314.0, "cloudy_night", 3.0, _SQUARE),
        flight("seq9", "655 m, 10 pm, cloudy and cold", 655.0, "cloudy_night", 2.0, _STAIRS),
        flight("corridor", "60 m straight down a street", 60.0, "cloudy_day", 10.0, _WIDE),
        flight("demo", "64 m and one flat-field correction", 64.0, "cloudy_day", 8.0, _SQUARE, 5.0),
        Preset("hover", "in place for 6 s", SimulationConfig(), _hover),
        Preset("turn", "once about itself", SimulationConfig(), _turn),
    )
