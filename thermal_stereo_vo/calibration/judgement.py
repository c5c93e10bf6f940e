"""How good a calibration is: on its own views, and on views that took no part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import Rig, Solution, place_covariance
from thermal_stereo_vo.calibration.figures import (
    PixelErrors,
    StereoErrors,
    merged,
    pair_views,
    pixel_errors,
    stereo_errors,
)
from thermal_stereo_vo.calibration.guards import spread_warnings, tilt_range, uncertainty_warnings
from thermal_stereo_vo.calibration.initial import board_pose
from thermal_stereo_vo.calibration.lenses import project, to_camera
from thermal_stereo_vo.calibration.mask_model import DEPTH, WIDENING, flattened
from thermal_stereo_vo.calibration.problem import Problem, view_rms
from thermal_stereo_vo.calibration.result import (
    CalibrationResult,
    CameraResult,
    PairResult,
    ViewRecord,
)
from thermal_stereo_vo.calibration.view_selection import coverage, honest_covariance
from thermal_stereo_vo.calibration.views import BoardShot, BoardView
from thermal_stereo_vo.core.transforms import transform_points

Array = NDArray[np.float64]

_FOLDS = 5
_MIN_HELD_OUT = 5


def judged(problem: Problem, solution: Solution, training: Sequence[int]) -> CalibrationResult:
    """The result with its covariance, figures, views and warnings."""
    rig = solution.rig
    observations = problem.observations(training)
    covariance = honest_covariance(solution)
    rms = view_rms(solution, observations)
    tests = [v for v in range(len(problem.shots)) if v not in set(training)]
    flat = _flat_shots(problem, rig)
    held_out = _held_out(problem, flat, solution, training, tests)

    cameras: dict[str, CameraResult] = {}
    warnings: list[str] = []
    residual_map = {}
    for c, role in enumerate(problem.roles):
        size = problem.sizes[role]
        views = [problem.shots[v].views[role] for v in training if role in problem.shots[v].views]
        residuals = [
            r for o, r in zip(observations, solution.residuals, strict=True) if o.camera == c
        ]
        pixels = np.concatenate([view.pixels for view in views])
        rotations = [
            (rig.T_camera_reference[c] @ rig.T_reference_board[v])[:3, :3]
            for v in training
            if role in problem.shots[v].views
        ]
        part = rig.lens_slice(c)
        cameras[role] = CameraResult(
            camera=to_camera(problem.lenses[role], rig.parameters[c], size),
            lens=problem.lenses[role],
            covariance=covariance[part, part],
            training=pixel_errors(residuals),
            held_out=held_out.cameras.get(role),
            coverage=coverage(pixels, size),
            tilt_range_rad=tilt_range(rotations),
        )
        residual_map[role] = np.hstack([pixels, np.concatenate(residuals)])
        warnings += spread_warnings(cameras[role], role, len(views))
        warnings += uncertainty_warnings(cameras[role], role)
    pair = None
    if len(problem.roles) == 2:
        twist, chart = place_covariance(rig, covariance, 1)
        pair = PairResult(
            T_second_first=rig.T_camera_reference[1],
            covariance=twist,
            sigma=np.sqrt(np.diag(chart)),
            training=_stereo(problem, flat, rig, training),
            held_out=held_out.pair,
            held_out_how=held_out.how,
        )
    return CalibrationResult(
        board=str(problem.target),
        cameras=cameras,
        pair=pair,
        views=_records(problem, training, rms),
        warnings=tuple(warnings),
        hole_widening_m=float(rig.board[WIDENING]) if len(rig.board) else None,
        hole_depth_m=float(rig.board[DEPTH]) if len(rig.board) else None,
        residuals=residual_map,
    )


def _records(
    problem: Problem, training: Sequence[int], rms: Mapping[tuple[int, int], float]
) -> tuple[ViewRecord, ...]:
    records = dict(problem.records)
    inside = set(training)
    for v, shot in enumerate(problem.shots):
        errors = {role: rms[v, c] for c, role in enumerate(problem.roles) if (v, c) in rms}
        old = records.get(shot.name)
        if old is not None:
            records[shot.name] = replace(old, rms_px={**old.rms_px, **errors})
        else:
            state = "used" if v in inside else "held out"
            records[shot.name] = ViewRecord(shot.name, state, "", errors)
    return tuple(records[name] for name in sorted(records))


@dataclass(frozen=True)
class _HeldOut:
    cameras: dict[str, PixelErrors]
    pair: StereoErrors | None
    how: str


def _held_out(
    problem: Problem,
    flat: Sequence[BoardShot],
    solution: Solution,
    training: Sequence[int],
    tests: Sequence[int],
) -> _HeldOut:
    """Figures on views that took no part: those not chosen, or by cross-validation in folds."""
    pairs = problem.pairs()
    enough = [v for v in tests if v in pairs] if len(problem.roles) == 2 else list(tests)
    if len(enough) >= _MIN_HELD_OUT:
        folds = [(solution.rig, list(tests))]
        how = f"{len(tests)} views that took no part"
    else:
        # Every view is held out once, dealt so that folds are alike.
        count = min(_FOLDS, len(training))
        folds = []
        for k in range(count):
            out = list(training[k::count])
            rest = [v for v in training if v not in out]
            if any(sum(role in problem.shots[v].views for v in rest) < 3 for role in problem.roles):
                continue
            if len(problem.roles) == 2 and sum(v in pairs for v in rest) < 2:
                continue
            folds.append((problem.solved(solution.rig, rest, tolerance=1e-6).rig, out))
        how = f"cross-validation in {len(folds)} folds"
    residuals: dict[str, list[Array]] = {role: [] for role in problem.roles}
    stereo: list[StereoErrors] = []
    for rig, out in folds:
        for v in out:
            for c, role in enumerate(problem.roles):
                view = flat[v].views.get(role)
                if view is not None:
                    residuals[role].append(_posed_residuals(problem, rig, c, view))
        together = [v for v in out if v in pairs]
        if len(problem.roles) == 2 and together:
            stereo.append(_stereo(problem, flat, rig, together))
    cameras = {role: pixel_errors(r) for role, r in residuals.items() if len(r) >= 2}
    return _HeldOut(cameras, merged(stereo), how)


def _posed_residuals(problem: Problem, rig: Rig, c: int, view: BoardView) -> Array:
    """Residuals of one view with its own best pose and a lens that never saw it."""
    points = problem.target.points_m[view.ids]
    camera = to_camera(rig.lenses[c], rig.parameters[c], problem.sizes[problem.roles[c]])
    T = board_pose(camera, points, view.pixels)
    in_camera = transform_points(T, points)
    return view.pixels - project(rig.lenses[c], rig.parameters[c], in_camera)[0]


def _flat_shots(problem: Problem, rig: Rig) -> list[BoardShot]:
    """The shots with the thickness of a mask taken out; the shots themselves for flat boards."""
    cameras = {
        role: to_camera(rig.lenses[c], rig.parameters[c], problem.sizes[role])
        for c, role in enumerate(problem.roles)
    }
    return [
        BoardShot(
            shot.name,
            {
                role: flattened(view, cameras[role], problem.target, rig.board)
                for role, view in shot.views.items()
            },
        )
        for shot in problem.shots
    ]


def _stereo(
    problem: Problem, flat: Sequence[BoardShot], rig: Rig, views: Sequence[int]
) -> StereoErrors:
    first, second = (
        to_camera(rig.lenses[c], rig.parameters[c], problem.sizes[role])
        for c, role in enumerate(problem.roles)
    )
    return stereo_errors(
        first,
        second,
        rig.T_camera_reference[1],
        problem.target,
        pair_views(flat, problem.roles, views),
    )
