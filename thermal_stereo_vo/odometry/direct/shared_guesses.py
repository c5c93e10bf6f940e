"""First distances that were guessed from the same neighbours err together.

New points of a keyframe take their inverse depths from what is known around them.  Where that is
another wall, all of them are wrong by about one factor, and hundreds of guesses are no hundreds of
measurements of how far the new wall is.  So all guesses of one camera of one keyframe share an
unknown of their own, the relative error that they have in common, which is eliminated like the
depths are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_WORTH = 6.25
"""As far as they err together guesses count as so many independent ones."""


@dataclass(frozen=True)
class SharedGuesses:
    """Guesses ``rhos`` (N,) in 1/m of points in groups ``group`` (N,), with their ``information``.

    The cost of depths is sum information (rho - guess (1 + e))^2 + worth e^2, where e is the common
    error of the group and ``worths`` (J,) what is known of it beforehand.
    """

    group: NDArray[np.int64]
    rhos: NDArray[np.float64]
    information: NDArray[np.float64]
    worths: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        group: NDArray[np.int64],
        groups: int,
        rhos: NDArray[np.float64],
        information: NDArray[np.float64],
    ) -> SharedGuesses | None:
        """Of points in ``groups`` groups; None where nothing was guessed."""
        guessed = np.bincount(group, information > 0.0, groups)
        if not np.any(guessed):
            return None
        of_one = np.bincount(group, information * rhos**2, groups) / np.maximum(guessed, 1.0)
        return cls(group, rhos, information, np.where(guessed > 0, _WORTH * of_one, 1.0))

    def errors(self, rhos: NDArray[np.float64]) -> NDArray[np.float64]:
        """(J,) common errors that explain inverse depths (N,) best."""
        off = self._sum(self.information * self.rhos * (rhos - self.rhos))
        return off / self._stiffness

    def means(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) what the guesses are with these errors taken off."""
        return self.rhos * (1.0 + errors[self.group])

    def cost(self, errors: NDArray[np.float64]) -> float:
        """What errors (J,) cost themselves."""
        return float(np.sum(self.worths * errors * errors))

    def eliminate(
        self,
        W: NDArray[np.float64],
        h_rho: NDArray[np.float64],
        b_rho: NDArray[np.float64],
        A: NDArray[np.float64],
        g: NDArray[np.float64],
        pulls: NDArray[np.float64],
    ) -> SharedStep:
        """Take the common errors out of equations from which depths have been taken already.

        ``W`` (N, U), ``h_rho`` and ``b_rho`` (N,) as ``linearise_window`` leaves them, about
        ``means`` of the best ``errors``; changes ``A`` (U, U), ``g`` (U,) and ``pulls`` (N, U), or
        no rows where nobody asks for the part of each point.
        """
        pull = self.information * self.rhos
        share = np.divide(pull, h_rho, out=np.zeros_like(pull), where=h_rho > 0.0)
        stiffness = self._stiffness - self._sum(pull * share)
        groups = np.arange(len(self.worths))
        cross = np.where(groups[:, None] == self.group, share, 0.0) @ W
        right = share * b_rho
        whole = self._sum(right)
        carried = cross / stiffness[:, None]
        A -= cross.T @ carried
        g -= carried.T @ whole
        if len(pulls) > 0:
            pulls -= right[:, None] * carried[self.group]
        return SharedStep(self.group, pull, stiffness, cross, whole)

    @property
    def _stiffness(self) -> NDArray[np.float64]:
        return self.worths + self._sum(self.information * self.rhos**2)

    def _sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(self.group, values, len(self.worths)).astype(np.float64)


@dataclass(frozen=True)
class SharedStep:
    """How common errors follow when everything else has made its step."""

    group: NDArray[np.int64]
    pull: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    cross: NDArray[np.float64]
    right: NDArray[np.float64]

    def pulls_on_depths(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) what the moving errors add to the right sides of the depths at ``step`` (U,)."""
        errors = (self.right - self.cross @ step) / self.stiffness
        return np.asarray(self.pull * errors[self.group])
