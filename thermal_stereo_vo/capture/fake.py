"""A recording that plays live cameras, so that everything behind them can be tried at a desk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from thermal_stereo_vo.capture.clock import EpochClock
from thermal_stereo_vo.capture.recovery import LinkCounters, LinkState, LinkStatus, Rate
from thermal_stereo_vo.capture.source import CameraStatus, no_control
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.frames import RawFrame

_LATE_NS = 250_000_000
_PAUSE_NS = 33_333_333


@dataclass(frozen=True)
class FakeConfig:
    """A recording in place of the cameras."""

    recording: str = setting(
        "", "Folder or bag as 'replay' takes it, or sim:PRESET for a simulated flight."
    )
    rate_hz: float = setting(
        0.0,
        "Frame rate of images without stamps, and of a simulated flight; 0 where it is known.",
        unit="Hz",
        minimum=0.0,
        maximum=1000.0,
    )
    speed: float = setting(1.0, "Times as fast as recorded.", minimum=0.01, maximum=100.0)
    repeat: bool = setting(True, "Start again at the end.")


class FakeCameras:
    """A ``CameraSource`` that plays frames at their own pace, stamped with the present.

    ``frames`` gives the frames of all cameras in order of their stamps, as often as it is called.
    A source that cannot keep up plays in slow motion: its stamps stay those of the present.
    """

    def __init__(
        self,
        cameras: tuple[str, ...],
        frames: Callable[[], Iterable[RawFrame]],
        config: FakeConfig | None = None,
        *,
        clock: EpochClock | None = None,
    ) -> None:
        self._config = config if config is not None else FakeConfig()
        self._frames = frames
        self._cameras = cameras
        self._clock = clock if clock is not None else EpochClock()
        self._stop = threading.Event()
        self._again = threading.Event()
        self._thread: threading.Thread | None = None
        self._reason = ""
        self._state = LinkState.CLOSED
        self._counters = {camera: LinkCounters() for camera in cameras}
        self._rates = {camera: Rate() for camera in cameras}

    @property
    def cameras(self) -> tuple[str, ...]:
        return self._cameras

    def start(self, on_frame: Callable[[RawFrame], None]) -> None:
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._run, args=(on_frame,), name="capture-fake", daemon=True
        )
        self._state = LinkState.OPENING
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._state = LinkState.CLOSED

    def streaming(self, camera: str) -> bool:
        return self._state is LinkState.STREAMING

    def reconnect(self) -> None:
        self._again.set()

    def status(self) -> dict[str, CameraStatus]:
        now_ns = time.monotonic_ns()
        return {
            camera: CameraStatus(
                LinkStatus(
                    camera=camera,
                    state=self._state,
                    reason=self._reason,
                    counters=replace(self._counters[camera]),
                    rate_hz=self._rates[camera].hz(now_ns),
                )
            )
            for camera in self._cameras
        }

    def ffc_inhibited(self) -> bool:
        return False

    def do_ffc(self) -> None:
        raise no_control()

    def open_shutter(self) -> None:
        raise no_control()

    def inhibit_ffc(self, inhibit: bool) -> None:
        raise no_control()

    def _run(self, on_frame: Callable[[RawFrame], None]) -> None:
        while not self._stop.is_set():
            self._again.clear()
            for counters in self._counters.values():
                counters.connections += 1
            try:
                self._play(on_frame)
            except Exception as error:  # a broken recording must not end the program silently
                self._state, self._reason = LinkState.CLOSED, f"the recording broke off: {error}"
                return
            if not self._config.repeat and not self._again.is_set():
                self._state, self._reason = LinkState.CLOSED, "the recording is over"
                return

    def _play(self, on_frame: Callable[[RawFrame], None]) -> None:
        begin_ns = first_ns = None
        first_camera = ""
        for frame in self._frames():
            if self._stop.is_set() or self._again.is_set():
                return
            if begin_ns is None or first_ns is None:
                begin_ns, first_ns = time.monotonic_ns() + _PAUSE_NS, frame.stamp_ns
                first_camera = frame.camera
            moment_ns = begin_ns + round((frame.stamp_ns - first_ns) / self._config.speed)
            late_ns = time.monotonic_ns() - moment_ns
            if late_ns > _LATE_NS and frame.camera == first_camera:  # else it would tear a pair
                begin_ns += late_ns
                moment_ns += late_ns
            elif late_ns < 0:
                self._stop.wait(-late_ns * 1e-9)
            self._state, self._reason = LinkState.STREAMING, ""
            counters = self._counters[frame.camera]
            self._rates[frame.camera].stamps.append(time.monotonic_ns())
            stamp_ns = self._clock.to_epoch_ns(moment_ns)
            on_frame(replace(frame, stamp_ns=stamp_ns, sequence=counters.frames))
            counters.frames += 1
