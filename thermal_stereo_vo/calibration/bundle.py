"""Joint least squares over cameras, rig and board poses, with what each view tells of the rig.

All cameras, all views and all points at once: a view that only one camera sees still helps that
camera's lens.  Board poses are eliminated view by view (Schur complement), so that each view is
left with its information on the shared parameters alone; uncertainty, jackknife, outlier tests and
the choice of views all come from these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.lenses import Lens, project
from thermal_stereo_vo.calibration.mask_model import seen_corners
from thermal_stereo_vo.core.transforms import exp_se3, inverse, skew, transform_points

Array = NDArray[np.float64]

_ITERATIONS = 40
_HUBER_SIGMAS = 3.0
_SIGMA_FLOOR_PX = 0.1


@dataclass(frozen=True)
class Observation:
    """Points (K, 3) of the board and where camera ``camera`` saw them in view ``view``.

    ``weight`` (K,) is relative, 1 for a point as sharp as the rest of the model allows.
    ``sides`` (K, 2) tells which sides of a mask hole meet in each point (see ``mask_model``); None
    for flat boards.
    """

    view: int
    camera: int
    points_m: Array
    pixels: Array
    weight: Array
    sides: Array | None = None


@dataclass(frozen=True)
class Rig:
    """What is estimated.

    ``parameters[c]`` are the lens parameters of camera c, ``T_camera_reference[c]`` (4, 4) its
    place
    (the first is the reference and stays the identity), ``T_reference_board[v]`` (4, 4) the boards.
    ``board`` (4,) are the parameters of mask holes (see ``mask_model``), (0,) for flat boards.
    """

    lenses: tuple[Lens, ...]
    parameters: tuple[Array, ...]
    T_camera_reference: tuple[Array, ...]
    T_reference_board: tuple[Array, ...]
    board: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def shared_count(self) -> int:
        """Lens parameters of all cameras, six for each camera but the first, and the board's."""
        return int(self.board_slice.stop)

    @property
    def board_slice(self) -> slice:
        """Where the parameters of the board stand."""
        start = sum(len(p) for p in self.parameters) + 6 * (len(self.parameters) - 1)
        return slice(start, start + len(self.board))

    def lens_slice(self, camera: int) -> slice:
        """Where a camera's lens parameters stand in the shared vector."""
        start = sum(len(p) for p in self.parameters[:camera])
        return slice(start, start + len(self.parameters[camera]))

    def pose_slice(self, camera: int) -> slice:
        """Where the six of ``T_camera_reference`` (left perturbation) stand; not for camera 0."""
        start = sum(len(p) for p in self.parameters) + 6 * (camera - 1)
        return slice(start, start + 6)

    def moved(self, shared: Array) -> Rig:
        """The rig after a step of the shared parameters (poses by left perturbation)."""
        parameters = tuple(p + shared[self.lens_slice(c)] for c, p in enumerate(self.parameters))
        places = [self.T_camera_reference[0]]
        places += [
            exp_se3(shared[self.pose_slice(c)]) @ self.T_camera_reference[c]
            for c in range(1, len(self.parameters))
        ]
        board = self.board + shared[self.board_slice]
        return replace(self, parameters=parameters, T_camera_reference=tuple(places), board=board)


@dataclass(frozen=True)
class ViewInformation:
    """A view's normal equations on the shared parameters, its pose eliminated.

    Near the solution the view's cost is ``cost - 2 g.d + d'H d`` for a step d of the shared
    parameters with the best pose for each: ``hessian`` (S, S), ``gradient`` (S,).
    """

    hessian: Array
    gradient: Array
    cost: float
    points: int


@dataclass(frozen=True)
class Prior:
    """What is known beforehand.

    Lenses: (mean (P,), covariance (P, P)) or None a camera.  Board: it is flat within
    ``board_sigma`` (B,).
    """

    cameras: tuple[tuple[Array, Array] | None, ...]
    board_sigma: Array


