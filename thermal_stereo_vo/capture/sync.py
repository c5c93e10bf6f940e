"""How well two cameras keep step, and what the difference costs in pixels."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.core.config import setting

_HISTORY = 30


@dataclass(frozen=True)
class SyncConfig:
    """Whether the cameras share a pulse."""

    mode: str = setting(
        "free_running",
        "hardware: both cameras start their frames on one pulse; free_running: they do not.",
        choices=("hardware", "free_running"),
    )
    max_skew_ms: float = setting(
        1.0,
        "Hardware: a larger difference of stamps means that the pulse does not arrive.",
        unit="ms",
        minimum=0.0,
        maximum=1000.0,
    )
    max_displacement_px: float = setting(
        1.0,
        "Warn when the picture moves further than this within the difference of stamps.",
        unit="px",
        minimum=0.0,
        maximum=100.0,
    )


@dataclass(frozen=True)
class SyncReport:
    """Figures of the last second.  ``warning`` is empty when all is well.

    ``skew_ms`` is the median of right minus left, ``spread_ms`` the range that half of the skews
    lie in; ``displacement_px`` is what the skew makes of ``motion_px_s``.
    """

    skew_ms: float = 0.0
    spread_ms: float = 0.0
    motion_px_s: float = 0.0
    displacement_px: float = 0.0
    warning: str = ""


class SyncMonitor:
    """Judges the pairs of a rig."""

    def __init__(self, config: SyncConfig) -> None:
        self._config = config
        self._skews_ns: deque[int] = deque(maxlen=_HISTORY)
        self._motions_px_s: deque[float] = deque(maxlen=_HISTORY)

    def update(self, skew_ns: int, motion_px_s: float | None) -> None:
        """A pair came; ``motion_px_s`` None where the picture did not tell."""
        self._skews_ns.append(skew_ns)
        if motion_px_s is not None:
            self._motions_px_s.append(motion_px_s)

    def report(self) -> SyncReport:
        """The state of things."""
        # Copies: another thread may add to them meanwhile.
        skews_ns, motions_px_s = tuple(self._skews_ns), tuple(self._motions_px_s)
        if not skews_ns:
            return SyncReport()
        skews_ms = np.array(skews_ns) * 1e-6
        skew_ms = float(np.median(skews_ms))
        low_ms, high_ms = np.percentile(skews_ms, (25, 75))
        motion_px_s = float(np.median(motions_px_s)) if motions_px_s else 0.0
        displacement_px = abs(skew_ms) * 1e-3 * motion_px_s
        warnings = []
        config = self._config
        if config.mode == "hardware" and abs(skew_ms) > config.max_skew_ms:
            warnings.append(
                f"the cameras are {skew_ms:.2f} ms apart although they share a pulse: check the "
                "sync line and the external_sync of both"
            )
        if displacement_px > config.max_displacement_px:
            warnings.append(
                f"{skew_ms:.2f} ms of skew make {displacement_px:.1f} px of false disparity "
                f"at this motion ({motion_px_s:.0f} px/s): synchronise the cameras by hardware"
            )
        return SyncReport(
            skew_ms, float(high_ms - low_ms), motion_px_s, displacement_px, "; ".join(warnings)
        )
