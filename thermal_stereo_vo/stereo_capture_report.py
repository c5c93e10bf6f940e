"""What a live stereo capture says of itself, for ``status`` and ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace

from thermal_stereo_vo.capture.recovery import LinkState
from thermal_stereo_vo.capture.source import CameraStatus
from thermal_stereo_vo.capture.v4l2 import StampKind
from thermal_stereo_vo.core.frames import RawFrame, Telemetry
from thermal_stereo_vo.outputs.ros_fields import (
    ERROR,
    OK,
    WARN,
    DiagnosticFields,
    telemetry_fields,
)
from thermal_stereo_vo.stereo_capture import CaptureCounters, CapturedPair, CaptureStatus

NAME = "stereo capture"
_TOLERATED_DROPS = 0.01
_TOLERATED_UNPAIRED = 0.1


def pair_fields(
    pair: CapturedPair, counters: CaptureCounters, cameras: Mapping[str, CameraStatus]
) -> tuple[DiagnosticFields, ...]:
    """One entry for the pair and one for each camera in it, all with the stamp of the images."""
    dropped = sum(camera.link.counters.dropped for camera in cameras.values())
    values = {
        "skew_ns": pair.skew_ns,
        "pairs": counters.pairs,
        "unpaired": counters.unpaired,
        "overrun": counters.overrun,
        "dropped": dropped,
    }
    message = "pair" if pair.complete else f"{next(iter(pair.frames))} alone"
    whole = DiagnosticFields(
        stamp_ns=pair.stamp_ns,
        level=OK if pair.complete else WARN,
        name=NAME,
        message=message,
        values=_texts(values),
    )
    return whole, *(_frame_fields(frame, cameras[eye]) for eye, frame in pair.frames.items())


def _frame_fields(frame: RawFrame, camera: CameraStatus) -> DiagnosticFields:
    said = telemetry_fields(frame.stamp_ns, frame.camera, frame.telemetry or Telemetry())
    values = {"sequence": frame.sequence, "dropped": camera.link.counters.dropped}
    return replace(said, values=(*_texts(values), *said.values))


class HealthReport:
    """Judges a capture once a second; remembers what was already told."""

    def __init__(self) -> None:
        self._dropped: dict[str, int] = {}
        self._frames: dict[str, int] = {}
        self._counters = CaptureCounters()

    def fields(self, status: CaptureStatus, stamp_ns: int) -> DiagnosticFields:
        """Level, the most urgent sentences, and every counter."""
        errors, warnings = [], []
        for eye, camera in status.cameras.items():
            errors += [f"{eye}: {text}" for text in _errors(camera)]
            warnings += [f"{eye}: {text}" for text in self._warnings(eye, camera)]
        unpaired = self._unpaired(status)
        (warnings if self._counters.pairs < status.counters.pairs else errors).extend(unpaired)
        self._counters = status.counters
        kinds = {camera.link.stamp_kind for camera in status.cameras.values()}
        if kinds == {StampKind.START_OF_FRAME, StampKind.END_OF_FRAME}:
            warnings.append(
                "one driver stamps the start of a frame, the other the end: set stamp_offset_ms"
            )
        if status.sync.warning:
            warnings.append(status.sync.warning)
        level = ERROR if errors else WARN if warnings else OK
        rates = [f"{camera.link.rate_hz:.1f}" for camera in status.cameras.values()]
        well = f"streaming at {' and '.join(rates)} Hz"
        return DiagnosticFields(
            stamp_ns=stamp_ns,
            level=level,
            name=NAME,
            message="; ".join([*errors, *warnings]) or well,
            values=_texts(dict(_values(status))),
        )

    def _unpaired(self, status: CaptureStatus) -> Iterator[str]:
        pairs = status.counters.pairs - self._counters.pairs
        unpaired = status.counters.unpaired - self._counters.unpaired
        if unpaired > _TOLERATED_UNPAIRED * (2 * pairs + unpaired):
            yield (
                f"{unpaired} frames found no partner, {pairs} pairs did: the stamps of the eyes "
                "differ by more than pairing.tolerance_ms, synchronise the cameras or allow up to "
                "half a frame period"
            )

    def _warnings(self, eye: str, camera: CameraStatus) -> Iterator[str]:
        link, control = camera.link, camera.control
        frames, dropped = link.counters.frames, link.counters.dropped
        new_frames = frames - self._frames.get(eye, 0)
        new_dropped = dropped - self._dropped.get(eye, 0)
        self._frames[eye], self._dropped[eye] = frames, dropped
        if new_dropped > _TOLERATED_DROPS * (new_frames + new_dropped):
            yield f"{new_dropped} of {new_frames + new_dropped} frames were lost or damaged"
        if link.counters.by_arrival and link.stamp_kind is StampKind.UNKNOWN_CLOCK:
            yield "the driver's stamps are on no known clock: frames are stamped on arrival"
        elif link.counters.by_arrival:
            yield (
                f"{link.counters.by_arrival} stamps of the driver were far from the present and "
                "were replaced by the arrival"
            )
        if link.format is not None:
            yield from link.format.warnings
        if control is not None and not control.connected:
            yield f"control: {control.reason}"
        if control is not None and control.ffc_failures:
            yield f"{control.ffc_failures} flat-field corrections have failed"


def _errors(camera: CameraStatus) -> Iterator[str]:
    link = camera.link
    if link.state is not LinkState.STREAMING:
        yield f"{link.state.value}{': ' + link.reason if link.reason else ''}"


def _values(status: CaptureStatus) -> Iterator[tuple[str, object]]:
    yield from asdict(status.counters).items()
    sync = status.sync
    yield "skew_ms", f"{sync.skew_ms:.3f}"
    yield "skew_spread_ms", f"{sync.spread_ms:.3f}"
    yield "image_motion_px_s", f"{sync.motion_px_s:.0f}"
    yield "skew_displacement_px", f"{sync.displacement_px:.2f}"
    yield "ffc_inhibited", status.ffc_inhibited
    for eye, camera in status.cameras.items():
        for key, value in _camera_values(camera):
            yield f"{eye}_{key}", value


def _camera_values(camera: CameraStatus) -> Iterator[tuple[str, object]]:
    link, control = camera.link, camera.control
    yield "state", link.state.value
    yield "reason", link.reason
    yield "last_failure", link.last_failure
    yield "rate_hz", f"{link.rate_hz:.2f}"
    yield from asdict(link.counters).items()
    if link.format is not None:
        yield "format", link.format
        yield "driver", f"{link.format.driver} on {link.format.bus}"
        yield "field", link.format.field
        if link.format.input or link.format.standard:
            yield "input", f"{link.format.input} {link.format.standard}".strip()
    if link.stamp_kind is not None:
        yield "stamps", link.stamp_kind.value
    if control is None:
        return
    yield "control", "connected" if control.connected else control.reason
    yield "camera", control.identity
    for key, value in control.settings.items():
        yield f"camera_{key}", value
    if control.fpa_temperature_kelvin is not None:
        yield "fpa_temperature_kelvin", f"{control.fpa_temperature_kelvin:.2f}"
    if control.housing_temperature_kelvin is not None:
        yield "housing_temperature_kelvin", f"{control.housing_temperature_kelvin:.2f}"
    yield "flags", " ".join((flag.name or "").lower() for flag in control.flags)
    yield "ffc_state", "unknown" if control.ffc_state is None else control.ffc_state.value
    yield "ffc_count", control.ffc_count
    yield "ffc_failures", control.ffc_failures
    yield "ffc_reason", control.ffc_reason


def _texts(values: Mapping[str, object]) -> tuple[tuple[str, str], ...]:
    return tuple(
        (key, str(value).lower() if isinstance(value, bool) else str(value))
        for key, value in values.items()
    )