@dataclass(frozen=True)
class Solution:
    """Estimate and what each view says of it.

    ``residuals[i]`` (K, 2) belongs to observation i: measured minus modelled pixels.  ``sigma_px``
    is the standard deviation of one coordinate of a point of weight 1.  ``known`` is the share of
    prior knowledge in the normal equations.  ``covariance`` (S, S) of
    the shared parameters takes independent points.
    """

    rig: Rig
    residuals: tuple[Array, ...]
    information: dict[int, ViewInformation]
    known: ViewInformation
    sigma_px: float
    covariance: Array
    iterations: int


def point_weights(sigma_px: Array) -> Array:
    """Weights of points with the fitted standard deviations ``sigma_px`` (K,).

    Board and lens model err by about a tenth of a pixel even where the fit claims less.
    """
    return np.asarray(_SIGMA_FLOOR_PX**2 / (_SIGMA_FLOOR_PX**2 + np.asarray(sigma_px) ** 2))


def solve(
    rig: Rig,
    observations: Sequence[Observation],
    *,
    fixed_lenses: bool = False,
    prior: Prior | None = None,
    tolerance: float = 1e-9,
) -> Solution:
    """Levenberg-Marquardt with Huber weights at three robust standard deviations.

    ``fixed_lenses`` moves the cameras' places and the boards only.  Ends when a step lowers the
    cost by less than the fraction ``tolerance``.
    """
    damping, iterations = 1e-4, 0
    residuals = _all_residuals(rig, observations)
    scale_px = _robust_scale(residuals, observations)
    cost = _cost(residuals, observations, scale_px) + _prior_cost(rig, prior, scale_px)
    for _round in range(_ITERATIONS):
        iterations += 1
        blocks = _linearise(rig, observations, scale_px)
        gain = 0.0
        for _ in range(8):
            trial = _step(rig, blocks, damping, fixed_lenses, _pull(rig, prior, scale_px))
            if trial is not None:
                trial_residuals = _all_residuals(trial, observations)
                trial_cost = _cost(trial_residuals, observations, scale_px)
                trial_cost += _prior_cost(trial, prior, scale_px)
                if trial_cost <= cost:
                    gain = (cost - trial_cost) / max(cost, 1e-30)
                    rig, residuals, damping = trial, trial_residuals, max(damping * 0.1, 1e-12)
                    break
            damping *= 10.0
        if gain < tolerance:
            break
        scale_px = _robust_scale(residuals, observations)
        cost = _cost(residuals, observations, scale_px) + _prior_cost(rig, prior, scale_px)
    blocks = _linearise(rig, observations, scale_px)
    information = {view: _reduced(block) for view, block in blocks.items()}
    total = 2 * sum(info.points for info in information.values())
    dof = max(total - rig.shared_count - 6 * len(information), 1)
    sigma_px = float(np.sqrt(sum(info.cost for info in information.values()) / dof))
    known = _pull(rig, prior, sigma_px)
    hessian = np.asarray(sum(info.hessian for info in information.values())) + known.hessian
    return Solution(
        rig=rig,
        residuals=tuple(residuals),
        information=information,
        known=known,
        sigma_px=sigma_px,
        covariance=sigma_px**2 * scaled_inverse(hessian),
        iterations=iterations,
    )


def _pull(rig: Rig, prior: Prior | None, scale_px: float) -> ViewInformation:
    """The prior as if it were a view that saw no points."""
    size = rig.shared_count
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    if prior is not None:
        for c, known in enumerate(prior.cameras):
            if known is not None:
                part = rig.lens_slice(c)
                mean, covariance = known
                hessian[part, part] = scale_px**2 * scaled_inverse(covariance)
                gradient[part] = hessian[part, part] @ (mean - rig.parameters[c])
    if prior is not None and len(rig.board):
        part = rig.board_slice
        hessian[part, part] = np.diag(scale_px**2 / prior.board_sigma**2)
        gradient[part] = -hessian[part, part] @ rig.board
    return ViewInformation(hessian, gradient, 0.0, 0)


def _prior_cost(rig: Rig, prior: Prior | None, scale_px: float) -> float:
    if prior is None:
        return 0.0
    pull = _pull(rig, prior, scale_px)
    cost = 0.0
    for c, known in enumerate(prior.cameras):
        if known is not None:
            part = rig.lens_slice(c)
            apart = known[0] - rig.parameters[c]
            cost += float(apart @ pull.hessian[part, part] @ apart)
    part = rig.board_slice
    return cost + float(rig.board @ pull.hessian[part, part] @ rig.board)


