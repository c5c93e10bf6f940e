"""Which views to calibrate with, and which to keep for the test.

Near the solution each view's cost is a known quadratic in the shared parameters
(``ViewInformation``), so that calibrating with a subset and testing it on the views left out costs
one small linear solve.  The set grows greedily by the view that lowers the held-out error most,
weighted with the part of the image that no chosen view covers yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import Solution, ViewInformation, scaled_inverse

Array = NDArray[np.float64]

CELLS = (8, 6)
"""Columns and rows of the coverage map."""


@dataclass(frozen=True)
class Selection:
    """Chosen views in the order of choice, and the predicted held-out RMS (px) after each."""

    chosen: tuple[int, ...]
    held_out_rms_px: tuple[float, ...]


def select_views(
    information: Mapping[int, ViewInformation],
    known: ViewInformation,
    cells: Mapping[int, NDArray[np.bool_]],
    limit: int,
) -> Selection:
    """Choose at most ``limit`` of the views.

    ``known`` is prior knowledge.  ``cells`` tells which cells of the coverage maps (all cameras,
    flattened) a view touches.
    """
    views = sorted(information)
    everything = np.any([cells[v] for v in views], axis=0)
    total = sum(information[v].hessian for v in views)
    ridge = 1e-4 * np.diag(np.maximum(np.diag(np.asarray(total)), 1e-30)) / len(views)
    hessian, gradient = ridge + known.hessian, known.gradient
    covered = np.zeros_like(everything)
    rest = _Sum.of([information[v] for v in views])
    chosen: list[int] = []
    errors: list[float] = []
    while len(chosen) < min(limit, len(views) - 1):
        best: tuple[float, int, float] | None = None
        for view in views:
            if view in chosen:
                continue
            step = _step(hessian + information[view].hessian, gradient + information[view].gradient)
            error_px = _rms(rest.without(information[view]), step)
            blank = 1.0 - (covered | cells[view]).sum() / max(everything.sum(), 1)
            score = error_px * (1.0 + blank)
            if best is None or score < best[0]:
                best = score, view, error_px
        assert best is not None
        view = best[1]
        chosen.append(view)
        errors.append(best[2])
        hessian = hessian + information[view].hessian
        gradient = gradient + information[view].gradient
        rest = rest.without(information[view])
        covered = covered | cells[view]
    return Selection(tuple(chosen), tuple(errors))


def jackknife_covariance(
    information: Mapping[int, ViewInformation], known: ViewInformation
) -> Array:
    """(S, S) covariance of the shared parameters from leaving out one view at a time.

    Errors that are common to all points of a view (a bent board, a camera that lags) show here and
    not in the covariance of independent points.
    """
    views = sorted(information)
    hessian = known.hessian + sum(information[v].hessian for v in views)
    gradient = known.gradient + sum(information[v].gradient for v in views)
    steps = np.array(
        [_step(hessian - information[v].hessian, gradient - information[v].gradient) for v in views]
    )
    centred = steps - steps.mean(0)
    count = len(views)
    return np.asarray((count - 1) / count * centred.T @ centred)


def honest_covariance(solution: Solution) -> Array:
    """The larger of two estimates: independent points, and the spread when views are left out."""
    formal = solution.covariance
    jackknife = jackknife_covariance(solution.information, solution.known)
    ratio = np.diag(jackknife) / np.maximum(np.diag(formal), 1e-300)
    stretch = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(formal * np.outer(stretch, stretch))


def coverage(pixels: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    """(6, 8) which cells of a (width, height) image hold one of the (N, 2) pixels."""
    columns, rows = CELLS
    grid = np.zeros((rows, columns), dtype=bool)
    i = np.clip((pixels[:, 0] + 0.5) / size[0] * columns, 0, columns - 1).astype(int)
    j = np.clip((pixels[:, 1] + 0.5) / size[1] * rows, 0, rows - 1).astype(int)
    grid[j, i] = True
    return grid


@dataclass(frozen=True)
class _Sum:
    """Sum of the information of some views."""

    hessian: Array
    gradient: Array
    cost: float
    points: int

    @classmethod
    def of(cls, parts: Sequence[ViewInformation]) -> _Sum:
        return cls(
            np.asarray(sum(p.hessian for p in parts)),
            np.asarray(sum(p.gradient for p in parts)),
            sum(p.cost for p in parts),
            sum(p.points for p in parts),
        )

    def without(self, part: ViewInformation) -> _Sum:
        return _Sum(
            self.hessian - part.hessian,
            self.gradient - part.gradient,
            self.cost - part.cost,
            self.points - part.points,
        )


def _rms(views: _Sum, step: Array) -> float:
    """RMS norm of the residuals (px) of ``views`` after a step of the shared parameters."""
    cost = views.cost - 2.0 * views.gradient @ step + step @ views.hessian @ step
    return float(np.sqrt(max(float(cost), 0.0) / max(views.points, 1)))


def _step(hessian: Array, gradient: Array) -> Array:
    return np.asarray(scaled_inverse(hessian) @ gradient)
