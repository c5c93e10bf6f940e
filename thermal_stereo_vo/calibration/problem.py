"""What a calibration starts from, and its views in the making."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.bundle import (
    Observation,
    Prior,
    Rig,
    Solution,
    point_weights,
    solve,
)
from thermal_stereo_vo.calibration.guards import MIN_VIEWS
from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.calibration.mask_model import hole_sides, prior_sigma
from thermal_stereo_vo.calibration.result import ViewRecord
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardShot
from thermal_stereo_vo.core.errors import CalibrationError

Array = NDArray[np.float64]


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
class Problem:
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


def view_rms(
    solution: Solution, observations: Sequence[Observation]
) -> dict[tuple[int, int], float]:
    """(view, camera) -> RMS norm, px."""
    return {
        (o.view, o.camera): float(np.sqrt(np.mean(np.sum(r**2, axis=1))))
        for o, r in zip(observations, solution.residuals, strict=True)
    }
