"""The gate of a visible camera: darkness and glare blind it, a shutter does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.frames import GapReason, RawFrame
from thermal_stereo_vo.radiometry.frame_statistics import FrameStatistics
from thermal_stereo_vo.radiometry.gate import Cause, FrameGate, GateConfig, GateEvent

NOISE_TEXTURE = 1.6
"""Blocks of pure noise differ no more than this times their grain."""
GLARE_STRIDE = 4


@dataclass(frozen=True)
class VisibleGateConfig:
    """When a picture of a visible camera shows nothing."""

    least_contrast: float = setting(
        3.0,
        "A picture of noise whose blocks differ less than this is dark.",
        unit="grey levels",
        minimum=0.0,
        maximum=100.0,
    )
    glare_percent: float = setting(
        60.0,
        "A picture with more saturated pixels than this is glare; 100 lets all pass.",
        unit="%",
        minimum=1.0,
        maximum=100.0,
    )


class VisibleGate(FrameGate):
    """As ``FrameGate``, but for an 8- or 16-bit visible camera.

    The night is no fault of the camera, however long it is.  When light is back the epoch goes up:
    exposure and gain may be others.
    """

    def __init__(
        self,
        config: GateConfig | None = None,
        visible: VisibleGateConfig | None = None,
        camera: str = "",
        on_event: Callable[[GateEvent], None] | None = None,
    ) -> None:
        config = config if config is not None else GateConfig()
        # Neither counts of a bolometer nor its bit depth are asked of a visible camera.
        super().__init__(replace(config, linear_counts=False, bit_depth=0), camera, on_event)
        self._visible = visible if visible is not None else VisibleGateConfig()

    def _blinding(self, raw: RawFrame, statistics: FrameStatistics) -> list[Cause]:
        if self._is_glare(raw):
            return [Cause.GLARE]
        if self._is_dark(statistics):
            return [Cause.DARKNESS]
        if self._config.duplicates and statistics.identical:
            return [Cause.IDENTICAL]
        return []

    def _is_glare(self, raw: RawFrame) -> bool:
        white = 0.98 * np.iinfo(raw.image.dtype).max
        saturated = np.mean(raw.image[::GLARE_STRIDE, ::GLARE_STRIDE] >= white)
        return bool(100.0 * saturated > self._visible.glare_percent)

    def _is_dark(self, statistics: FrameStatistics) -> bool:
        noise = max(NOISE_TEXTURE * statistics.grain, 1.0)
        return statistics.contrast < self._visible.least_contrast and statistics.texture < noise

    def _is_overdue(self, causes: list[Cause], duration_ns: int) -> bool:
        return not _LIGHT & set(causes) and super()._is_overdue(causes, duration_ns)

    def _reason_while_blind(self, causes: list[Cause]) -> GapReason:
        return _reason(causes) or super()._reason_while_blind(causes)

    def _judge(self, causes: list[Cause], duration_ns: int, denied: bool) -> tuple[GapReason, bool]:
        reason = _reason(causes)
        if reason is not None:
            return reason, True
        reason, _ = super()._judge(causes, duration_ns, denied)
        return (GapReason.FROZEN if reason is GapReason.FFC else reason), False


_LIGHT = {Cause.DARKNESS, Cause.GLARE}


def _reason(causes: list[Cause]) -> GapReason | None:
    """The last change of light decides."""
    for cause in reversed(causes):
        if cause in _LIGHT:
            return GapReason.GLARE if cause is Cause.GLARE else GapReason.DARK
    return None
