"""Runs by name: where they lead, when, in which weather, and with which cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.config import from_mapping
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation import objects
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.rig import stereo_rig, visible_thermal_rig
from thermal_stereo_vo.simulation.room import build_room
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Mover, Scene
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.targets import (
    CHESSBOARD,
    MASK,
    aluminium_chessboard,
    blackbody_scene,
    board_poses,
    board_scene,
    heated_mask,
    seen_by_all,
)
from thermal_stereo_vo.simulation.town import TownOptions, build_town, crossing
from thermal_stereo_vo.simulation.trajectory import Hover, Leg, Limits, Motion, fly, wander

Corner = tuple[int, int]
MakeMotion = Callable[[SimulationConfig, np.random.Generator], Motion]
MakeScene = Callable[[RunPlan], Scene]
MakeRig = Callable[[SimulationConfig], RigCalibration]

BOARD_POSES = 27
_STEP_S, _STEP_KELVIN = 1.0, 5.0
_ARM_S = (3.0, 5.0)


@dataclass(frozen=True)
class Preset:
    """A named run: a sentence, its settings, and how to make motion, scene and rig."""

    name: str
    summary: str
    config: SimulationConfig
    motion: MakeMotion
    scene: MakeScene
    rig: MakeRig


def find_preset(name: str) -> Preset:
    """The preset of that name.  Raises SimulationError that lists the known ones."""
    presets = {preset.name: preset for preset in all_presets()}
    if name not in presets:
        raise SimulationError(f"there is no preset '{name}': choose one of {', '.join(presets)}")
    return presets[name]


def all_presets() -> tuple[Preset, ...]:
    """Every preset, flights first."""
    return (*_flights(), *_short_ones(), *_hand_held(), *_targets())


def _settings(mapping: Mapping[str, Any]) -> SimulationConfig:
    return from_mapping(SimulationConfig, mapping)


# --- scenes and rigs ---------------------------------------------------------------------------


def _town(plan: RunPlan) -> Scene:
    times = np.arange(0.0, plan.motion.duration_s + 0.5, 0.5)
    path = np.array([plan.motion.T_map_base(t)[:3, 3] for t in times])
    world = plan.config.world
    options = TownOptions(world.seed, world.traffic, world.density)
    return build_town(path, options, plan.weather)


def _stereo(config: SimulationConfig) -> RigCalibration:
    return stereo_rig(config.render.scale, config.flight.tilt_down_deg)


def _visible_thermal(config: SimulationConfig) -> RigCalibration:
    return visible_thermal_rig(config.render.scale)


# --- the nine flights of Mouats et al. 2015, Table IV -------------------------------------------

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


def _flights() -> tuple[Preset, ...]:
    def flight(
        number: int, hour: str, weather: str, length_m: float, air_celsius: float,
        speed_m_s: float, corners: tuple[Corner, ...], stops: tuple[int, ...] = (),
    ) -> Preset:  # fmt: skip
        config = _settings(
            {
                "world.weather": weather,
                "world.air_celsius": air_celsius,
                "flight.length_m": length_m,
                "flight.speed_m_s": speed_m_s,
                "flight.seed": number,
            }
        )
        summary = f"{length_m:.0f} m at {hour}, {weather.replace('_', ' ')}, {air_celsius:.0f} degC"
        return Preset(f"seq{number}", summary, config, _circuit(corners, stops), _town, _stereo)

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


# --- short runs --------------------------------------------------------------------------------


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


def _short_ones() -> tuple[Preset, ...]:
    straight = _circuit(_LARGE)
    ffc = {"ffc.mode": "periodic"}
    return (
        Preset(
            "demo", "64 m on a cloudy day with one flat-field correction",
            _settings({"world.air_celsius": 8.0, "flight.length_m": 64.0, "flight.speed_m_s": 5.0,
                       **ffc, "ffc.first_s": 8.0, "ffc.duration_s": 0.5}),
            straight, _town, _stereo,
        ),
        Preset("hover", "6 s in place", _settings({}), _hover, _town, _stereo),
        Preset("turn", "once about itself, then rest", _settings({}), _turn, _town, _stereo),
        Preset("quick_turn", "once about itself at up to 60 deg/s, then rest",
               _settings({"flight.yaw_rate_deg_s": 60.0}), _turn, _town, _stereo),
        Preset("corridor", "60 m straight down a street",
               _settings({"flight.length_m": 60.0}), straight, _town, _stereo),
        Preset("ffc", "80 m with corrections of both cameras, 3 s apart",
               _settings({"flight.length_m": 80.0, **ffc, "ffc.first_s": 6.0, "ffc.period_s": 8.0,
                          "ffc.arrangement": "staggered"}),
               _circuit(_SQUARE), _town, _stereo),
        Preset("hot_arm", "6 s in place; a warm arm enters the picture from 3 s to 5 s",
               _settings({"flight.gust_m": 0.01}), _hover, _street_with_arm, _stereo),
    )  # fmt: skip


# --- hand-held visible + thermal paths of Dai et al. 2019, Table I ------------------------------


def _hand_held() -> tuple[Preset, ...]:
    table = (
        (113.81, 0.0688, 29.1738, "indoor"), (89.19, 0.0690, 39.6421, "indoor"),
        (88.99, 0.0581, 33.0630, "indoor"), (102.44, 0.0969, 39.5428, "indoor"),
        (110.47, 0.0724, 28.6348, "indoor"), (159.19, 0.0575, 45.4522, "indoor"),
        (60.94, 0.1162, 31.6708, "indoor"),
    )  # fmt: skip

    def path(duration_s: float, speed_m_s: float, rotation_deg_s: float) -> MakeMotion:
        def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
            return wander(
                (-2.2, 0.2, 1.5), (1.6, 2.0, 0.8), duration_s, speed_m_s, rotation_deg_s, rng
            )

        return motion

    def office(person: bool) -> MakeScene:
        def scene(plan: RunPlan) -> Scene:
            return build_room(plan.config.world.seed, plan.weather.air_kelvin, person=person)

        return scene

    presets = []
    for n, (duration_s, speed, rotation, weather) in enumerate(table, start=1):
        config = _settings(
            {"rate_hz": 20.0, "world.weather": weather, "world.seed": n, "flight.seed": n,
             "ffc.mode": "periodic", "ffc.first_s": 12.0, "ffc.period_s": 25.0}
        )  # fmt: skip
        person = n in (2, 4, 6)
        summary = f"{duration_s:.0f} s by hand in an office, {rotation:.0f} deg/s" + (
            ", somebody sits there" if person else ""
        )
        presets.append(
            Preset(f"ms-{n:02d}", summary, config, path(duration_s, speed, rotation),
                   office(person), _visible_thermal)
        )  # fmt: skip
    return tuple(presets)


# --- targets -----------------------------------------------------------------------------------


def _tripod(seconds: float) -> MakeMotion:
    def motion(config: SimulationConfig, rng: np.random.Generator) -> Motion:
        return fly((0.0, 0.0, 1.5), 0.0, [Hover(seconds)], Limits(rest_s=0.4), rng, gust_m=0.0)

    return motion


def board_poses_of(plan: RunPlan) -> tuple[NDArray[np.float64], ...]:
    """(4, 4) T_rig_board of every pose of a board preset, one a second."""
    rng = np.random.default_rng([plan.config.world.seed, 9])
    if plan.preset == "board_mask":
        points, distance_m, lean_deg = MASK.holes_m().reshape(-1, 3), (0.7, 1.2), (-20.0, 20.0)
    else:
        points, distance_m, lean_deg = CHESSBOARD.corners_m(), (0.9, 1.5), (15.0, 40.0)
    is_seen = seen_by_all(plan.rig, points, margin_px=12.0 * plan.config.render.scale)
    return tuple(board_poses(BOARD_POSES, distance_m, lean_deg, is_seen, rng))


def _board(plan: RunPlan) -> Scene:
    if plan.preset == "board_mask":
        mesh = heated_mask(MASK, warm_kelvin=plan.config.world.target_kelvin)
    else:
        mesh = aluminium_chessboard(CHESSBOARD)
    T_map_rig = plan.T_map_rig(0.0)
    poses = [T_map_rig @ T_rig_board for T_rig_board in board_poses_of(plan)]
    return board_scene(mesh, poses, hold_s=1.0)


def _targets() -> tuple[Preset, ...]:
    at_rest = {"rate_hz": 1.0, "flight.tilt_down_deg": 0.0, "render.lag": "none"}
    board = {**at_rest, "duration_s": BOARD_POSES - 1.0, "render.edge_rays": 16}
    return (
        Preset("board_aluminium", "a polished chessboard under a clear sky, 27 poses",
               _settings({**board, "world.weather": "sunny_day"}),
               _tripod(BOARD_POSES), _board, _stereo),
        Preset("board_mask", "a mask board before a heater, 27 poses",
               _settings({**board, "world.weather": "cloudy_day", "world.target_kelvin": 25.0}),
               _tripod(BOARD_POSES), _board, _stereo),
        Preset("blackbody", "a uniform source that fills both views; world.air_celsius sets it",
               _settings({"world.air_celsius": 26.85, "render.lag": "none", "rate_hz": 30.0}),
               _tripod(4.0), lambda _: blackbody_scene(), _stereo),
        Preset("step", "a uniform source that warms by 5 K after 1 s, seen at 1000 Hz",
               _settings({"world.air_celsius": 26.85, "render.lag": "rendered", "rate_hz": 1000.0,
                          "render.lag_samples": 64, "render.scale": 0.1, "duration_s": 1.1}),
               _tripod(4.0), lambda _: blackbody_scene(_STEP_S, _STEP_KELVIN), _stereo),
    )  # fmt: skip
