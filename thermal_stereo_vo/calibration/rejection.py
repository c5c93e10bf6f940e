"""Views that do not fit: refused, or split where the cameras saw different moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import Rig, Solution, scaled_inverse, solve
from thermal_stereo_vo.calibration.guards import check_enough
from thermal_stereo_vo.calibration.initial import board_pose
from thermal_stereo_vo.calibration.lenses import Lens, to_camera
from thermal_stereo_vo.calibration.problem import Problem, view_rms
from thermal_stereo_vo.calibration.result import ViewRecord
from thermal_stereo_vo.calibration.view_selection import honest_covariance
from thermal_stereo_vo.calibration.views import BoardShot, camera_called
from thermal_stereo_vo.core.transforms import inverse

Array = NDArray[np.float64]

_OUTLIER_FACTOR = 3.0
_OUTLIER_FLOOR_PX = 0.3
_CHI2_TWO = 9.21


def without_outliers(problem: Problem, rig: Rig, undecided: Sequence[str]) -> Solution:
    """Solve each camera on its own and drop views that its own lens cannot explain.

    Settles the lens model of the cameras ``undecided``.
    """
    parameters = list(rig.parameters)
    for c, role in enumerate(problem.roles):
        rig = _posed_by(problem, rig, c)
        while True:
            seen = [v for v, s in enumerate(problem.shots) if role in s.views]
            alone = Rig(
                (problem.lenses[role],),
                (parameters[c],),
                (np.eye(4),),
                tuple(rig.T_camera_reference[c] @ T for T in rig.T_reference_board),
                rig.board,
            )
            observations = [
                replace(o, camera=0) for o in problem.observations(seen) if o.camera == c
            ]
            prior = problem.prior([role])
            solution = solve(alone, observations, prior=prior, tolerance=1e-6)
            parameters[c] = solution.rig.parameters[0]
            rig = replace(rig, board=solution.rig.board)
            rms = {v: r for (v, _), r in view_rms(solution, observations).items()}
            worst = max(rms, key=lambda v: rms[v])
            limit_px = _limit(list(rms.values()))
            boards = list(rig.T_reference_board)
            for v in seen:
                boards[v] = inverse(rig.T_camera_reference[c]) @ solution.rig.T_reference_board[v]
            rig = replace(rig, T_reference_board=tuple(boards))
            if rms[worst] <= limit_px:
                if role in undecided and problem.lenses[role] is Lens.RADTAN4:
                    if _decentred(solution):
                        break
                    problem.lenses[role] = Lens.RADTAN2
                    parameters[c] = parameters[c][:6]
                    continue
                break
            reason = (
                f"{rms[worst]:.2f} px off in {camera_called(role)} where others are "
                f"{np.median(list(rms.values())):.2f}: blurred, bent or misread"
            )
            rig = _refuse(problem, rig, worst, role, reason)
            check_enough([s.views[role] for s in problem.shots if role in s.views], role)
    lenses = tuple(problem.lenses[role] for role in problem.roles)
    rig = replace(rig, lenses=lenses, parameters=tuple(parameters))
    if len(problem.roles) == 1:
        return problem.solved(rig, tolerance=1e-6)
    return _place_solved(problem, rig)


def _posed_by(problem: Problem, rig: Rig, c: int) -> Rig:
    """The boards where camera c alone sees them: the lens of another may still be far off."""
    role, points = problem.roles[c], problem.target.points_m
    camera = to_camera(rig.lenses[c], rig.parameters[c], problem.sizes[role])
    boards = list(rig.T_reference_board)
    for v, shot in enumerate(problem.shots):
        view = shot.views.get(role)
        if view is not None:
            T_camera_board = board_pose(camera, points[view.ids], view.pixels)
            boards[v] = inverse(rig.T_camera_reference[c]) @ T_camera_board
    return replace(rig, T_reference_board=tuple(boards))


def _decentred(solution: Solution) -> bool:
    """Whether p1 and p2 of a single camera differ from zero (Wald's test at 1 %)."""
    tangential = solution.rig.parameters[0][6:8]
    covariance = honest_covariance(solution)[6:8, 6:8]
    return bool(tangential @ scaled_inverse(covariance) @ tangential > _CHI2_TWO)


def _refuse(problem: Problem, rig: Rig, v: int, role: str, reason: str) -> Rig:
    """Take one camera's view out of a shot, and the shot when nothing is left."""
    shot = problem.shots[v]
    rest = {r: view for r, view in shot.views.items() if r != role}
    if rest:
        problem.shots[v] = BoardShot(shot.name, rest)
        problem.records[shot.name] = ViewRecord(shot.name, "used", f"without {role}: {reason}")
        return rig
    problem.drop(v, reason)
    boards = tuple(T for i, T in enumerate(rig.T_reference_board) if i != v)
    return replace(rig, T_reference_board=boards)


def _place_solved(problem: Problem, rig: Rig) -> Solution:
    """First the places of cameras and boards, then everything."""
    rough = solve(rig, problem.observations(), fixed_lenses=True, tolerance=1e-3)
    return problem.solved(rough.rig, tolerance=1e-6)


def without_asynchronous(problem: Problem, solution: Solution) -> Solution:
    """Split shots in which the board moved between the exposures: each eye alone still fits."""
    first, second = problem.roles
    while True:
        rms = view_rms(solution, problem.observations())
        pairs = problem.pairs()
        joint = {v: max(rms[v, 0], rms[v, 1]) for v in pairs}
        usual_px, limit_px = float(np.median(list(joint.values()))), _limit(list(joint.values()))
        worst = max(joint.values())
        if worst <= limit_px:
            return solution
        boards = list(solution.rig.T_reference_board)
        # The far-off ones at once, those nearer the limit one by one.
        for v in [v for v in pairs if joint[v] > max(limit_px, 0.5 * worst)]:
            shot = problem.shots[v]
            reason = (
                f"{joint[v]:.2f} px off for both cameras together where others are "
                f"{usual_px:.2f}: the board moved between the two exposures, or one of them is "
                "misread; used for each lens only"
            )
            problem.records[shot.name] = ViewRecord(shot.name, "split", reason)
            problem.shots[v] = BoardShot(shot.name, {first: shot.views[first]})
            problem.shots.append(BoardShot(shot.name, {second: shot.views[second]}))
            boards.append(boards[v])
        check_enough([problem.shots[v].views[second] for v in problem.pairs()], f"{first}+{second}")
        rig = replace(solution.rig, T_reference_board=tuple(boards))
        solution = problem.solved(rig, tolerance=1e-6)


def _limit(values: Sequence[float]) -> float:
    return max(_OUTLIER_FACTOR * float(np.median(values)), _OUTLIER_FLOOR_PX)
