"""Flights through the town: those of the paper, and short ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation import objects
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.preset import (
    MakeMotion,
    Preset,
    settings_of,
    stereo,
    visible_thermal,
)
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Mover, Scene
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.town import TownOptions, build_town, crossing
from thermal_stereo_vo.simulation.trajectory import Hover, Leg, Limits, Motion, fly

Corner = tuple[int, int]

_ARM_S = (3.0, 5.0)


def _town(plan: RunPlan) -> Scene:
    times = np.arange(0.0, plan.motion.duration_s + 0.5, 0.5)
    path = np.array([plan.motion.T_map_base(t)[:3, 3] for t in times])
    world = plan.config.world
    options = TownOptions(world.seed, world.traffic, world.density)
    return build_town(path, options, plan.weather)


_SQUARE: tuple[Corner, ...] = ((0, 0), (1, 0), (1, 1), (0, 1))
_OBLONG: tuple[Corner, ...] = ((0, 0), (1, 0), (1, 2), (0, 2))
_WIDE: tuple[Corner, ...] = ((0, 0), (2, 0), (2, 1), (0, 1))
_LARGE: tuple[Corner, ...] = ((0, 0), (2, 0), (2, 2), (0, 2))
_STAIRS: tuple[Corner, ...] = ((0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (0, 2))
_EIGHT: tuple[Corner, ...] = ((0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (0, 1))

_CLIMB_M = (0.0, 1.0, 0.3, 1.6)


def _circuit(corners: tuple[Corner, ...], stops: tuple[int, ...] = ()) -> MakeMotion:
    """Round and round through these crossings until the length is flown.

    At the corners in ``stops`` the rig halts, hovers and turns on the spot.
    """

    def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
        flight = config.flight
        ring = [
            crossing(*corner, flight.height_m + _CLIMB_M[n % len(_CLIMB_M)])
            for n, corner in enumerate(corners)
        ]
        lap_m = sum(_apart(a, b) for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
        length_m = lap_m if flight.length_m is None else flight.length_m
        laps = int(length_m / (0.85 * lap_m)) + 1
        program: list[Leg | Hover] = []
        leg: list[tuple[float, float, float]] = []
        for n in range(1, laps * len(ring) + 1):
            here, after = ring[n % len(ring)], ring[(n + 1) % len(ring)]
            leg.append(here)
            if n % len(ring) in stops:
                before = ring[(n - 1) % len(ring)]
                turn = np.degrees(_heading(here, after) - _heading(before, here))
                program += [Leg(tuple(leg)), Hover(2.0), Hover(2.0, (turn + 180) % 360 - 180)]
                leg = []
        if leg:
            program.append(Leg(tuple(leg)))
        return fly(
            ring[0],
            _heading(ring[0], ring[1]),
            program,
            _limits(config),
            rng,
            length_m=length_m,
            gust_m=flight.gust_m,
        )

    return motion


def _limits(config: SimulationConfig) -> Limits:
    flight = config.flight
    return Limits(flight.speed_m_s, yaw_rate_rad_s=np.radians(flight.yaw_rate_deg_s))


def _apart(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))


def _heading(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return float(np.arctan2(b[1] - a[1], b[0] - a[0]))


def paper_flights() -> tuple[Preset, ...]:
    """The nine flights of Mouats et al. 2015, Table IV."""

    def flight(
        number: int, hour: str, weather: str, length_m: float, air_celsius: float,
        speed_m_s: float, corners: tuple[Corner, ...], stops: tuple[int, ...] = (),
    ) -> Preset:  # fmt: skip
        config = settings_of(
            {
                "world.weather": weather,
                "world.air_celsius": air_celsius,
                "flight.length_m": length_m,
                "flight.speed_m_s": speed_m_s,
                "flight.seed": number,
            }
        )
        summary = f"{length_m:.0f} m at {hour}, {weather.replace('_', ' ')}, {air_celsius:.0f} degC"
        return Preset(f"seq{number}", summary, config, _circuit(corners, stops), _town, stereo)

    return (
        flight(1, "11 am", "cloudy_day", 687.0, 4.0, 4.5, _LARGE, (2,)),
        flight(2, "10 am", "foggy_day", 497.0, 13.0, 4.0, _WIDE),
        flight(3, "9 am", "foggy_day", 701.0, 12.0, 4.5, _STAIRS, (3,)),
        flight(4, "11 am", "cloudy_day", 460.0, 4.0, 4.5, _OBLONG),
        flight(5, "10 am", "cloudy_day", 882.0, 18.0, 6.5, _EIGHT, (4,)),
        flight(6, "9 pm", "clear_cold_night", 489.0, -8.0, 4.5, _OBLONG),
        flight(7, "10 pm", "cloudy_night", 399.0, 3.0, 4.0, _WIDE),
        flight(8, "10.30 pm", "cloudy_night", 314.0, 3.0, 3.5, _SQUARE),
        flight(9, "10 pm", "cloudy_night", 655.0, 2.0, 4.5, _STAIRS),
    )


def _hover(config: SimulationConfig, rng: np.random.Generator) -> Motion:
    flight = config.flight
    start = crossing(0.3, 0.0, flight.height_m)
    return fly(start, 0.0, [Hover(6.0)], _limits(config), rng, gust_m=flight.gust_m)


def _turn(config: SimulationConfig, rng: np.random.Generator) -> Motion:
    flight = config.flight
    start = crossing(0.0, 0.0, flight.height_m)
    return fly(start, 0.3, [Hover(2.0, 360.0)], _limits(config), rng, gust_m=flight.gust_m)


def _street_with_arm(plan: RunPlan) -> Scene:
    """The street, and the pilot's bare arm before both cameras for a while."""
    street = _town(plan)
    b = MeshBuilder()
    hot = 305.0 - plan.weather.air_kelvin
    b.cylinder([0.42, -0.9, -0.25], [0.40, 0.12, -0.02], 0.045, Material.SKIN, sides=16,
               top_radius_m=0.032, offset_kelvin=hot)  # fmt: skip
    b.cylinder([0.40, 0.12, -0.02], [0.40, 0.25, 0.0], 0.04, Material.SKIN, sides=12,
               top_radius_m=0.02, offset_kelvin=hot - 2.0)  # fmt: skip

    def pose(time_s: float) -> NDArray[np.float64]:
        away_m = 0.0 if _ARM_S[0] <= time_s < _ARM_S[1] else -3.0
        ready = np.clip(min(abs(time_s - _ARM_S[0]), abs(time_s - _ARM_S[1])) / 0.15, 0.0, 1.0)
        inside = _ARM_S[0] <= time_s < _ARM_S[1]
        slide_m = away_m if not inside else -1.2 * (1.0 - ready)
        return plan.motion.T_map_base(time_s) @ objects.placed(0.0, slide_m, 0.0)

    return Scene(
        street.static, (*street.movers, Mover(b.build(), pose)), outdoors=True,
        extent_m=street.extent_m,
    )  # fmt: skip


