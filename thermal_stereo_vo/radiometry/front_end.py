"""The front end of one camera: gate, then for a thermal one flat field and scene-based refinement.

The correction node and the replay use these very objects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from thermal_stereo_vo.core.cameras import VISIBLE
from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import Image, RadiometricFrame, RawFrame
from thermal_stereo_vo.radiometry.flat_field import (
    FlatField,
    FlatFieldCalibration,
    FlatFieldConfig,
    FlatFieldStatus,
)
from thermal_stereo_vo.radiometry.flat_field_file import load_flat_field
from thermal_stereo_vo.radiometry.gate import (
    FrameGate,
    GateConfig,
    GateDecision,
    GateEvent,
    GateState,
)
from thermal_stereo_vo.radiometry.scene_based import SceneBasedConfig, SceneBasedCorrection
from thermal_stereo_vo.radiometry.visible_gate import VisibleGate, VisibleGateConfig


@dataclass(frozen=True)
class FrontEndConfig:
    """Everything between the raw image and linear counts."""

    gate: GateConfig = group(GateConfig, "Which frames show the scene.")
    flat_field: FlatFieldConfig = group(FlatFieldConfig, "Stored shutterless flat field.")
    scene_based: SceneBasedConfig = group(SceneBasedConfig, "Refinement of the pattern in flight.")
    visible: VisibleGateConfig = group(VisibleGateConfig, "When a visible camera is blind.")


class FrontEnd(ABC):
    """Judges and corrects the raw frames of one camera; ``decision`` is of the last one."""

    gate: FrameGate

    def __init__(self) -> None:
        self.decision = GateDecision(GateState.TRACKING, 0)

    @property
    def flat_field_status(self) -> FlatFieldStatus | None:
        """How the last frame was corrected; None without a flat field."""
        return None

    @abstractmethod
    def _corrected(self, raw: RawFrame, decision: GateDecision) -> Image:
        """The image of a frame that shows the scene."""

    @abstractmethod
    def warm_up(self) -> None:
        """Compile the kernels, so that the first frames are not late."""

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
        return RadiometricFrame(
            image=None if decision.blind else self._corrected(raw, decision),
            stamp_ns=raw.stamp_ns,
            camera=raw.camera,
            sequence=raw.sequence,
            epoch=decision.epoch,
            gap=decision.gap,
            telemetry=raw.telemetry,
            blind=decision.reason,
        )

    def check(self, silence_s: float) -> GateEvent | None:
        """Tell of a stream that has been silent for so long that it is dead; None when not new."""
        return self.gate.check(self.gate.last_stamp_ns + round(silence_s * 1e9))

    def reset(self) -> None:
        """Forget all images: the clock was set back or another recording begins."""
        self.gate.reset()


def create_front_end(
    config: FrontEndConfig, camera: str, on_event: Callable[[GateEvent], None] | None = None
) -> FrontEnd:
    """The front end for the camera of this role.  Raises what ``ThermalFrontEnd`` raises."""
    if camera == VISIBLE:
        return VisibleFrontEnd(config, camera, on_event)
    return ThermalFrontEnd(config, camera, on_event)


class ThermalFrontEnd(FrontEnd):
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
        super().__init__()
        self.camera = camera
        self.gate = FrameGate(config.gate, camera, on_event)
        self.serials = _serials(config.flat_field)
        self._flat_field = _open_flat_field(config.flat_field, camera, self.serials)
        self._scene_based: SceneBasedCorrection | None = None
        if config.scene_based.enabled:
            self._scene_based = SceneBasedCorrection(config.scene_based)

    @property
    def flat_field_status(self) -> FlatFieldStatus | None:
        """How the last frame was corrected; None without a flat field."""
        return None if self._flat_field is None else self._flat_field.status

    def _corrected(self, raw: RawFrame, decision: GateDecision) -> Image:
        image = raw.image
        if self._flat_field is not None:
            kelvin = None if raw.telemetry is None else raw.telemetry.fpa_temperature_kelvin
            image = self._flat_field.process(image, kelvin, raw.stamp_ns)
        if self._scene_based is not None:
            image = self._scene_based.process(image, settled=decision.settled, epoch=decision.epoch)
        return image

    def warm_up(self) -> None:
        """Compile the kernels, so that the first frames are not late."""
        warm_up()


class VisibleFrontEnd(FrontEnd):
    """Passes the frames of a visible camera on as they are, but for those that show nothing."""

    def __init__(
        self,
        config: FrontEndConfig,
        camera: str,
        on_event: Callable[[GateEvent], None] | None = None,
    ) -> None:
        super().__init__()
        self.gate = VisibleGate(config.gate, config.visible, camera, on_event)

    def _corrected(self, raw: RawFrame, decision: GateDecision) -> Image:
        return raw.image

    def warm_up(self) -> None:
        """Compile the kernels, so that the first frames are not late."""
        for dtype in (np.uint8, np.uint16):
            images = (np.arange(64 * 64).reshape(64, 64) * k for k in (1, 2))
            gate = VisibleGate()
            for k, image in enumerate(images):
                gate.process(RawFrame(image.astype(dtype), k, ""))


def warm_up() -> None:
    """Compile every kernel of gate, flat field and scene-based refinement for both image types."""
    coefficients, bad = np.zeros((2, 64, 64), np.float32), np.eye(64, dtype=np.bool_)
    one, nothing = np.ones((2, 64, 64), np.float32), np.zeros(1)
    for gain in (one, one[:1]):
        calibration = FlatFieldCalibration(
            "",
            "",
            280.0,
            320.0,
            300.0,
            20.0,
            nothing,
            coefficients.copy(),
            gain.copy(),
            bad.copy(),
            nothing,
            nothing,
            nothing,
        )
        for dtype in (np.uint8, np.uint16):
            ramp = np.arange(64 * 64).reshape(64, 64)
            raws = [RawFrame((k * ramp).astype(dtype), k, "") for k in range(1, 4)]
            gate, flat_field = FrameGate(), FlatField(calibration)
            scene_based = SceneBasedCorrection(SceneBasedConfig(min_change=0.0))
            for raw in raws:
                gate.process(raw)
                corrected = flat_field.process(raw.image, 300.0, raw.stamp_ns)
                scene_based.process(corrected, settled=True, epoch=0)


def _open_flat_field(
    config: FlatFieldConfig, camera: str, serials: Mapping[str, str]
) -> FlatField | None:
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
