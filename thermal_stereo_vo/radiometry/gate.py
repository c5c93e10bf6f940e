"""The gate: which frames of one camera show the scene, and what happened between them.

A microbolometer closes its shutter for a flat-field correction (FFC): its video freezes or shows
the shutter, then goes on with other offsets.  The gate finds this from the images alone and takes
telemetry, stamps and the host's own schedule as further evidence where they are known.

TRACKING -> (IMMINENT) -> FFC -> SETTLE -> TRACKING, and FAULT for what lasts too long.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import FrameError, OutOfOrderError
from thermal_stereo_vo.core.frames import FfcState, Gap, GapReason, RawFrame, Telemetry
from thermal_stereo_vo.radiometry.frame_statistics import FrameStatistics, StatisticsMaker
from thermal_stereo_vo.radiometry.repeats import NativeRepeats

HISTORY_FRAMES = 30
LEARNING_FRAMES = 5
EVENTS_KEPT = 1000
NEAR_IDENTICAL_MAX_S = 1.5
FLOOR_LEAK = 1.0003
"""The least noise ever seen is forgotten by 1 % a second at 30 Hz."""


@dataclass(frozen=True)
class GateConfig:
    """When a frame is held back."""

    bit_depth: int = setting(
        0,
        "Bits per pixel the camera must deliver; 0 accepts any.",
        unit="bits",
        minimum=0,
        maximum=16,
    )
    linear_counts: bool = setting(
        True,
        "16-bit images are linear counts, so that a step of the whole image is a correction; set "
        "false when the camera's own gain control is in them.",
    )
    duplicates: bool = setting(
        True, "Hold back frames that repeat the one before; noise-free recordings need false."
    )
    ffc_min_s: float = setting(
        0.2,
        "A freeze at least this long counts as a correction.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    ffc_max_s: float = setting(
        3.0,
        "A camera that is blind for longer has a fault (stuck shutter, dead stream).",
        unit="s",
        minimum=0.1,
        maximum=60.0,
    )
    settle_frames: int = setting(
        3,
        "Frames after a correction that pass but teach the scene-based refinement nothing.",
        unit="frames",
        minimum=0,
        maximum=100,
    )
    discard_frames: int = setting(
        0,
        "Frames held back after a correction; for cameras that come back in bad shape.",
        unit="frames",
        minimum=0,
        maximum=100,
    )
    gap_periods: float = setting(
        2.5,
        "Silence longer than this many frame periods is a gap.",
        unit="periods",
        minimum=1.1,
        maximum=100.0,
    )


class GateState(Enum):
    """What the gate believes of its camera."""

    TRACKING = "tracking"
    IMMINENT = "imminent"
    FFC = "ffc"
    SETTLE = "settle"
    FAULT = "fault"


class Cause(Enum):
    """A piece of evidence."""

    IDENTICAL = "identical frames"
    NEAR_IDENTICAL = "near-identical frames"
    SHUTTER_VIEW = "shutter view"
    CONSTANT = "constant image"
    OFFSET_STEP = "offset step"
    PATTERN_CHANGE = "pattern change"
    TIME_GAP = "time gap"
    TELEMETRY = "telemetry"
    SCHEDULE = "schedule"
    DISCARDED = "discarded after a correction"
    DARKNESS = "darkness"
    GLARE = "glare"


@dataclass(frozen=True)
class GateEvent:
    """One stretch without good images, or a correction between two good ones.

    ``start_ns`` is the stamp of the last good frame before, ``end_ns`` that of the first good one
    after, or of the newest frame while the event is ``ongoing`` (told once, when it becomes a
    fault).  ``first_sequence`` and ``next_sequence`` are the sequence numbers of the first frame
    held back and of the first good frame after; equal when none was held back.
    """

    camera: str
    reason: GapReason
    causes: tuple[Cause, ...]
    start_ns: int
    end_ns: int
    first_sequence: int
    next_sequence: int
    epoch_changed: bool
    ongoing: bool = False

    @property
    def duration_ns(self) -> int:
        """From the last good frame to the end."""
        return self.end_ns - self.start_ns

    def __str__(self) -> str:
        causes = ", ".join(cause.value for cause in self.causes)
        state = "still going on" if self.ongoing else "over"
        return (
            f"camera '{self.camera}': {self.reason.value} of {self.duration_ns * 1e-9:.3f} s from "
            f"frame {self.first_sequence} to {self.next_sequence} ({causes}), {state}"
        )


@dataclass(frozen=True)
class GateDecision:
    """What becomes of one frame.

    ``repeat``: the frame only repeats the one before because the sensor is slower than the link; it
    is no gap and carries no news.  ``blind``: the frame must not be used, for ``reason``.  ``gap``
    is set on the first good frame after a gap.  ``settled`` is false for a frame from which
    nothing may be learnt about the sensor.
    """

    state: GateState
    epoch: int
    blind: bool = False
    repeat: bool = False
    reason: GapReason | None = None
    gap: Gap | None = None
    causes: tuple[Cause, ...] = ()
    settled: bool = True


@dataclass
class _Episode:
    """A stretch without good images that is not over."""

    start_ns: int
    first_sequence: int
    causes: list[Cause]
    reported: bool = False


class FrameGate:
    """Gate of one camera.

    ``process`` takes the raw frames of the camera in order.  ``events`` keeps the last ones and
    ``on_event`` hears each as it is known.

    Args:
        config: limits.
        camera: name for messages.
        on_event: called with every event.
    """

    def __init__(
        self,
        config: GateConfig | None = None,
        camera: str = "",
        on_event: Callable[[GateEvent], None] | None = None,
    ) -> None:
        self._config = config if config is not None else GateConfig()
        self._camera = camera
        self._on_event = on_event
        self.events: deque[GateEvent] = deque(maxlen=EVENTS_KEPT)
        self._scheduled: deque[tuple[int, int]] = deque(maxlen=8)
        self._near_identical_max_ns = min(self._config.ffc_max_s, NEAR_IDENTICAL_MAX_S) * 1e9
        self._epoch = 0
        self._forget()

    def reset(self) -> None:
        """Forget all images (the clock jumped, another recording begins); the epoch goes up."""
        self._epoch += 1
        self._scheduled.clear()
        self._forget()

    def _forget(self) -> None:
        self._maker: StatisticsMaker | None = None
        self._previous: NDArray[Any] | None = None
        self._last_good: NDArray[Any] | None = None
        self._last_good_ns = 0
        self._last_stamp_ns = 0
        self._last_sequence = 0
        self._telemetry: Telemetry | None = None
        self._episode: _Episode | None = None
        self._settling = 0
        self._discarding = 0
        self._state = GateState.TRACKING
        self._repeats = NativeRepeats()
        self._history: deque[FrameStatistics] = deque(maxlen=HISTORY_FRAMES)
        self._noise_floor = np.inf
        self._periods_ns: deque[int] = deque(maxlen=16)

    @property
    def state(self) -> GateState:
        """The state after the last frame."""
        return self._state

    @property
    def last_stamp_ns(self) -> int:
        """Stamp of the last frame, 0 before any."""
        return self._last_stamp_ns

    @property
    def epoch(self) -> int:
        """How many corrections there have been."""
        return self._epoch

    def expect_ffc(self, start_ns: int, duration_ns: int) -> None:
        """The host triggers a correction itself: frames of this stretch are held back."""
        self._scheduled.append((start_ns, start_ns + duration_ns))

    def check(self, now_ns: int) -> GateEvent | None:
        """Tell of a stream that has died: call it from a timer; returns a new fault or None."""
        if self._previous is None:
            return None
        if now_ns - self._last_good_ns <= self._config.ffc_max_s * 1e9:
            return None
        self._open(self._last_sequence + 1, [Cause.TIME_GAP])
        return self._fault(now_ns, self._last_sequence)

    def process(self, raw: RawFrame) -> GateDecision:
        """Judge the next frame.

        Raises:
            FrameError: for another size or type than before or than configured.
            OutOfOrderError: when the stamp does not lie after the last one; the frame is left out
                and the gate stays as it was.
        """
        self._check_frame(raw)
        if self._previous is None or self._maker is None:
            return self._first(raw)
        statistics = self._maker.measure(raw.image, self._previous)
        elapsed_ns = raw.stamp_ns - self._last_stamp_ns
        self._remember(raw)
        if self._is_native_repeat(statistics):
            self._periods_ns.append(elapsed_ns)
            return GateDecision(self._state, self._epoch, repeat=True)
        causes = self._blinding(raw, statistics)
        if causes:
            self._discarding = self._config.discard_frames
        elif self._episode is not None and self._discarding > 0:
            self._discarding -= 1
            causes = [Cause.DISCARDED]
        if causes:
            return self._hold_back(raw, causes)
        return self._let_pass(raw, statistics, elapsed_ns)

    def _first(self, raw: RawFrame) -> GateDecision:
        self._maker = StatisticsMaker((raw.image.shape[0], raw.image.shape[1]))
        self._last_good_ns = raw.stamp_ns
        self._remember(raw)
        statistics = replace(self._maker.measure(raw.image, raw.image), identical=False)
        causes = self._blinding(raw, statistics)
        if causes:
            return self._hold_back(raw, causes)
        self._last_good, self._telemetry = raw.image, raw.telemetry
        return GateDecision(self._state, self._epoch, settled=False)

    def _remember(self, raw: RawFrame) -> None:
        self._previous, self._last_stamp_ns = raw.image, raw.stamp_ns
        self._last_sequence = raw.sequence

    def _is_native_repeat(self, statistics: FrameStatistics) -> bool:
        if statistics.constant or not self._config.duplicates:
            return False
        if statistics.identical:
            return self._episode is None and self._repeats.repeated()
        if self._episode is None:
            self._repeats.renewed()
        else:
            self._repeats.restart()
        return False

    def _blinding(self, raw: RawFrame, statistics: FrameStatistics) -> list[Cause]:
        """Why this frame does not show the scene; empty for a good one."""
        causes = []
        if any(start <= raw.stamp_ns <= end for start, end in self._scheduled):
            causes.append(Cause.SCHEDULE)
        if raw.telemetry is not None and raw.telemetry.ffc_state is FfcState.IN_PROGRESS:
            causes.append(Cause.TELEMETRY)
        if statistics.constant:
            causes.append(Cause.CONSTANT)
        elif self._config.duplicates and statistics.identical:
            causes.append(Cause.IDENTICAL)
        elif self._config.duplicates and self._is_near_identical(statistics, raw.stamp_ns):
            causes.append(Cause.NEAR_IDENTICAL)
        elif self._is_shutter(statistics):
            causes.append(Cause.SHUTTER_VIEW)
        return causes

    def _is_near_identical(self, statistics: FrameStatistics, stamp_ns: int) -> bool:
        """A frozen picture behind an analog link: only the noise of the digitiser is left.

        Between live pictures the quiet blocks never change less than by the sensor's noise,
        wherever the camera looks; a frozen picture keeps that noise as grain.  No real motion ends
        within one frame and everywhere.
        """
        if len(self._history) < LEARNING_FRAMES or self._noise_floor < 0.3:
            return False
        if stamp_ns - self._last_good_ns > self._near_identical_max_ns:
            return False
        fallen = (
            statistics.quiet < 0.5 * self._noise_floor
            and statistics.busy < 0.5 * self._history[-1].busy
        )
        alike = statistics.busy < 2.0 * statistics.quiet
        grain_kept = statistics.quiet < np.sqrt(2) * 0.7 * statistics.grain
        return bool(fallen and alike and grain_kept)

    def _is_shutter(self, statistics: FrameStatistics) -> bool:
        """All large and small structure went at once, and stays away."""
        if len(self._history) < LEARNING_FRAMES:
            return False
        contrast = float(np.median([past.contrast for past in self._history]))
        texture = float(np.median([past.texture for past in self._history]))
        # Where every block moves, changes between pictures tell nothing of the noise; a picture
        # without structure does.
        noise = min(self._typical("quiet"), statistics.grain)
        if contrast < 4.0 * noise or contrast <= 0.0 or texture <= 0.0:
            return False
        inside = self._episode is not None and Cause.SHUTTER_VIEW in self._episode.causes
        limit = 0.5 if inside else 0.3
        bland = max(limit * texture, 1.6 * statistics.grain)
        if statistics.contrast > limit * contrast or statistics.texture > bland:
            return False
        abrupt = max(past.contrast for past in list(self._history)[-3:]) > 0.6 * contrast
        return inside or abrupt

    def _hold_back(self, raw: RawFrame, causes: list[Cause]) -> GateDecision:
        episode = self._open(raw.sequence, causes)
        if self._is_overdue(episode.causes, raw.stamp_ns - episode.start_ns):
            self._fault(raw.stamp_ns, raw.sequence)
            reason = GapReason.FAULT
        else:
            self._state = GateState.FFC
            reason = self._reason_while_blind(episode.causes)
        return GateDecision(
            self._state,
            self._epoch,
            blind=True,
            reason=reason,
            causes=tuple(episode.causes),
            settled=False,
        )

    def _is_overdue(self, causes: list[Cause], duration_ns: int) -> bool:
        """Whether a camera that has been blind for so long has a fault."""
        return duration_ns > self._config.ffc_max_s * 1e9

    def _reason_while_blind(self, causes: list[Cause]) -> GapReason:
        if _CORRECTION & set(causes):
            return GapReason.FFC
        return GapReason.FROZEN if _FREEZE & set(causes) else GapReason.CORRUPT

    def _open(self, sequence: int, causes: list[Cause]) -> _Episode:
        if self._episode is None:
            self._episode = _Episode(self._last_good_ns, sequence, [])
        for cause in causes:
            if cause not in self._episode.causes:
                self._episode.causes.append(cause)
        return self._episode

    def _fault(self, now_ns: int, sequence: int) -> GateEvent | None:
        self._state = GateState.FAULT
        episode = self._episode
        if episode is None or episode.reported:
            return None
        episode.reported = True
        return self._publish(
            GateEvent(
                self._camera,
                GapReason.FAULT,
                tuple(episode.causes),
                episode.start_ns,
                now_ns,
                episode.first_sequence,
                sequence,
                epoch_changed=False,
                ongoing=True,
            )
        )

    def _let_pass(
        self, raw: RawFrame, statistics: FrameStatistics, elapsed_ns: int
    ) -> GateDecision:
        if self._episode is not None and self._last_good is not None and self._maker is not None:
            statistics = self._maker.measure(raw.image, self._last_good)
        causes = self._changes(raw, statistics, elapsed_ns)
        gap = None
        if self._episode is not None or causes:
            gap = self._close(raw, causes)
        else:
            self._history.append(statistics)
            self._noise_floor = min(FLOOR_LEAK * self._noise_floor, statistics.quiet)
        if Cause.TIME_GAP not in causes:
            self._periods_ns.append(elapsed_ns)
        self._last_good, self._last_good_ns = raw.image, raw.stamp_ns
        self._telemetry = raw.telemetry

        settled = self._settling == 0
        imminent = raw.telemetry is not None and raw.telemetry.ffc_state is FfcState.IMMINENT
        if not settled:
            self._state = GateState.SETTLE
            self._settling -= 1
        else:
            self._state = GateState.IMMINENT if imminent else GateState.TRACKING
        return GateDecision(
            self._state, self._epoch, gap=gap, causes=tuple(causes), settled=settled
        )

    def _changes(self, raw: RawFrame, statistics: FrameStatistics, elapsed_ns: int) -> list[Cause]:
        """What happened between the last good frame and this one."""
        causes = []
        if len(self._periods_ns) >= 4:
            period_ns = float(np.median(self._periods_ns))
            if elapsed_ns > self._config.gap_periods * period_ns:
                causes.append(Cause.TIME_GAP)
        corrected = _tells_of_correction(self._telemetry, raw.telemetry)
        if corrected:
            causes.append(Cause.TELEMETRY)
        interrupted = self._episode is not None or bool(causes)
        if corrected is not False and self._is_step(raw, statistics, interrupted):
            causes.append(Cause.OFFSET_STEP)
            if statistics.quiet > 2.0 * self._typical("quiet"):
                causes.append(Cause.PATTERN_CHANGE)
        return causes

    def _is_step(self, raw: RawFrame, statistics: FrameStatistics, interrupted: bool) -> bool:
        """The whole image moved by more counts than scene and noise ever move it.

        After an interruption less evidence will do.  Without one, the flat blocks must have got
        another pattern as well, which no pan of the camera gives them.
        """
        linear = self._config.linear_counts and raw.image.dtype == np.uint16
        if not linear or len(self._history) < LEARNING_FRAMES:
            return False
        usual = float(np.percentile([abs(past.step) for past in self._history], 95))
        noise = self._typical("quiet")
        if interrupted:
            return abs(statistics.step) > 5.0 * max(usual, noise) and statistics.common > 0.8
        return (
            abs(statistics.step) > 10.0 * max(usual, noise)
            and statistics.common > 0.95
            and statistics.quiet > 2.0 * noise
        )

    def _close(self, raw: RawFrame, found: list[Cause]) -> Gap:
        """Publish what is over, count the epoch and say it in the gap of this frame."""
        episode = self._episode
        if episode is None:
            episode = _Episode(self._last_good_ns, raw.sequence, [])
        causes = episode.causes + [cause for cause in found if cause not in episode.causes]
        duration_ns = raw.stamp_ns - episode.start_ns
        denied = _tells_of_correction(self._telemetry, raw.telemetry) is False
        reason, epoch_changed = self._judge(causes, duration_ns, denied)
        if Cause.NEAR_IDENTICAL in causes and duration_ns > self._near_identical_max_ns:
            # No freeze lasts so long: the noise is smaller than was thought.
            self._history.clear()
            self._noise_floor = np.inf
        self._episode = None
        if epoch_changed:
            self._epoch += 1
            self._settling = self._config.settle_frames
        self._publish(
            GateEvent(
                self._camera,
                reason,
                tuple(causes),
                episode.start_ns,
                raw.stamp_ns,
                episode.first_sequence,
                raw.sequence,
                epoch_changed,
            )
        )
        return Gap(duration_ns, reason, epoch_changed)

    def _judge(self, causes: list[Cause], duration_ns: int, denied: bool) -> tuple[GapReason, bool]:
        """Reason of a gap that is over, and whether the offsets changed in it."""
        seconds = duration_ns * 1e-9
        if seconds > self._config.ffc_max_s:
            return GapReason.FAULT, not denied
        if _CORRECTION & set(causes):
            return GapReason.FFC, True
        if _FREEZE & set(causes):
            # A freeze as long as a correction is taken for one: to keep photometric state over a
            # correction costs more than to estimate it once more.
            corrected = seconds >= self._config.ffc_min_s and not denied
            return (GapReason.FFC if corrected else GapReason.FROZEN), corrected
        if Cause.CONSTANT in causes:
            return GapReason.CORRUPT, False
        return GapReason.DROPPED, False

    def _typical(self, name: str) -> float:
        return float(np.median([getattr(past, name) for past in self._history]))

    def _publish(self, event: GateEvent) -> GateEvent:
        self.events.append(event)
        if self._on_event is not None:
            self._on_event(event)
        return event

    def _check_frame(self, raw: RawFrame) -> None:
        name, image, depth = self._camera or raw.camera, raw.image, self._config.bit_depth
        if depth > 8 and image.dtype == np.uint8:
            raise FrameError(
                f"camera '{name}' delivered an 8-bit image but bit_depth is {depth}: switch the "
                f"camera's digital output to {depth} bits, or set bit_depth to 8 or 0"
            )
        if 0 < depth <= 8 and image.dtype == np.uint16:
            raise FrameError(
                f"camera '{name}' delivered a 16-bit image but bit_depth is {depth}: set bit_depth "
                "to what the camera delivers, or to 0 for any"
            )
        if image.size == 0:
            raise FrameError(f"camera '{name}' delivered an empty image: check the grabber")
        if self._previous is None:
            return
        if image.shape != self._previous.shape or image.dtype != self._previous.dtype:
            before, now = _describe(self._previous), _describe(image)
            raise FrameError(
                f"camera '{name}' changed from {before} to {now} images in mid-stream: keep one "
                "format, or reset the gate"
            )
        if raw.stamp_ns <= self._last_stamp_ns:
            raise OutOfOrderError(
                f"camera '{name}' sent stamp {raw.stamp_ns} ns after {self._last_stamp_ns} ns: the "
                "frame is left out; stamps must rise, or reset the gate when the clock was set back"
            )


_CORRECTION = {
    Cause.TELEMETRY,
    Cause.SCHEDULE,
    Cause.OFFSET_STEP,
    Cause.SHUTTER_VIEW,
}
_FREEZE = {Cause.IDENTICAL, Cause.NEAR_IDENTICAL}


def _tells_of_correction(before: Telemetry | None, now: Telemetry | None) -> bool | None:
    """Whether the camera's own counters say that a correction lies between; None: unknown."""
    if before is None or now is None:
        return None
    told = None
    if before.frames_since_ffc is not None and now.frames_since_ffc is not None:
        told = now.frames_since_ffc < before.frames_since_ffc
    if before.time_since_ffc_ns is not None and now.time_since_ffc_ns is not None:
        # The clock of the camera may be coarse.
        told = bool(told) or now.time_since_ffc_ns < before.time_since_ffc_ns - 50_000_000
    return told


def _describe(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]} {image.dtype}"
