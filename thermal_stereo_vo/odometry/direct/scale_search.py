"""How large a map from one camera is, by what the other camera of the rig sees of the motion.

When the rig turns, the other camera moves by its lever arm, a known number of metres.  Points of
its own, followed in its own images, tell how many units of the map that is: by a scan over all
sizes first, then by an adjustment of everything with the scale as one more unknown (Dai et al. 2019
leave it to the depths to grow or shrink all together).  What windows say ``ScaleFilter`` averages.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.odometry.direct.multispectral_config import ScaleConfig
from thermal_stereo_vo.odometry.direct.photometric_bundle import (
    HOLD,
    PhotometricProblem,
    PhotometricSolution,
    adjust_photometrically,
    moved_by,
)
from thermal_stereo_vo.odometry.direct.photometric_config import PhotometricConfig
from thermal_stereo_vo.odometry.direct.rig import with_arms
from thermal_stereo_vo.odometry.direct.scale_scan import scan_scales

LEAST_KEYFRAMES = 4
_STEP = 0.12
_MOST_POINTS = 150
_ITERATIONS = 12
_MEMORY = 8
_CURVES = 5
_AGREEMENT = 0.25
"""Windows agree when their median is surer than this share of what they say is wrong."""


@dataclass(frozen=True)
class WindowScale:
    """What one window says: ``log_scale`` of metres in a unit of the map, with its ``sigma``.

    ``costs`` (S,) of the scan over all sizes; ``joint`` the adjustment with the scale.
    """

    log_scale: float
    sigma: float
    costs: NDArray[np.float64]
    joint: PhotometricSolution


class ScaleSearch:
    """Gathers what windows say of the size of one and the same map."""

    def __init__(self, config: ScaleConfig) -> None:
        self._config = config
        self.log_scales = np.arange(np.log(config.smallest_m), np.log(config.largest_m), _STEP)
        """(S,) sizes that are looked at."""
        self._curves: deque[NDArray[np.float64]] = deque(maxlen=_CURVES)
        self._recent: deque[float] = deque(maxlen=max(_MEMORY, config.windows))

    def look(
        self,
        problem: PhotometricProblem,
        solution: PhotometricSolution,
        log_unit: float,
        photometric: PhotometricConfig,
    ) -> WindowScale | None:
        """What a window says whose first camera alone gave ``solution``.

        The lever arms of ``problem`` are as long as if a unit were exp(``log_unit``) metres.  None
        where the second camera shows nothing.
        """
        costs = np.zeros(len(self.log_scales))
        second = np.flatnonzero(problem.host_cameras == 1)
        second = second[:: 1 + len(second) // _MOST_POINTS]
        seen = np.ascontiguousarray(problem.seen[second][:, :, 1])
        if not np.any(seen):
            return None
        T_then_now = moved_by(problem.twists, problem.lags_s)
        scan_scales(
            problem.images[1], problem.slots, solution.T_k_w,
            np.ascontiguousarray(T_then_now[:, 1]), problem.cameras[1], problem.T_rig_camera[1],
            problem.hosts[second], problem.bearings[second], problem.rhos[second],
            problem.rho_priors[second], problem.prior_information[second], problem.patches[second],
            problem.trusts[second], seen, np.exp(log_unit - self.log_scales), photometric.gate,
            costs,
        )  # fmt: skip
        if self._recent:
            start = self._recent[-1]
        else:
            start = float(self.log_scales[np.argmin(np.sum([*self._curves, costs], axis=0))])
        first = problem.host_cameras == 0
        brightness = problem.brightness.copy()
        brightness[:, 0] = solution.brightness[:, 0]
        joint = adjust_photometrically(
            replace(
                problem,
                T_k_w=solution.T_k_w,
                rhos=np.where(first, solution.rhos, problem.rhos),
                brightness=brightness,
                T_rig_camera=with_arms(problem.T_rig_camera, np.exp(log_unit - start)),
            ),
            huber=photometric.huber,
            gate=photometric.gate,
            iterations=_ITERATIONS,
            free_scale=True,
            free_lag=True,
            hold=HOLD,
        )
        if joint is None:
            return None
        return WindowScale(start + joint.log_scale, joint.log_scale_sigma, costs, joint)

    def add(self, window: WindowScale) -> None:
        """Take in what a window said."""
        self._curves.append(window.costs)
        self.note(window.log_scale)

    def note(self, log_scale: float) -> None:
        """Take in a scale."""
        self._recent.append(log_scale)

    def contradicts(self) -> bool:
        """Whether many windows agree that a size of one is wrong."""
        count = len(self._recent)
        if count < self._config.windows:
            return False
        # Neighbours share most of their keyframes; 1.25 is the price of a median.
        spread = 1.25 * float(np.std(self._recent)) / np.sqrt(0.5 * count)
        reopen = self._config.reopen
        agree = float(spread) < _AGREEMENT * reopen
        return agree and abs(float(np.median(self._recent))) > reopen