def scaled_inverse(hessian: Array) -> Array:
    """Pseudo-inverse after scaling to a unit diagonal: parameters differ by ten decades."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    inverse = np.linalg.pinv(hessian * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    return np.asarray(inverse * np.outer(scale, scale))


@dataclass
class _Block:
    """Normal equations of one view: shared with shared, shared with pose, pose with pose."""

    shared: Array
    mixed: Array
    pose: Array
    gradient_shared: Array
    gradient_pose: Array
    cost: float = 0.0
    points: int = 0


def _all_residuals(rig: Rig, observations: Sequence[Observation]) -> list[Array]:
    residuals = []
    for o in observations:
        T = rig.T_camera_reference[o.camera] @ rig.T_reference_board[o.view]
        points = transform_points(T, _board_points(rig, o, T)[0])
        lens, parameters = rig.lenses[o.camera], rig.parameters[o.camera]
        residuals.append(o.pixels - project(lens, parameters, points)[0])
    return residuals


def _board_points(rig: Rig, o: Observation, T_camera_board: Array) -> tuple[Array, Array]:
    """(K, 3) points of the board as this camera sees them, (K, 3, B) by the board's parameters."""
    if o.sides is None:
        return o.points_m, np.zeros((len(o.points_m), 3, len(rig.board)))
    return seen_corners(o.points_m, o.sides, rig.board, inverse(T_camera_board)[:3, 3])


def _robust_scale(residuals: list[Array], observations: Sequence[Observation]) -> float:
    """Standard deviation of one coordinate from the median of the weighted norms (Rayleigh)."""
    norms = np.concatenate(
        [
            np.linalg.norm(r, axis=1) * np.sqrt(o.weight)
            for r, o in zip(residuals, observations, strict=True)
        ]
    )
    return max(float(np.median(norms)) / 1.1774, 1e-6)


def _huber(residual: Array, weight: Array, scale_px: float) -> tuple[Array, Array]:
    """Weights (K,) of the reweighted squares and costs (K,)."""
    norm = np.linalg.norm(residual, axis=1) * np.sqrt(weight)
    limit = _HUBER_SIGMAS * scale_px
    factor = np.where(norm > limit, limit / np.maximum(norm, 1e-30), 1.0)
    cost = np.where(norm > limit, limit * (2.0 * norm - limit), norm**2)
    return weight * factor, cost


def _cost(
    residuals: Sequence[Array], observations: Sequence[Observation], scale_px: float
) -> float:
    total = sum(
        float(_huber(residual, o.weight, scale_px)[1].sum())
        for residual, o in zip(residuals, observations, strict=True)
    )
    return total if np.isfinite(total) else np.inf


def _linearise(rig: Rig, observations: Sequence[Observation], scale_px: float) -> dict[int, _Block]:
    size = rig.shared_count
    blocks: dict[int, _Block] = {}
    for o in observations:
        T_camera_reference = rig.T_camera_reference[o.camera]
        T_reference_board = rig.T_reference_board[o.view]
        T_camera_board = T_camera_reference @ T_reference_board
        on_board, by_board = _board_points(rig, o, T_camera_board)
        in_reference = transform_points(T_reference_board, on_board)
        in_camera = transform_points(T_camera_reference, in_reference)
        pixels, by_point, by_lens = project(
            rig.lenses[o.camera], rig.parameters[o.camera], in_camera
        )
        residual = o.pixels - pixels
        weight, _ = _huber(residual, o.weight, scale_px)
        shared = np.zeros((len(pixels), 2, size))
        shared[:, :, rig.lens_slice(o.camera)] = by_lens
        if o.camera > 0:
            shared[:, :, rig.pose_slice(o.camera)] = by_point @ _by_twist(in_camera)
        if len(rig.board):
            shared[:, :, rig.board_slice] = by_point @ T_camera_board[:3, :3] @ by_board
        pose = by_point @ T_camera_reference[:3, :3] @ _by_twist(in_reference)
        s, p, r = shared.reshape(-1, size), pose.reshape(-1, 6), residual.reshape(-1)
        w = np.repeat(weight, 2)
        sw, pw = s.T * w, p.T * w
        block = blocks.get(o.view)
        if block is None:
            block = blocks[o.view] = _Block(
                np.zeros((size, size)),
                np.zeros((size, 6)),
                np.zeros((6, 6)),
                np.zeros(size),
                np.zeros(6),
            )
        block.shared += sw @ s
        block.mixed += sw @ p
        block.pose += pw @ p
        block.gradient_shared += sw @ r
        block.gradient_pose += pw @ r
        block.cost += float(w @ r**2)
        block.points += len(pixels)
    return blocks


