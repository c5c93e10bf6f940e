"""Laying the world of an estimate over the world of the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform
from thermal_stereo_vo.evaluation.association import Comparison

Points = NDArray[np.float64]


class Alignment(Enum):
    """How the two worlds are brought together.

    ORIGIN: the first poses are made equal; what is left is drift.  YAW: as ORIGIN, then heading
    and translation fit all positions (4 degrees of freedom).  SE3: rotation and translation fit all
    positions.  SIM3: the scale as well, for methods that cannot see it.
    """

    ORIGIN = "origin"
    YAW = "yaw"
    SE3 = "se3"
    SIM3 = "sim3"


@dataclass(frozen=True, eq=False)
class Similarity:
    """``p_true = scale * R p_est + t`` with (4, 4) ``T_true_est`` holding R and t."""

    T_true_est: NDArray[np.float64]
    scale: float = 1.0

    def apply(self, T_world_est: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 4, 4) poses in the estimate's world to (N, 4, 4) in the world of the truth."""
        scaled = np.array(T_world_est, dtype=np.float64)
        scaled[..., :3, 3] *= self.scale
        return np.asarray(self.T_true_est @ scaled)

    def apply_to(self, trajectory: Trajectory) -> Trajectory:
        """The same trajectory in the world of the truth."""
        return Trajectory(trajectory.stamps_ns, self.apply(trajectory.T_world_rig))


def umeyama(source: Points, target: Points, *, with_scale: bool = False) -> Similarity:
    """The similarity that maps (N, 3) ``source`` onto (N, 3) ``target`` with least squares.

    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns,
    PAMI 13(4), 1991, eqs. (34)-(43).  Points on a line leave the turn around it open; any is taken.
    Points that are all the same leave the rotation open and the scale at 1.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)  # (34), (35)
    from_source, from_target = source - mean_source, target - mean_target
    variance = float(np.mean(np.sum(from_source**2, axis=1)))  # (36)
    covariance = from_target.T @ from_source / len(source)  # (38)
    U, D, Vt = np.linalg.svd(covariance)
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # (39), (43)
    rotation = U @ S @ Vt  # (40)
    scale = 1.0
    if with_scale and variance > 1e-18:
        scale = float(np.sum(D * np.diag(S)) / variance)  # (42)
    return Similarity(make_transform(rotation, mean_target - scale * rotation @ mean_source), scale)


def align_origin(comparison: Comparison) -> Similarity:
    """Makes the first estimated pose equal to the true one."""
    return Similarity(comparison.T_world_true[0] @ inverse(comparison.T_world_est[0]))


def align_yaw(comparison: Comparison) -> Similarity:
    """Roll and pitch from the first pose, heading and translation by least squares.

    After Zhang and Scaramuzza, A tutorial on quantitative trajectory evaluation, IROS 2018, sec.
    III-B: the heading maximises sum q . Exp(angle * up) p, whose maximum is the atan2 below.
    """
    start = align_origin(comparison)
    source = start.apply(comparison.T_world_est[comparison.has_pose])[:, :3, 3]
    target = comparison.true_positions_m[comparison.has_pose]
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    p, q = source - mean_source, target - mean_target
    up = up_axis(comparison)
    sine = float(np.sum(np.cross(p, q) @ up))
    cosine = float(np.sum(p * q) - np.sum((p @ up) * (q @ up)))
    turn = exp_so3(np.arctan2(sine, cosine) * up)
    fit = make_transform(turn, mean_target - turn @ mean_source)
    return Similarity(fit @ start.T_true_est)


def up_axis(comparison: Comparison) -> NDArray[np.float64]:
    """(3,) the axis of the true world that points up: against the rig's y (down) on average."""
    up = -comparison.T_world_true[:, :3, 1].mean(axis=0)
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(up)))
    axis[largest] = 1.0 if up[largest] >= 0.0 else -1.0
    return axis


def align(comparison: Comparison, alignment: Alignment) -> Similarity:
    """The map from the estimate's world to the true world."""
    if alignment is Alignment.ORIGIN:
        return align_origin(comparison)
    if alignment is Alignment.YAW:
        return align_yaw(comparison)
    return umeyama(
        comparison.estimated_positions_m[comparison.has_pose],
        comparison.true_positions_m[comparison.has_pose],
        with_scale=alignment is Alignment.SIM3,
    )


def aligned(comparison: Comparison, alignment: Alignment) -> Comparison:
    """The comparison with the estimate moved into the world of the truth."""
    moved = align(comparison, alignment).apply(comparison.T_world_est)
    return replace(comparison, T_world_est=moved)
