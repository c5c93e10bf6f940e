"""Live cameras as a source of stereo pairs: capture and pairing strung together."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import TracebackType

from thermal_stereo_vo.capture.fake import FakeCameras, FakeConfig
from thermal_stereo_vo.capture.grabber_rig import GrabberConfig, GrabberRig
from thermal_stereo_vo.capture.image_motion import ImageMotion
from thermal_stereo_vo.capture.source import CameraSource, CameraStatus
from thermal_stereo_vo.capture.sync import SyncConfig, SyncMonitor, SyncReport
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.core.errors import CaptureError, ConfigError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.stereo.pairing import Pair, PairingConfig, StereoPairer

EYES = (LEFT, RIGHT)
_MOTION_EVERY = 8


@dataclass(frozen=True)
class StereoCaptureConfig:
    """Everything about live stereo."""

    source: str = setting(
        "grabbers",
        "grabbers: two V4L2 devices; recording: a recording plays them.",
        choices=("grabbers", "recording"),
    )
    waiting_pairs: int = setting(
        4,
        "Pairs that may wait for a slow reader before the oldest is thrown away.",
        minimum=1,
        maximum=1000,
    )
    left_calibration: str = setting(
        "",
        "URL of the left camera_info file: file:///PATH or package://PACKAGE/PATH; empty for none.",
    )
    right_calibration: str = setting("", "The same for the right camera.")
    pairing: PairingConfig = group(PairingConfig, "Which images belong together.")
    sync: SyncConfig = group(SyncConfig, "How the cameras keep step.")
    grabbers: GrabberConfig = group(GrabberConfig, "The two cameras and their grabbers.")
    recording: FakeConfig = group(FakeConfig, "A recording in place of the cameras.")


@dataclass(frozen=True)
class CapturedPair:
    """The frames of one instant by role, under one common stamp.

    A frame is alone only while the other camera is not streaming.  ``skew_ns`` is what the stamps
    differed by, right minus left; 0 for one alone.
    """

    stamp_ns: int
    frames: Mapping[str, RawFrame]
    skew_ns: int = 0

    @property
    def complete(self) -> bool:
        """Whether both eyes saw."""
        return len(self.frames) == len(EYES)


@dataclass
class CaptureCounters:
    """What became of the frames after their capture."""

    pairs: int = 0
    alone: int = 0
    unpaired: int = 0
    overrun: int = 0


@dataclass(frozen=True)
class CaptureStatus:
    """A snapshot of everything, for diagnostics."""

    cameras: Mapping[str, CameraStatus]
    counters: CaptureCounters
    sync: SyncReport
    ffc_inhibited: bool


class StereoCapture:
    """``pairs`` of a live source; entering starts the cameras, leaving closes them.

    The reader may be slower than the cameras: the oldest pairs are thrown away and counted
    (``overrun``).  Frames without partner while both cameras stream are dropped (``unpaired``).
    """

    def __init__(
        self,
        source: CameraSource,
        pairing: PairingConfig | None = None,
        sync: SyncConfig | None = None,
        *,
        waiting_pairs: int = 4,
    ) -> None:
        if source.cameras != EYES:
            raise CaptureError(
                f"a stereo source needs the cameras left and right, not {', '.join(source.cameras)}"
            )
        self._source = source
        self._pairer: StereoPairer[RawFrame] = StereoPairer(
            pairing if pairing is not None else PairingConfig()
        )
        self._monitor = SyncMonitor(sync if sync is not None else SyncConfig())
        self._motion = ImageMotion(_MOTION_EVERY)
        self._waiting: deque[CapturedPair] = deque()
        self._max_waiting = waiting_pairs
        self._changed = threading.Condition()
        self._closed = False
        self._counters = CaptureCounters()

    def __enter__(self) -> StereoCapture:
        self._source.start(self._on_frame)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the cameras and end ``pairs``; may be called again."""
        self._source.stop()
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def pairs(self) -> Iterator[CapturedPair]:
        """What the cameras see, in order of stamps; waits for it; ends with ``close``."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                pair = self._waiting.popleft()
            if LEFT in pair.frames:
                motion_px_s = self._motion.update(pair.frames[LEFT].image, pair.stamp_ns)
                if pair.complete:
                    self._monitor.update(pair.skew_ns, motion_px_s)
            yield pair

    def frames(self) -> Iterator[RawFrame]:
        """The frames of ``pairs``, left before right, each under the stamp of its pair."""
        for pair in self.pairs():
            yield from pair.frames.values()

    def reconnect(self) -> None:
        """Close and open all cameras now."""
        self._source.reconnect()

    def do_ffc(self) -> None:
        """Correct the flat field of all cameras soon.  Raises CaptureError without control."""
        self._source.do_ffc()

    def open_shutter(self) -> None:
        """Open shutters that a shock has closed.  Raises CaptureError without control."""
        self._source.open_shutter()

    def inhibit_ffc(self, inhibit: bool) -> None:
        """No corrections for a while, or again.  Raises CaptureError without control."""
        self._source.inhibit_ffc(inhibit)

    def counters(self) -> CaptureCounters:
        """What became of the frames so far."""
        return replace(self._counters)

    def cameras(self) -> dict[str, CameraStatus]:
        """Role -> how the camera is."""
        return self._source.status()

    def status(self) -> CaptureStatus:
        """How everything is; may be called from any thread."""
        return CaptureStatus(
            cameras=self.cameras(),
            counters=self.counters(),
            sync=self._monitor.report(),
            ffc_inhibited=self._source.ffc_inhibited(),
        )

    def _on_frame(self, frame: RawFrame) -> None:
        index = EYES.index(frame.camera)
        with self._changed:
            for pair in self._pairer.push(index, frame):
                self._sort(pair)
            if not self._source.streaming(EYES[1 - index]):
                for pair in self._pairer.flush():
                    self._sort(pair)

    def _sort(self, pair: Pair[RawFrame]) -> None:
        frames = {
            eye: item if item.stamp_ns == pair.stamp_ns else replace(item, stamp_ns=pair.stamp_ns)
            for eye, item in zip(EYES, (pair.first, pair.second), strict=True)
            if item is not None
        }
        if len(frames) == len(EYES):
            self._counters.pairs += 1
        elif all(self._source.streaming(eye) for eye in EYES):
            self._counters.unpaired += 1
            return
        else:
            self._counters.alone += 1
        if len(self._waiting) >= self._max_waiting:
            self._waiting.popleft()
            self._counters.overrun += 1
        self._waiting.append(CapturedPair(pair.stamp_ns, frames, pair.skew_ns))
        self._changed.notify()


def open_stereo_capture(
    config: StereoCaptureConfig,
) -> tuple[StereoCapture, RigCalibration | None]:
    """The capture that ``config`` describes, and the calibration that a recording brings.

    Raises ConfigError, and DatasetError or CalibrationError for a recording.
    """
    source: CameraSource
    calibration = None
    if config.source == "recording":
        from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset

        if not config.recording.recording:
            raise ConfigError("source is 'recording', but recording.recording names none")
        options = SourceOptions(rate_hz=config.recording.rate_hz or None)
        dataset, _ = open_dataset(config.recording.recording, options)
        calibration = dataset.calibration()
        source = FakeCameras(dataset.cameras, dataset.frames, config.recording)
    else:
        source = GrabberRig(config.grabbers)
    capture = StereoCapture(source, config.pairing, config.sync, waiting_pairs=config.waiting_pairs)
    return capture, calibration
