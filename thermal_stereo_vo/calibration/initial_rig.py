"""Lenses, places and boards to start a calibration from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import Rig
from thermal_stereo_vo.calibration.guards import check_enough
from thermal_stereo_vo.calibration.initial import (
    agreed_place,
    board_pose,
    half_turn,
    has_half_turn,
    initial_lens,
    relative_place,
)
from thermal_stereo_vo.calibration.lenses import to_camera
from thermal_stereo_vo.calibration.mask_model import prior_sigma
from thermal_stereo_vo.calibration.problem import Problem
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardShot
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse

Array = NDArray[np.float64]


def initial_rig(problem: Problem) -> Rig:
    """Each lens by itself, then the places of the second camera and of the boards."""
    parameters, cameras = [], []
    for role in problem.roles:
        views = [s.views[role] for s in problem.shots if role in s.views]
        known = problem.known.get(role)
        lens, size = problem.lenses[role], problem.sizes[role]
        if known is not None:
            vector = known.parameters
        else:
            vector = initial_lens(views, problem.target, size, lens, role)
        parameters.append(vector)
        cameras.append(to_camera(lens, vector, size))
    places = [np.eye(4)]
    points = problem.target.points_m
    if len(problem.roles) == 2:
        places.append(_initial_place(problem, cameras))
    boards = []
    for shot in problem.shots:
        c = next(c for c, role in enumerate(problem.roles) if role in shot.views)
        view = shot.views[problem.roles[c]]
        T_camera_board = board_pose(cameras[c], points[view.ids], view.pixels)
        boards.append(inverse(places[c]) @ T_camera_board)
    lenses = tuple(problem.lenses[role] for role in problem.roles)
    flat = np.zeros(len(prior_sigma(problem.target)))
    return Rig(lenses, tuple(parameters), tuple(places), tuple(boards), flat)


def _initial_place(problem: Problem, cameras: Sequence[Camera]) -> Array:
    """T_second_first, and each half-turned second view set right."""
    first, second = problem.roles
    shared = [v for v, s in enumerate(problem.shots) if first in s.views and second in s.views]
    if not shared:
        raise CalibrationError(
            f"no shot shows the board to both cameras: {first} and {second} need views of the same "
            "moment; check that the images are paired and the cameras overlap"
        )
    check_enough([problem.shots[v].views[second] for v in shared], f"{first} and {second}")
    place, shots = _agreed(problem.shots, problem.roles, cameras, problem.target)
    problem.shots[:] = shots
    return place


def with_same_ends(
    shots: Sequence[BoardShot], roles: Sequence[str], cameras: Sequence[Camera], target: Target
) -> list[BoardShot]:
    """The shots with the board numbered from the same end in both cameras."""
    if not any(all(role in shot.views for role in roles) for shot in shots):
        return list(shots)
    return _agreed(shots, roles, cameras, target)[1]


def _agreed(
    shots: Sequence[BoardShot], roles: Sequence[str], cameras: Sequence[Camera], target: Target
) -> tuple[Array, list[BoardShot]]:
    """T_second_first that most shots agree on, and the shots with half-turned views set right."""
    first, second = roles
    points = target.points_m
    samples = {}
    for v, shot in enumerate(shots):
        if not (first in shot.views and second in shot.views):
            continue
        view = shot.views[first]
        T_first = board_pose(cameras[0], points[view.ids], view.pixels)
        options = [shot.views[second]]
        if has_half_turn(target):
            options.append(half_turn(shot.views[second], target))
        samples[v] = [
            relative_place(T_first, board_pose(cameras[1], points[o.ids], o.pixels))
            for o in options
        ]
    place, chosen = agreed_place(samples)
    turned = list(shots)
    for v, choice in chosen.items():
        if choice == 1:
            views = shots[v].views
            turned[v] = BoardShot(
                shots[v].name, {**views, second: half_turn(views[second], target)}
            )
    return place, turned
