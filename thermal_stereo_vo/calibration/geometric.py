"""From board views to cameras and rig: start, drop outliers, choose views, judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermal_stereo_vo.calibration.bundle import Solution
from thermal_stereo_vo.calibration.guards import check_distinct, check_enough
from thermal_stereo_vo.calibration.initial_rig import initial_rig
from thermal_stereo_vo.calibration.judgement import judged
from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.calibration.problem import Problem, Settings
from thermal_stereo_vo.calibration.rejection import without_asynchronous, without_outliers
from thermal_stereo_vo.calibration.result import CalibrationResult
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.view_selection import coverage, select_views
from thermal_stereo_vo.calibration.views import BoardShot


def calibrate(
    shots: Sequence[BoardShot],
    target: Target,
    sizes: Mapping[str, tuple[int, int]],
    settings: Settings | None = None,
) -> CalibrationResult:
    """Calibrate the cameras named in ``sizes`` (role -> (width, height)), one or two.

    The first role is the reference.  Shots that only one camera of a pair saw help its lens.

    Raises CalibrationError for too few views, views all alike, views that determine no camera, and
    a pair that never saw the board together.
    """
    settings = settings or Settings()
    roles = tuple(sizes)
    lenses = {
        role: settings.known[role].lens if role in settings.known else settings.lens or Lens.RADTAN4
        for role in roles
    }
    problem = Problem(target, roles, sizes, lenses, list(shots), settings.known)
    for role in roles:
        check_enough([s.views[role] for s in problem.shots if role in s.views], role)
        check_distinct([s.views[role] for s in problem.shots if role in s.views], role, sizes[role])
    rig = initial_rig(problem)
    undecided = [role for role in roles if settings.lens is None and role not in settings.known]
    solution = without_outliers(problem, rig, undecided)
    if len(roles) == 2:
        solution = without_asynchronous(problem, solution)
    training = _chosen(problem, solution, settings.view_limit)
    solution = problem.solved(solution.rig, training)
    return judged(problem, solution, training)


def _chosen(problem: Problem, solution: Solution, limit: int) -> list[int]:
    """Views to calibrate with: all, or the best ``limit`` of them."""
    everything = list(range(len(problem.shots)))
    if len(everything) <= limit:
        return everything
    cells = {}
    for v, shot in enumerate(problem.shots):
        maps = []
        for role in problem.roles:
            pixels = shot.views[role].pixels if role in shot.views else np.zeros((0, 2))
            maps.append(coverage(pixels, problem.sizes[role]).ravel())
        cells[v] = np.concatenate(maps)
    return sorted(select_views(solution.information, solution.known, cells, limit).chosen)
