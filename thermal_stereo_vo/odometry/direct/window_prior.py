"""What keyframes that left the window still say of those that stay.

Marginalisation after Engel et al. (DSO, TPAMI 2018, section 2.3) and Leutenegger et al. (OKVIS,
IJRR 2015): the residuals of a leaving keyframe's points are linearised, its points and its own
unknowns are eliminated (Schur complement), and what is left is a quadratic cost of the poses and
brightness of the keyframes that stay.  From then on how those move the pixels is taken where they
were linearised first (first-estimate Jacobians): were it taken at several places, directions that
nothing shows, as the place of the whole map and, without a lever arm, its size, would seem known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import inverse, log_se3

POSE, SHARED = 6, 2
_LEAST_PIVOT = 1e-9


@dataclass(frozen=True)
class WindowPrior:
    """A quadratic cost d' H d - 2 b' d of what K keyframes differ from their first estimates by.

    ``H`` (U, U) and ``b`` (U,) for a noise of one unit of brightness; U = K (6 + 2 C) + 2 unknowns
    as in the photometric adjustment: left perturbation of each pose, brightness of each camera, at
    last scale and lag.  ``T_first`` (K, 4, 4) and ``brightness_first`` (K, C, 2) are the first
    estimates, ``lag_first_s`` that of the lag; they mean nothing where nothing is known.
    ``scatter`` (U, U) is how far ``b`` may be off: the sum of squares of what each point pulled.
    """

    H: NDArray[np.float64]
    b: NDArray[np.float64]
    T_first: NDArray[np.float64]
    brightness_first: NDArray[np.float64]
    lag_first_s: float
    scatter: NDArray[np.float64]

    @classmethod
    def nothing(
        cls, T_k_w: NDArray[np.float64], brightness: NDArray[np.float64], lag_s: float
    ) -> WindowPrior:
        """A prior that says nothing of these keyframes."""
        K, C = brightness.shape[:2]
        size = K * (POSE + 2 * C) + SHARED
        return cls(
            np.zeros((size, size)), np.zeros(size), T_k_w.copy(), brightness.copy(), lag_s,
            np.zeros((size, size)),
        )  # fmt: skip

    @property
    def _information(self) -> NDArray[np.float64]:
        """(K, 6 + 2 C) that of each unknown of a keyframe."""
        return np.diag(self.H)[:-SHARED].reshape(len(self.T_first), -1)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(K,) keyframes of whose poses something is known."""
        return np.asarray(np.any(self._information[:, :POSE] > 0.0, axis=1))

    @property
    def light_known(self) -> NDArray[np.bool_]:
        """(K, C) images of whose brightness something is known."""
        K, C = self.brightness_first.shape[:2]
        return np.asarray(np.any(self._information[:, POSE:].reshape(K, C, 2) > 0.0, axis=2))

    def offsets(
        self, T_k_w: NDArray[np.float64], brightness: NDArray[np.float64], lag_s: float
    ) -> NDArray[np.float64]:
        """(U,) what a state differs from the first estimates by; 0 where nothing is known."""
        K = len(T_k_w)
        out = np.zeros(len(self.b))
        per_frame = out[:-SHARED].reshape(K, -1)
        for k in np.flatnonzero(self.known):
            per_frame[k, :POSE] = log_se3(T_k_w[k] @ inverse(self.T_first[k]))
            per_frame[k, POSE:] = (brightness[k] - self.brightness_first[k]).ravel()
        out[-1] = lag_s - self.lag_first_s
        return out

    def slopes_at(
        self, T_k_w: NDArray[np.float64], brightness: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Poses and brightness that Jacobians are taken at: first estimates where there are."""
        return (
            np.where(self.known[:, None, None], self.T_first, T_k_w),
            np.where(self.light_known[..., None], self.brightness_first, brightness),
        )

    def rescaled(self, factor: float, about_m: NDArray[np.float64]) -> WindowPrior:
        """The same in another unit of length, ``factor`` of which are one of this.

        ``about_m`` (3,) stays in place.  Left perturbations turn about the keyframe itself, so that
        only their translations change.  Nothing may be known of the scale.
        """
        lengths = np.ones(len(self.b))
        lengths[:-SHARED].reshape(len(self.T_first), -1)[:, :3] = 1.0 / factor
        T_first = self.T_first.copy()
        moved_m = (1.0 - factor) * about_m
        T_first[:, :3, 3] = factor * T_first[:, :3, 3] - T_first[:, :3, :3] @ moved_m
        both = np.outer(lengths, lengths)
        return replace(
            self, H=self.H * both, b=self.b * lengths, T_first=T_first, scatter=self.scatter * both
        )

    def without(self, left: int) -> WindowPrior:
        """The prior of the others when keyframe ``left`` (index) has gone."""
        size = (len(self.b) - SHARED) // len(self.T_first)
        own = np.zeros(len(self.b), np.bool_)
        own[left * size : (left + 1) * size] = True
        rest = self._with_free(own)
        stay, keep = ~own, np.arange(len(self.T_first)) != left
        return replace(
            rest,
            H=np.ascontiguousarray(rest.H[np.ix_(stay, stay)]),
            b=rest.b[stay],
            scatter=np.ascontiguousarray(rest.scatter[np.ix_(stay, stay)]),
            T_first=self.T_first[keep],
            brightness_first=self.brightness_first[keep],
        )

    def forgetting_lag(self) -> WindowPrior:
        """The same where the lag may be any other from now on."""
        own = np.zeros(len(self.b), np.bool_)
        own[-1] = True
        return self._with_free(own)

    def _with_free(self, own: NDArray[np.bool_]) -> WindowPrior:
        """What stays known of the others when nothing more is known of unknowns ``own`` (U,)."""
        H, right = self.H.copy(), np.column_stack([self.b, self.scatter])
        eliminate(H, right, own)
        scatter = np.ascontiguousarray(right[:, 1:].T)
        eliminate(self.H.copy(), scatter, own)
        return replace(self, H=H, b=right[:, 0].copy(), scatter=scatter)

    def with_newest(
        self, T_k_w: NDArray[np.float64], brightness: NDArray[np.float64]
    ) -> WindowPrior:
        """The same with one more keyframe at the end, of which nothing is known."""
        size = (len(self.b) - SHARED) // len(self.T_first)
        old = np.r_[0 : len(self.b) - SHARED, len(self.b) - SHARED + size : len(self.b) + size]
        H, b = np.zeros((len(self.b) + size,) * 2), np.zeros(len(self.b) + size)
        scatter = np.zeros_like(H)
        H[np.ix_(old, old)] = self.H
        scatter[np.ix_(old, old)] = self.scatter
        b[old] = self.b
        return replace(
            self,
            H=H,
            b=b,
            scatter=scatter,
            T_first=np.concatenate([self.T_first, T_k_w[None]]),
            brightness_first=np.concatenate([self.brightness_first, brightness[None]]),
        )

    def grown(
        self,
        A: NDArray[np.float64],
        g: NDArray[np.float64],
        T_k_w: NDArray[np.float64],
        brightness: NDArray[np.float64],
        lag_s: float,
        pulls: NDArray[np.float64],
    ) -> WindowPrior:
        """The prior and residuals with normal equations ``A`` d = ``g`` (U,) at a state.

        ``pulls`` (N, U) is the part of each point in ``g``.
        ``A`` must be taken at ``slopes_at`` this state.  Keyframes that ``A`` speaks of for the
        first time get their first estimates from the state.
        """
        T_first, brightness_first = self.slopes_at(T_k_w, brightness)
        grown = replace(
            self,
            H=self.H + A,
            T_first=T_first,
            brightness_first=brightness_first,
            lag_first_s=self.lag_first_s if self.H[-1, -1] > 0.0 else lag_s,
            scatter=self.scatter + pulls.T @ pulls,
        )
        # The equations are about the state: about the first estimates their right side is longer.
        offsets = grown.offsets(T_k_w, brightness, lag_s)
        return replace(grown, b=self.b + g + A @ offsets)


@njit(cache=True, nogil=True)
def eliminate(H, b, own):  # type: ignore[no-untyped-def]
    """Take unknowns ``own`` (U,) bool out of ``H`` (U, U) and ``b`` (U, R), one after the other.

    What nothing shows once those before it have gone is dropped; a sum of squares stays one.
    """
    count = len(b)
    start = np.empty(count)
    for j in range(count):
        start[j] = H[j, j]
    for j in range(count):
        if not own[j]:
            continue
        pivot = H[j, j]
        if pivot > _LEAST_PIVOT * start[j]:
            for i in range(count):
                if i == j or H[i, j] == 0.0:
                    continue
                factor = H[i, j] / pivot
                b[i] -= factor * b[j]
                for m in range(count):
                    if m != j:
                        H[i, m] -= factor * H[j, m]
        for i in range(count):
            H[i, j] = H[j, i] = 0.0
        b[j] = 0.0
    for i in range(count):
        for m in range(i):
            H[i, m] = H[m, i] = 0.5 * (H[i, m] + H[m, i])


def eliminate_reference(
    H: NDArray[np.float64], b: NDArray[np.float64], own: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The plain form of ``eliminate``: Schur complement by the pseudo-inverse, (V, V) and (V,)."""
    stay = ~own
    cross = H[np.ix_(stay, own)] @ np.linalg.pinv(H[np.ix_(own, own)], hermitian=True)
    return H[np.ix_(stay, stay)] - cross @ H[np.ix_(own, stay)], b[stay] - cross @ b[own]
