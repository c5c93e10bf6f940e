"""Whether the second camera is turned as the calibration says, by what its own patches do.

How the rig moves is known from the first camera.  A second one that is mounted by X moves by
X T X^-1: where the rig turns, its own images tell X (hand-eye calibration), and a rig that is
calibrated rightly needs no change of it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import (
    exp_se3,
    exp_so3,
    inverse,
    log_so3,
    make_transform,
)
from thermal_stereo_vo.odometry.direct.frame_alignment import POSE
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    RHO_MIN,
    PhotometricProblem,
    moved_by,
    noise_of,
)
from thermal_stereo_vo.odometry.direct.rig_kernel import linearise_rig

_MOST_POINTS = 120
_ITERATIONS = 12
_ARM_SIGMA = 0.5
_TURN_SIGMA_RAD = 0.3
"""Keeps turns that nothing shows, as that about the way straight ahead, from running away."""
_MEMORY = 12
_LEAST_WINDOWS, _FIRST_WINDOWS = 4, 16
_AT_FIRST = 2.0
"""The first windows, whose depths have yet to settle, are asked for so many times the limit."""
_RELIEF = 0.5
_SIGMAS = 3.0
_LEAST_FITS, _LEAST_ANYWHERE = 0.8, 0.25
_BY_FAR = 0.6
_TRUST = 8.0
"""Variances by residuals are claimed so many times as large, as those of poses are."""


@dataclass(frozen=True)
class Turn:
    """How far one window would turn the second camera.

    ``turn_rad`` (3,) in axes of that camera, ``information`` (3, 3) of it; ``is_half`` where a half
    turn about one of its axes is by far the best, as for a picture that is upside down, or where
    its patches fit nowhere, as for one that is mirrored.
    """

    turn_rad: NDArray[np.float64]
    information: NDArray[np.float64]
    is_half: bool = False


class RigCheck:
    """Gathers what windows say of the turn of the second camera.

    What is told stays told until windows say less than half of the limit: the map gives way to a
    wrong rig, which then looks better than it is.
    """

    def __init__(self, limit_rad: float) -> None:
        self._limit_rad = limit_rad
        self._recent: deque[Turn] = deque(maxlen=_MEMORY)
        self._count = 0
        self.off_rad: float | None = None
        """By how much the camera is turned against the rig; None while it may well be right."""

    def add(self, turn: Turn, *, has_told_scale: bool = False) -> None:
        """Take in what a window said.

        A camera that has told the scale is neither upside down nor mirrored: a later window that
        looks so shows too little.
        """
        if turn.is_half and has_told_scale:
            return
        self._recent.append(turn)
        self._count += 1
        half = [turn.is_half for turn in self._recent]
        if len(half) < _LEAST_WINDOWS:
            return
        if all(half[-_LEAST_WINDOWS:]):
            self.off_rad = np.pi
        elif not any(half):
            self.off_rad = self._angle()

    def _angle(self) -> float | None:
        information = np.sum([turn.information for turn in self._recent], axis=0)
        pull = np.sum([turn.information @ turn.turn_rad for turn in self._recent], axis=0)
        if np.linalg.eigvalsh(information)[0] <= 0.0:
            return self.off_rad
        covariance = np.linalg.inv(information)
        turn_rad = covariance @ pull
        angle = float(np.linalg.norm(turn_rad))
        if angle < _RELIEF * self._limit_rad:
            return None
        axis = turn_rad / angle
        sigma = float(np.sqrt(_TRUST * axis @ covariance @ axis))
        usual = float(np.median([turn.turn_rad @ axis for turn in self._recent]))
        limit_rad = self._limit_rad
        if self._count < _FIRST_WINDOWS:
            limit_rad *= _AT_FIRST
        sure = min(angle - _SIGMAS * sigma, usual) > limit_rad
        return angle if sure or self.off_rad is not None else None


def turn_of_second(
    problem: PhotometricProblem,
    T_k_w: NDArray[np.float64],
    T_rig_camera: NDArray[np.float64],
    gate: float,
    noise: float,
) -> Turn | None:
    """How far the second camera is turned against ``T_rig_camera`` (4, 4), given the keyframes.

    ``T_k_w`` (K, 4, 4) are held; its points' depths and its lever arm, in units of the map, move
    too.  ``noise`` of a pixel, for what is known of the arm.  None where it shows nothing.
    """
    second = _Second(problem, T_k_w, inverse(T_rig_camera), gate, noise)
    patches = np.count_nonzero(second.seen)
    if patches == 0:
        return None
    T, found = second.settle(second.T_given)
    information = found.information / noise_of(found.energies, gate) ** 2
    turn = Turn(log_so3(T[:3, :3] @ second.T_given[:3, :3].T), information)
    if np.count_nonzero(found.energies < gate * gate) > _LEAST_FITS * patches:
        return turn
    half_turns = [make_transform(exp_so3(np.pi * axis), np.zeros(3)) for axis in np.eye(3)]
    least = min(second.settle(T_half @ second.T_given)[1].cost for T_half in half_turns)
    nowhere = np.count_nonzero(found.energies < gate * gate) < _LEAST_ANYWHERE * patches
    return replace(turn, is_half=bool(nowhere) or least < _BY_FAR * found.cost)


class _Second:
    """The second camera's own points, and where they would have the camera."""

    def __init__(
        self,
        problem: PhotometricProblem,
        T_k_w: NDArray[np.float64],
        T_given: NDArray[np.float64],
        gate: float,
        noise: float,
    ) -> None:
        mine = np.flatnonzero(problem.host_cameras == 1)
        mine = mine[:: 1 + len(mine) // _MOST_POINTS]
        self.T_given = T_given
        self.seen = np.ascontiguousarray(problem.seen[mine][:, :, 1])
        T_then = moved_by(problem.twists, problem.lags_s)[:, 1] @ T_k_w
        self._keyframes = problem.images[1], problem.slots, T_then, problem.cameras[1]
        self._rhos = problem.rhos[mine]
        self._points = (
            problem.hosts[mine], problem.bearings[mine], problem.rho_priors[mine],
            problem.prior_information[mine], problem.patches[mine], problem.trusts[mine],
            self.seen, gate,
        )  # fmt: skip
        arm = float(np.linalg.norm(T_given[:3, 3])) + 1e-9
        self._information = np.repeat(
            [(noise / (_ARM_SIGMA * arm)) ** 2, (noise / _TURN_SIGMA_RAD) ** 2], 3
        )

    def settle(self, T: NDArray[np.float64]) -> tuple[NDArray[np.float64], _RigEquations]:
        """T_camera_rig (4, 4) at the minimum near ``T``, by Levenberg-Marquardt."""
        rhos, R_start = self._rhos, T[:3, :3]
        now, then = _RigEquations(*self.seen.shape), _RigEquations(*self.seen.shape)
        self._linearise(T, R_start, rhos, now)
        damping = 1e-4
        for _ in range(_ITERATIONS):
            damped = now.A + np.diag(damping * np.diag(now.A) + 1e-9)
            step = np.asarray(np.linalg.solve(damped, now.g), np.float64)
            T_new, rhos_new = exp_se3(step) @ T, now.depths_after(rhos, step)
            self._linearise(T_new, R_start, rhos_new, then)
            if then.cost < now.cost:
                small = now.cost - then.cost < 1e-4 * now.cost
                T, rhos, now, then = T_new, rhos_new, then, now
                damping = max(0.2 * damping, 1e-8)
                if small:
                    break
            else:
                damping = max(10.0 * damping, 1e-3)
                if damping > 1e3:
                    break
        return T, now

    def _linearise(
        self,
        T: NDArray[np.float64],
        R_start: NDArray[np.float64],
        rhos: NDArray[np.float64],
        out: _RigEquations,
    ) -> None:
        out.cost = linearise_rig(
            *self._keyframes, T, rhos, *self._points, out.A, out.g, out.W, out.h_rho, out.b_rho,
            out.energies,
        )  # fmt: skip
        off = np.zeros(POSE)
        off[:3] = self.T_given[:3, 3] - T[:3, 3]
        off[3:] = log_so3(R_start @ T[:3, :3].T)
        out.A[np.diag_indices(POSE)] += self._information
        out.g += self._information * off
        out.cost += float(self._information @ off**2)


@dataclass
class _RigEquations:
    """Normal equations of one camera's place in the rig, depths eliminated."""

    points: int
    keyframes: int
    cost: float = 0.0
    A: NDArray[np.float64] = field(init=False)
    g: NDArray[np.float64] = field(init=False)
    W: NDArray[np.float64] = field(init=False)
    h_rho: NDArray[np.float64] = field(init=False)
    b_rho: NDArray[np.float64] = field(init=False)
    energies: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        n, k = self.points, self.keyframes
        self.A, self.g, self.W = np.zeros((POSE, POSE)), np.zeros(POSE), np.zeros((n, POSE))
        self.h_rho, self.b_rho, self.energies = np.zeros(n), np.zeros(n), np.zeros((n, k))

    @property
    def information(self) -> NDArray[np.float64]:
        """(3, 3) of the turn, for a noise of one unit of brightness; the arm is eliminated."""
        arms, mixed = self.A[:3, :3], self.A[3:, :3]
        return np.asarray(self.A[3:, 3:] - mixed @ np.linalg.solve(arms, mixed.T))

    def depths_after(
        self, rhos: NDArray[np.float64], step: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N,) inverse depths after a step (6,) of the camera."""
        shown = self.h_rho > 0.0
        move = np.zeros(len(rhos))
        move[shown] = (self.b_rho - self.W @ step)[shown] / self.h_rho[shown]
        return np.maximum(rhos + move, RHO_MIN)
