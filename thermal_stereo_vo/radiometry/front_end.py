"""The thermal front end of one camera: gate, stored flat field, scene-based refinement.

The correction node and the replay use this very object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import RadiometricFrame, RawFrame
from thermal_stereo_vo.radiometry.flat_field import FlatField, FlatFieldConfig, FlatFieldStatus
from thermal_stereo_vo.radiometry.flat_field_file import load_flat_field
from thermal_stereo_vo.radiometry.gate import (
    FrameGate,
    GateConfig,
    GateDecision,
    GateEvent,
    GateState,
)


@dataclass(frozen=True)
class FrontEndConfig:
    """Everything between the raw image and linear counts."""

    gate: GateConfig = group(GateConfig, "Which frames show the scene.")
    flat_field: FlatFieldConfig = group(FlatFieldConfig, "Stored shutterless flat field.")


class ThermalFrontEnd:
    """Turns the raw frames of one camera into linear counts that the odometry may use.

    Args:
        config: settings.
        camera: role of the camera (``left``, ``right``, ...).
        on_event: hears every event of the gate.

    Raises:
        CalibrationError: when the flat field cannot be read or belongs to another camera.
        ConfigError: when the settings name the flat field wrongly.
    """

    def __init__(
        self,
        config: FrontEndConfig,
        camera: str,
        on_event: Callable[[GateEvent], None] | None = None,
    ) -> None:
        self.camera = camera
        self.gate = FrameGate(config.gate, camera, on_event)
        self.decision = GateDecision(GateState.TRACKING, 0)
        self._flat_field = _open_flat_field(config.flat_field, camera)

    @property
    def flat_field_status(self) -> FlatFieldStatus | None:
        """How the last frame was corrected; None without a flat field."""
        return None if self._flat_field is None else self._flat_field.status

    def process(self, raw: RawFrame) -> RadiometricFrame | None:
        """Judge and correct one frame; ``decision`` keeps what the gate thought of it.

        Returns:
            The frame, with ``image`` None while the camera is blind; or None for a frame that only
            repeats the one before because the link is faster than the sensor.

        Raises:
            FrameError: for a size or type that does not fit settings, flat field or stream.
            OutOfOrderError: for a stamp that does not lie after the last one.
        """
        self.decision = decision = self.gate.process(raw)
        if decision.repeat:
            return None
        image = None
        if not decision.blind:
            image = raw.image
            if self._flat_field is not None:
                kelvin = None if raw.telemetry is None else raw.telemetry.fpa_temperature_kelvin
                image = self._flat_field.process(image, kelvin, raw.stamp_ns)
        return RadiometricFrame(
            image=image,
            stamp_ns=raw.stamp_ns,
            camera=raw.camera,
            sequence=raw.sequence,
            epoch=decision.epoch,
            gap=decision.gap,
            telemetry=raw.telemetry,
        )

    def reset(self) -> None:
        """Forget all images: the clock was set back or another recording begins."""
        self.gate.reset()


def _open_flat_field(config: FlatFieldConfig, camera: str) -> FlatField | None:
    serials = _serials(config)
    if not config.file:
        return None
    try:
        path = config.file.format(camera=camera)
    except (KeyError, IndexError, ValueError):
        raise ConfigError(
            f"flat_field.file = '{config.file}': only {{camera}} may stand in braces"
        ) from None
    return FlatField(load_flat_field(path), config, camera, serials.get(camera, ""))


def _serials(config: FlatFieldConfig) -> dict[str, str]:
    serials = {}
    for entry in config.serials:
        camera, equals, serial = str(entry).partition("=")
        if not equals or not camera or not serial:
            raise ConfigError(
                f"flat_field.serials holds '{entry}': write camera=serial, as in left=546515111"
            )
        serials[camera.strip()] = serial.strip()
    return serials
