"""Keep one camera streaming: open, read, and after any failure close and open again."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.device_path import resolve_device
from thermal_stereo_vo.capture.negotiation import StreamFormat
from thermal_stereo_vo.capture.stamps import SequenceCounter, StampSource
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.capture.v4l2 import Grab, GrabFault, StampKind, V4l2Stream
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import CaptureError
from thermal_stereo_vo.core.frames import RawFrame, Telemetry

logger = logging.getLogger(__name__)

_STOP_CHECK_S = 0.2
_INPUT_CHECK_S = 1.0
_RATE_FRAMES = 31


@dataclass(frozen=True)
class RecoveryConfig:
    """How a lost camera is looked for."""

    first_wait_s: float = setting(
        0.1, "Wait before the first new attempt.", unit="s", minimum=0.01, maximum=60.0
    )
    longest_wait_s: float = setting(
        2.0, "The wait doubles up to this.", unit="s", minimum=0.01, maximum=60.0
    )


class StallError(CaptureError):
    """A device that is there but sends nothing usable."""


class LinkState(Enum):
    """Where a camera stands."""

    OPENING = "opening"
    SETTLING = "settling"
    STREAMING = "streaming"
    NO_SIGNAL = "no signal"
    WAITING = "waiting to reconnect"
    CLOSED = "closed"


@dataclass
class LinkCounters:
    """What became of the buffers since the start, over all connections.

    ``lost`` never reached us (gaps in the driver's count); ``damaged``, ``short``, ``settling``,
    ``no_signal`` and ``backwards`` were dropped here, each for its reason; ``by_arrival`` are good
    frames whose stamp the driver did not give.
    """

    frames: int = 0
    lost: int = 0
    damaged: int = 0
    short: int = 0
    settling: int = 0
    no_signal: int = 0
    backwards: int = 0
    by_arrival: int = 0
    stalls: int = 0
    failures: int = 0
    connections: int = 0

    @property
    def dropped(self) -> int:
        """Frames of the camera that nobody will see, however they died."""
        return self.lost + self.damaged + self.short + self.backwards


@dataclass(frozen=True)
class LinkStatus:
    """One camera's link at this moment.

    ``reason`` tells why it is not streaming, ``last_failure`` why it was opened anew the last time.
    """

    camera: str
    state: LinkState
    reason: str
    counters: LinkCounters
    format: StreamFormat | None = None
    stamp_kind: StampKind | None = None
    rate_hz: float = 0.0
    last_failure: str = ""


@dataclass
class Rate:
    """Frames per second of the last second or so, from their arrival."""

    stamps: deque[int] = field(default_factory=lambda: deque(maxlen=_RATE_FRAMES))

    def hz(self, now_ns: int) -> float:
        """At this moment on the monotonic clock."""
        stamps = tuple(self.stamps)  # another thread adds to them
        if len(stamps) < 2:
            return 0.0
        # The silence since the last frame counts once it is longer than a usual interval.
        span_ns = stamps[-1] - stamps[0]
        silence_ns = now_ns - stamps[-1] - 2 * span_ns // (len(stamps) - 1)
        return (len(stamps) - 1) * 1e9 / (span_ns + max(silence_ns, 0))


class CameraLink:
    """A thread that turns a device into a stream of ``RawFrame`` and does not give up.

    ``on_frame`` is called in that thread.  ``telemetry`` tells what the camera says of itself at a
    moment on CLOCK_MONOTONIC, or None.
    """

    def __init__(
        self,
        camera: str,
        config: StreamConfig,
        on_frame: Callable[[RawFrame], None],
        *,
        clock: EpochClock,
        recovery: RecoveryConfig | None = None,
        telemetry: Callable[[int], Telemetry | None] = lambda monotonic_ns: None,
    ) -> None:
        self.camera = camera
        self._config = config
        self._on_frame = on_frame
        self._telemetry = telemetry
        self._recovery = recovery if recovery is not None else RecoveryConfig()
        self._stamps = StampSource(clock, round(config.stamp_offset_ms * 1e6))
        self._sequence = SequenceCounter()
        self._counters = LinkCounters()
        self._rate = Rate()
        self._state = LinkState.CLOSED
        self._settling = 0
        self._reason = self._last_failure = ""
        self._format: StreamFormat | None = None
        self._stop = threading.Event()
        self._reconnect = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to connect; returns at once."""
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._run, name=f"capture-{self.camera}", daemon=True
        )
        self._thread.start()

    def request_stop(self) -> None:
        """Begin to close the device; returns at once."""
        self._stop.set()
        self._reconnect.set()

    def stop(self) -> None:
        """Close the device; returns when it is closed."""
        self.request_stop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._state = LinkState.CLOSED

    def reconnect(self) -> None:
        """Close and open anew now, without waiting."""
        self._reconnect.set()

    @property
    def streaming(self) -> bool:
        """Whether frames are to be expected."""
        return self._state in (LinkState.STREAMING, LinkState.SETTLING)

    def status(self) -> LinkStatus:
        """A snapshot; may be called from any thread."""
        return LinkStatus(
            camera=self.camera,
            state=self._state,
            reason=self._reason,
            counters=replace(
                self._counters,
                lost=self._sequence.lost,
                backwards=self._stamps.backwards,
                by_arrival=self._stamps.by_arrival,
            ),
            format=self._format,
            stamp_kind=self._stamps.kind,
            rate_hz=self._rate.hz(time.monotonic_ns()) if self.streaming else 0.0,
            last_failure=self._last_failure,
        )

    def _run(self) -> None:
        wait_s = self._recovery.first_wait_s
        while not self._stop.is_set():
            frames_before = self._counters.frames
            self._reconnect.clear()
            self._state = LinkState.OPENING
            try:
                self._stream()
            except CaptureError as error:
                self._counters.stalls += isinstance(error, StallError)
                self._reason = str(error)
            except Exception as error:  # a fault of ours must not blind the camera for good
                logger.exception("camera '%s'", self.camera)
                self._reason = f"internal fault: {error!r}"
            if self._stop.is_set():
                break
            if self._reconnect.is_set():
                continue
            self._last_failure = self._reason
            self._counters.failures += 1
            self._state = LinkState.WAITING
            if self._counters.frames > frames_before:
                wait_s = self._recovery.first_wait_s
            self._reconnect.wait(wait_s)
            wait_s = min(2 * wait_s, self._recovery.longest_wait_s)
        self._state = LinkState.CLOSED

    def _stream(self) -> None:
        # The name is looked up each time: after a re-plug it may lead to another node.
        with V4l2Stream(resolve_device(self._config.device), self._config) as stream:
            self._counters.connections += 1
            self._format = stream.format
            self._sequence.restart()
            self._rate.stamps.clear()
            self._settling = self._config.settling_frames
            self._state = LinkState.SETTLING
            watchdog = _Watchdog(self._config)
            input_checked_s = -_INPUT_CHECK_S
            while not self._reconnect.is_set():
                if time.monotonic() - input_checked_s >= _INPUT_CHECK_S:
                    input_checked_s = time.monotonic()
                    self._check_input(stream)
                grab = stream.take() if stream.wait(_STOP_CHECK_S) else None
                if self._state is LinkState.NO_SIGNAL:
                    watchdog.restart()  # opening anew brings no signal back
                else:
                    watchdog.check(grab)
                if grab is not None:
                    self._sort(grab, self._sequence.update(grab.sequence))

    def _check_input(self, stream: V4l2Stream) -> None:
        fault = stream.input_fault()
        if fault is not None:
            self._state = LinkState.NO_SIGNAL
            self._reason = f"{self._config.device} reports {fault}: check the video cable"
        elif self._state is LinkState.NO_SIGNAL:
            self._settling = self._config.settling_frames
            self._state = LinkState.SETTLING

    def _sort(self, grab: Grab, sequence: int) -> None:
        if grab.fault is GrabFault.DAMAGED:
            self._counters.damaged += 1
        elif grab.fault is GrabFault.SHORT:
            self._counters.short += 1
        elif self._state is LinkState.NO_SIGNAL:
            self._counters.no_signal += 1
        elif self._settling:
            self._settling -= 1
            self._counters.settling += 1
        else:
            self._state, self._reason = LinkState.STREAMING, ""
            self._pass_on(grab, sequence)

    def _pass_on(self, grab: Grab, sequence: int) -> None:
        stamp_ns = self._stamps.stamp_ns(grab)
        if stamp_ns is None or grab.image is None:
            return
        self._counters.frames += 1
        self._rate.stamps.append(grab.arrival_ns)
        self._on_frame(
            RawFrame(
                image=grab.image,
                stamp_ns=stamp_ns,
                camera=self.camera,
                sequence=sequence,
                telemetry=self._telemetry(grab.arrival_ns),
            )
        )


class _Watchdog:
    """Raises CaptureError when a stream has brought no good frame for too long."""

    def __init__(self, config: StreamConfig) -> None:
        self._device = config.device
        self._timeout_s = config.timeout_s
        self._start_timeout_s = config.start_timeout_s
        self.restart()

    def restart(self) -> None:
        """Wait for the first frame, from now on."""
        self._limit_s = self._start_timeout_s
        self._good_s = time.monotonic()
        self._damaged = 0

    def check(self, grab: Grab | None) -> None:
        now_s = time.monotonic()
        if grab is not None and grab.fault is None:
            self._good_s, self._limit_s, self._damaged = now_s, self._timeout_s, 0
            return
        self._damaged += grab is not None
        if now_s - self._good_s > self._limit_s:
            what = f"sent {self._damaged} damaged frames only" if self._damaged else "sent nothing"
            raise StallError(
                f"{self._device} {what} for {self._limit_s:g} s: check cable and camera"
            )