def dusk_flights() -> tuple[Preset, ...]:
    """Flights of a visible and a thermal camera in the last light."""
    config = settings_of(
        {"rate_hz": 20.0, "world.weather": "cloudy_day", "world.air_celsius": 6.0,
         "world.illumination": 0.01, "flight.length_m": 320.0, "flight.speed_m_s": 4.0,
         "ffc.mode": "periodic", "ffc.first_s": 15.0, "ffc.period_s": 30.0}
    )  # fmt: skip
    return (
        Preset("ms-dusk", "320 m round a block at dusk, a visible and a thermal camera",
               config, _circuit(_SQUARE), _town, visible_thermal),
    )  # fmt: skip


def short_flights() -> tuple[Preset, ...]:
    """Runs of a few seconds for demonstrations and tests."""
    straight = _circuit(_LARGE)
    ffc = {"ffc.mode": "periodic"}
    return (
        Preset(
            "demo", "64 m on a cloudy day with one flat-field correction",
            settings_of({"world.air_celsius": 8.0, "flight.length_m": 64.0, "flight.speed_m_s": 5.0,
                       **ffc, "ffc.first_s": 8.0, "ffc.duration_s": 0.5}),
            straight, _town, stereo,
        ),
        Preset("hover", "6 s in place", settings_of({}), _hover, _town, stereo),
        Preset("turn", "once about itself, then rest", settings_of({}), _turn, _town, stereo),
        Preset("quick_turn", "once about itself at up to 60 deg/s, then rest",
               settings_of({"flight.yaw_rate_deg_s": 60.0}), _turn, _town, stereo),
        Preset("corridor", "60 m straight down a street",
               settings_of({"flight.length_m": 60.0}), straight, _town, stereo),
        Preset("ffc", "80 m with corrections of both cameras, 3 s apart",
               settings_of({"flight.length_m": 80.0, **ffc, "ffc.first_s": 6.0, "ffc.period_s": 8.0,
                          "ffc.arrangement": "staggered"}),
               _circuit(_SQUARE), _town, stereo),
        Preset("hot_arm", "6 s in place; a warm arm enters the picture from 3 s to 5 s",
               settings_of({"flight.gust_m": 0.01}), _hover, _street_with_arm, stereo),
    )  # fmt: skip
