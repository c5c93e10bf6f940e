"""From board views to cameras and rig: estimate, drop outliers, choose views, judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import (
    Observation,
    Prior,
    Rig,
    Solution,
    place_covariance,
    point_weights,
    scaled_inverse,
    solve,
)
from thermal_stereo_vo.calibration.figures import (
    PairView,
    PixelErrors,
    StereoErrors,
    paired,
    pixel_errors,
    stereo_errors,
)
from thermal_stereo_vo.calibration.guards import (
    MIN_VIEWS,
    check_distinct,
    check_enough,
    spread_warnings,
    tilt_range,
    uncertainty_warnings,
)
from thermal_stereo_vo.calibration.initial import (
    agreed_place,
    board_pose,
    half_turn,
    has_half_turn,
    initial_lens,
    relative_place,
)
from thermal_stereo_vo.calibration.lenses import Lens, project, to_camera
from thermal_stereo_vo.calibration.mask_model import (
    DEPTH,
    WIDENING,
    flattened,
    hole_sides,
    prior_sigma,
)
from thermal_stereo_vo.calibration.result import (
    CalibrationResult,
    CameraResult,
    PairResult,
    ViewRecord,
)
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.view_selection import (
    coverage,
    jackknife_covariance,
    select_views,
)
from thermal_stereo_vo.calibration.views import BoardShot, BoardView, camera_called
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse, transform_points

Array = NDArray[np.float64]

_OUTLIER_FACTOR = 3.0
_OUTLIER_FLOOR_PX = 0.3
_FOLDS = 5
_CHI2_TWO = 9.21
_MIN_HELD_OUT = 5


@dataclass(frozen=True)
class KnownLens:
    """Parameters (P,) and covariance (P, P) of a camera in the order of its lens model."""

    lens: Lens
    parameters: Array
    covariance: Array


@dataclass(frozen=True)
class Settings:
    """How to calibrate.

    ``lens`` is the model of all cameras; None fits ``radtan4`` and leaves out p1 and p2 where they
    do not differ from zero by more than chance, since on few views they run away with the image
    centre.  ``view_limit`` views at most take part, the rest tests.
    ``known`` brings lenses calibrated before (role -> lens), which then only move within their own
    uncertainty.

    Raises CalibrationError for a ``view_limit`` below five.
    """

    lens: Lens | None = None
    view_limit: int = 40
    known: Mapping[str, KnownLens] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.view_limit < MIN_VIEWS:
            raise CalibrationError(
                f"{self.view_limit} views are too few to calibrate with: --max-views must be at "
                f"least {MIN_VIEWS}"
            )


@dataclass
class _Problem:
    """Views in the making: a shot may be split when its cameras saw the board at other moments."""

    target: Target
    roles: tuple[str, ...]
    sizes: Mapping[str, tuple[int, int]]
    lenses: dict[str, Lens]
    shots: list[BoardShot]
    known: Mapping[str, KnownLens]
    records: dict[str, ViewRecord] = field(default_factory=dict)

    def observations(self, indices: Sequence[int] | None = None) -> list[Observation]:
        points = self.target.points_m
        chosen = range(len(self.shots)) if indices is None else indices
        sides = hole_sides(self.target)
        return [
            Observation(
                v,
                c,
                points[view.ids],
                view.pixels,
                point_weights(view.sigma_px),
                None if sides is None else sides[view.ids],
            )
            for v in chosen
            for c, role in enumerate(self.roles)
            if (view := self.shots[v].views.get(role)) is not None
        ]

    def prior(self, roles: Sequence[str] | None = None) -> Prior | None:
        """What is known beforehand, or None."""
        sigma = prior_sigma(self.target)
        if not self.known and not len(sigma):
            return None
        known = [self.known.get(role) for role in roles or self.roles]
        lenses = tuple(None if k is None else (k.parameters, k.covariance) for k in known)
        return Prior(lenses, sigma)

    def solved(
        self, rig: Rig, indices: Sequence[int] | None = None, *, tolerance: float = 1e-9
    ) -> Solution:
        """Everything estimated from the views ``indices`` (default: all)."""
        return solve(rig, self.observations(indices), prior=self.prior(), tolerance=tolerance)

    def drop(self, v: int, reason: str) -> None:
        self.records[self.shots[v].name] = ViewRecord(self.shots[v].name, "refused", reason)
        del self.shots[v]

    def pairs(self) -> list[int]:
        return [v for v, shot in enumerate(self.shots) if len(shot.views) == len(self.roles)]


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
    problem = _Problem(target, roles, sizes, lenses, list(shots), settings.known)
    for role in roles:
        check_enough([s.views[role] for s in problem.shots if role in s.views], role)
        check_distinct([s.views[role] for s in problem.shots if role in s.views], role, sizes[role])
    rig = _initial_rig(problem)
    undecided = [role for role in roles if settings.lens is None and role not in settings.known]
    solution = _without_outliers(problem, rig, undecided)
    if len(roles) == 2:
        solution = _without_asynchronous(problem, solution)
    training = _chosen(problem, solution, settings.view_limit)
    solution = problem.solved(solution.rig, training)
    return _judged(problem, solution, training)


def _initial_rig(problem: _Problem) -> Rig:
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


def _initial_place(problem: _Problem, cameras: Sequence[Camera]) -> Array:
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
    shots: Sequence[BoardShot],
    roles: Sequence[str],
    cameras: Sequence[Camera],
    target: Target,
) -> list[BoardShot]:
    """The shots with the board numbered from the same end in both cameras."""
    if not any(all(role in shot.views for role in roles) for shot in shots):
        return list(shots)
    return _agreed(shots, roles, cameras, target)[1]


def _agreed(
    shots: Sequence[BoardShot],
    roles: Sequence[str],
    cameras: Sequence[Camera],
    target: Target,
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


def _view_rms(
    solution: Solution, observations: Sequence[Observation]
) -> dict[tuple[int, int], float]:
    """(view, camera) -> RMS norm, px."""
    return {
        (o.view, o.camera): float(np.sqrt(np.mean(np.sum(r**2, axis=1))))
        for o, r in zip(observations, solution.residuals, strict=True)
    }


def _limit(values: Sequence[float]) -> float:
    return max(_OUTLIER_FACTOR * float(np.median(values)), _OUTLIER_FLOOR_PX)


def _without_outliers(problem: _Problem, rig: Rig, undecided: Sequence[str]) -> Solution:
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
            rms = {v: r for (v, _), r in _view_rms(solution, observations).items()}
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


def _posed_by(problem: _Problem, rig: Rig, c: int) -> Rig:
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
    covariance = _honest_covariance(solution)[6:8, 6:8]
    return bool(tangential @ scaled_inverse(covariance) @ tangential > _CHI2_TWO)


def _refuse(problem: _Problem, rig: Rig, v: int, role: str, reason: str) -> Rig:
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


def _place_solved(problem: _Problem, rig: Rig) -> Solution:
    """First the places of cameras and boards, then everything."""
    rough = solve(rig, problem.observations(), fixed_lenses=True, tolerance=1e-3)
    return problem.solved(rough.rig, tolerance=1e-6)


def _without_asynchronous(problem: _Problem, solution: Solution) -> Solution:
    """Split shots in which the board moved between the exposures: each eye alone still fits."""
    first, second = problem.roles
    while True:
        rms = _view_rms(solution, problem.observations())
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


def _chosen(problem: _Problem, solution: Solution, limit: int) -> list[int]:
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


def _judged(problem: _Problem, solution: Solution, training: Sequence[int]) -> CalibrationResult:
    rig = solution.rig
    observations = problem.observations(training)
    covariance = _honest_covariance(solution)
    rms = _view_rms(solution, observations)
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


def _honest_covariance(solution: Solution) -> Array:
    """The larger of two estimates: independent points, and the spread when views are left out."""
    formal = solution.covariance
    jackknife = jackknife_covariance(solution.information, solution.known)
    ratio = np.diag(jackknife) / np.maximum(np.diag(formal), 1e-300)
    stretch = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(formal * np.outer(stretch, stretch))


def _records(
    problem: _Problem, training: Sequence[int], rms: Mapping[tuple[int, int], float]
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
    problem: _Problem,
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
    return _HeldOut(cameras, _merged(stereo), how)


def _posed_residuals(problem: _Problem, rig: Rig, c: int, view: BoardView) -> Array:
    """Residuals of one view with its own best pose and a lens that never saw it."""
    points = problem.target.points_m[view.ids]
    camera = to_camera(rig.lenses[c], rig.parameters[c], problem.sizes[problem.roles[c]])
    T = board_pose(camera, points, view.pixels)
    in_camera = transform_points(T, points)
    return view.pixels - project(rig.lenses[c], rig.parameters[c], in_camera)[0]


def _flat_shots(problem: _Problem, rig: Rig) -> list[BoardShot]:
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
    problem: _Problem, flat: Sequence[BoardShot], rig: Rig, views: Sequence[int]
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


def pair_views(
    shots: Sequence[BoardShot], roles: Sequence[str], indices: Sequence[int] | None = None
) -> list[PairView]:
    """What both cameras saw in each of the shots."""
    chosen = range(len(shots)) if indices is None else indices
    found = []
    for v in chosen:
        views = shots[v].views
        if all(role in views for role in roles):
            both = paired(shots[v].name, views[roles[0]], views[roles[1]])
            if both is not None:
                found.append(both)
    return found


def _merged(parts: Sequence[StereoErrors]) -> StereoErrors | None:
    """Means over folds weighted by points; root mean squares combine as such."""
    if not parts:
        return None
    weights = np.array([p.points for p in parts], dtype=np.float64)
    weights /= weights.sum()

    def mean(name: str) -> float:
        return float(weights @ [getattr(p, name) for p in parts])

    def rms(name: str) -> float:
        return float(np.sqrt(weights @ [getattr(p, name) ** 2 for p in parts]))

    return StereoErrors(
        epipolar_12_px=mean("epipolar_12_px"),
        epipolar_21_px=mean("epipolar_21_px"),
        spacing_error_percent=mean("spacing_error_percent"),
        spacing_rms_m=rms("spacing_rms_m"),
        plane_rms_m=rms("plane_rms_m"),
        distance_error_percent=mean("distance_error_percent"),
        yaw_error_rad=mean("yaw_error_rad"),
        in_front=mean("in_front"),
        points=sum(p.points for p in parts),
        views=sum(p.views for p in parts),
    )
