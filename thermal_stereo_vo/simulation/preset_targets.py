"""Calibration boards and uniform sources before a rig at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.preset import MakeMotion, Preset, settings_of, stereo
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.scene import Scene
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
from thermal_stereo_vo.simulation.trajectory import Hover, Limits, Motion, fly

BOARD_POSES = 27
_STEP_S, _STEP_KELVIN = 1.0, 5.0


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


def targets() -> tuple[Preset, ...]:
    """Boards in known poses, and uniform sources."""
    at_rest = {"rate_hz": 1.0, "flight.tilt_down_deg": 0.0, "render.lag": "none"}
    board = {**at_rest, "duration_s": BOARD_POSES - 1.0, "render.edge_rays": 16}
    return (
        Preset("board_aluminium", "a polished chessboard under a clear sky, 27 poses",
               settings_of({**board, "world.weather": "sunny_day"}),
               _tripod(BOARD_POSES), _board, stereo),
        Preset("board_mask", "a mask board before a heater, 27 poses",
               settings_of({**board, "world.weather": "cloudy_day", "world.target_kelvin": 25.0}),
               _tripod(BOARD_POSES), _board, stereo),
        Preset("blackbody", "a uniform source that fills both views; world.air_celsius sets it",
               settings_of({"world.air_celsius": 26.85, "render.lag": "none", "rate_hz": 30.0}),
               _tripod(4.0), lambda _: blackbody_scene(), stereo),
        Preset("step", "a uniform source that warms by 5 K after 1 s, seen at 1000 Hz",
               settings_of({"world.air_celsius": 26.85, "render.lag": "rendered", "rate_hz": 1000.0,
                          "render.lag_samples": 64, "render.scale": 0.1, "duration_s": 1.1}),
               _tripod(4.0), lambda _: blackbody_scene(_STEP_S, _STEP_KELVIN), stereo),
    )  # fmt: skip