def _by_twist(points: Array) -> Array:
    """(K, 3, 6) derivative of Exp(xi) p by xi = (rho, phi) at zero."""
    derivative = np.zeros((len(points), 3, 6))
    derivative[:, :, :3] = np.eye(3)
    x, y, z = points.T
    derivative[:, 0, 4], derivative[:, 0, 5] = z, -y
    derivative[:, 1, 3], derivative[:, 1, 5] = -z, x
    derivative[:, 2, 3], derivative[:, 2, 4] = y, -x
    return derivative


def _reduced(block: _Block) -> ViewInformation:
    gain = block.mixed @ scaled_inverse(block.pose)
    hessian = block.shared - gain @ block.mixed.T
    left = float(block.gradient_pose @ scaled_inverse(block.pose) @ block.gradient_pose)
    return ViewInformation(
        hessian=0.5 * (hessian + hessian.T),
        gradient=block.gradient_shared - gain @ block.gradient_pose,
        cost=block.cost - left,
        points=block.points,
    )


def _step(
    rig: Rig,
    blocks: dict[int, _Block],
    damping: float,
    fixed_lenses: bool,
    known: ViewInformation,
) -> Rig | None:
    """One damped Gauss-Newton step, or None when it cannot be computed."""
    size = rig.shared_count
    hessian, gradient = known.hessian.copy(), known.gradient.copy()
    poses = {}
    for view, block in blocks.items():
        damped = block.pose + damping * np.diag(np.diag(block.pose))
        try:
            inverse = np.linalg.inv(damped)
        except np.linalg.LinAlgError:
            return None
        gain = block.mixed @ inverse
        hessian += block.shared - gain @ block.mixed.T
        gradient += block.gradient_shared - gain @ block.gradient_pose
        poses[view] = inverse
    free = np.ones(size, dtype=bool)
    if fixed_lenses:
        free[: sum(len(p) for p in rig.parameters)] = False
        free[rig.board_slice] = False
    step = np.zeros(size)
    if free.any():
        reduced = hessian[np.ix_(free, free)]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-30))
        scaled = reduced * np.outer(scale, scale)
        scaled[np.diag_indices_from(scaled)] += damping
        try:
            step[free] = scale * np.linalg.solve(scaled, scale * gradient[free])
        except np.linalg.LinAlgError:
            return None
    boards = list(rig.T_reference_board)
    for view, block in blocks.items():
        twist = poses[view] @ (block.gradient_pose - block.mixed.T @ step)
        boards[view] = exp_se3(twist) @ boards[view]
    if not np.all(np.isfinite(step)):
        return None
    moved = replace(rig.moved(step), T_reference_board=tuple(boards))
    if any(p[0] <= 0 or p[1] <= 0 for p in moved.parameters):
        return None
    return moved


def place_covariance(rig: Rig, covariance: Array, camera: int) -> tuple[Array, Array]:
    """Covariances (6, 6) of a camera's place: left perturbation, and (t, rotation vector).

    A left perturbation (rho, phi) moves t by rho - [t]x phi and the rotation vector by the inverse
    left Jacobian times phi.
    """
    from thermal_stereo_vo.core.transforms import left_jacobian_so3, log_so3

    part = rig.pose_slice(camera)
    twist = covariance[part, part]
    T = rig.T_camera_reference[camera]
    change = np.zeros((6, 6))
    change[:3, :3] = np.eye(3)
    change[:3, 3:] = -skew(T[:3, 3])
    change[3:, 3:] = np.linalg.inv(left_jacobian_so3(log_so3(T[:3, :3])))
    return twist, change @ twist @ change.T
