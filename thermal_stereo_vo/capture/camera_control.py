"""What a Tau 2 can be told and asked over its serial port."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag

from thermal_stereo_vo.capture.cci import (
    CameraControlError,
    CciPort,
    Function,
    RefusedError,
    SerialPort,
)
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import ConfigError

KEEP = "keep"
_CELSIUS_ZERO_KELVIN = 273.15

_GAIN = {"auto": 0, "low": 1, "high": 2, "manual": 3}
_AGC = {"plateau": 0, "once_bright": 1, "auto_bright": 2, "manual": 3, "linear": 5}
_SYNC = {"disabled": 0, "slave": 1, "master": 2}
_SYNC_OF_PAIR = {
    "disabled": {"left": "disabled", "right": "disabled"},
    "slaves": {"left": "slave", "right": "slave"},
    "left_master": {"left": "master", "right": "slave"},
    "right_master": {"left": "slave", "right": "master"},
}
_ZOOM = {"1x": 0, "2x": 4}
_STANDARD = {"NTSC_30": 0, "PAL_25": 1, "NTSC_60": 3, "PAL_50": 4}
_LVDS = {"14_bit": 0, "8_bit": 1, "disabled": 2, "14_bit_unfiltered": 3}
_XP = {"disabled": 0, "bt656": 1, "cmos": 2}
_GET_XP, _SET_XP = 0x0200, 0x0300
_SENSOR_FPA, _SENSOR_HOUSING, _SENSOR_FLAGS = 0x00, 0x0A, 0x11


@dataclass(frozen=True)
class CameraSettings:
    """How both cameras shall be set; ``keep`` leaves what the camera has."""

    gain_mode: str = setting(
        KEEP,
        "Dynamic range; high for drones, auto may switch in flight.",
        choices=(KEEP, *_GAIN),
    )
    video_standard: str = setting(KEEP, "Analog output.", choices=(KEEP, *_STANDARD))
    zoom: str = setting(KEEP, "Digital zoom of the 8-bit outputs.", choices=(KEEP, *_ZOOM))
    lvds_output: str = setting(KEEP, "Digital LVDS output.", choices=(KEEP, *_LVDS))
    xp_output: str = setting(KEEP, "Digital output on the XP bus.", choices=(KEEP, *_XP))
    agc_type: str = setting(KEEP, "Mapping of 14 bits to the 8-bit outputs.", choices=(KEEP, *_AGC))
    agc_filter: str = setting(
        KEEP,
        "Speed of that mapping: immediate, frozen, or 1 (slowest) to 254; the two words need "
        "'firmware', since the codes for them differ.",
    )
    agc_roi: str = setting(
        KEEP,
        "Region that the mapping looks at: 'left,top,right,bottom' in pixels from the centre of "
        "the image, for example -320,0,320,240 to leave out the sky.",
    )
    firmware: str = setting(
        "unknown",
        "Generation of the camera's firmware: Tau 2.7 and later, or before.",
        choices=("unknown", "before_2_7", "2_7"),
    )
    external_sync: str = setting(
        KEEP,
        "Frame start by a pulse: both cameras slaves of another device, or one the master.",
        choices=(KEEP, *_SYNC_OF_PAIR),
    )
    ffc_warn_frames: int = setting(
        -1,
        "Frames before an automatic correction at which a symbol appears in the 8-bit picture; 0 "
        "for never, -1 keeps what the camera has.",
        unit="frames",
        minimum=-1,
        maximum=65535,
    )


class StatusFlags(IntFlag):
    """READ_SENSOR 0x11; the bits are from public drivers, not from a document of the maker."""

    OVER_TEMPERATURE = 1 << 0
    FFC_DESIRED = 1 << 2
    GAIN_SWITCH_DESIRED = 1 << 3
    TABLE_SWITCH_DESIRED = 1 << 5
    FFC_IN_PROGRESS = 1 << 6

    @property
    def asks_for_ffc(self) -> bool:
        """Whether the core asks for any correction."""
        return bool(self & (StatusFlags.FFC_DESIRED | _LONG_FFC))

    @property
    def asks_for_long_ffc(self) -> bool:
        """Whether only a long correction helps: it also switches the table."""
        return bool(self & _LONG_FFC)


NO_FLAGS = StatusFlags(0)
_LONG_FFC = StatusFlags.GAIN_SWITCH_DESIRED | StatusFlags.TABLE_SWITCH_DESIRED


@dataclass(frozen=True)
class Identity:
    """Who answers."""

    camera_serial: int
    sensor_serial: int
    software: tuple[int, int]
    firmware: tuple[int, int]

    def __str__(self) -> str:
        software, firmware = self.software, self.firmware
        return (
            f"serial {self.camera_serial}, sensor {self.sensor_serial}, software "
            f"{software[0]}.{software[1]}, firmware {firmware[0]}.{firmware[1]}"
        )


class Tau2Control:
    """A camera that answers.  Every write is read back; nothing goes into the camera's flash."""

    def __init__(self, port: CciPort) -> None:
        self._port = port

    def identity(self) -> Identity:
        """Serial numbers and revisions."""
        serial = self._port.call(Function.SERIAL_NUMBER).ljust(8, b"\0")
        revision = self._port.call(Function.REVISION).ljust(8, b"\0")
        camera, sensor = struct.unpack(">2I", serial[:8])
        software_major, software_minor, major, minor = struct.unpack(">4H", revision[:8])
        return Identity(camera, sensor, (software_major, software_minor), (major, minor))

    def flags(self, *, timeout_s: float | None = None) -> StatusFlags:
        """What the core says of itself now."""
        return StatusFlags(self._read_sensor(_SENSOR_FLAGS, timeout_s) & 0xFFFF)

    def fpa_temperature_kelvin(self) -> float:
        """Temperature of the detector."""
        return self._read_sensor(_SENSOR_FPA) / 10.0 + _CELSIUS_ZERO_KELVIN

    def housing_temperature_kelvin(self) -> float | None:
        """Temperature of the housing; None where the camera has no such sensor."""
        try:
            return self._read_sensor(_SENSOR_HOUSING) / 100.0 + _CELSIUS_ZERO_KELVIN
        except RefusedError:
            return None

    def do_ffc(self, *, long: bool) -> None:
        """Begin a flat-field correction.

        Returns when the camera has taken the order, long before the correction is over.
        """
        self._port.call(Function.DO_FFC, _word(int(long)), repeat=False)

    def set_ffc_automatic(self, automatic: bool) -> None:
        """Who decides on corrections: the camera or the host."""
        self._set_word(Function.FFC_MODE, int(automatic))

    def open_shutter(self) -> None:
        """Open a shutter that a shock has closed."""
        self._move_shutter(0)

    def close_shutter(self) -> None:
        """Close it: a uniform scene for a calibration."""
        self._move_shutter(1)

    def configure(self, settings: CameraSettings, camera: str) -> tuple[str, ...]:
        """Write what differs from ``settings``; says what was changed.

        ``camera`` is left or right, for who of the two is the master of the pulse.

        Raises CameraControlError for a value that the camera does not take over, ConfigError for
        settings that cannot be meant.
        """
        filter_word = agc_filter_word(settings)
        roi = parse_agc_roi(settings)
        words = {
            Function.GAIN_MODE: _GAIN.get(settings.gain_mode),
            Function.VIDEO_STANDARD: _STANDARD.get(settings.video_standard),
            Function.VIDEO_MODE: _ZOOM.get(settings.zoom),
            Function.DIGITAL_OUTPUT: _LVDS.get(settings.lvds_output),
            Function.AGC_TYPE: _AGC.get(settings.agc_type),
            Function.AGC_FILTER: filter_word,
            Function.EXTERNAL_SYNC: _SYNC.get(
                _SYNC_OF_PAIR.get(settings.external_sync, {}).get(camera, KEEP)
            ),
            Function.FFC_WARN_TIME: (
                None if settings.ffc_warn_frames < 0 else settings.ffc_warn_frames
            ),
        }
        changes: list[str] = []
        for function, wanted in words.items():
            if wanted is not None:
                changes += self._set_word(function, wanted)
        changes += self._set_xp(settings.xp_output)
        if roi is not None:
            changes += self._set_agc_roi(roi)
        return tuple(changes)

    def report(self) -> Mapping[str, str]:
        """Settings that matter to a user, as far as the camera tells them."""
        questions = {
            "gain_mode": (Function.GAIN_MODE, _GAIN),
            "ffc_mode": (Function.FFC_MODE, {"manual": 0, "automatic": 1, "external": 2}),
            "ffc_period_frames": (Function.FFC_PERIOD, {}),
            "ffc_temperature_delta_decikelvin": (Function.FFC_TEMPERATURE_DELTA, {}),
            "agc_type": (Function.AGC_TYPE, _AGC),
            "agc_filter": (Function.AGC_FILTER, {}),
            "external_sync": (Function.EXTERNAL_SYNC, _SYNC),
            "video_standard": (Function.VIDEO_STANDARD, _STANDARD),
        }
        answers = {}
        for key, (function, names) in questions.items():
            try:
                value = self._get_word(function)
            except RefusedError as error:
                answers[key] = str(error)
                continue
            answers[key] = {word: name for name, word in names.items()}.get(value, str(value))
        return answers

    def _read_sensor(self, selector: int, timeout_s: float | None = None) -> int:
        reply = self._port.call(Function.READ_SENSOR, _word(selector), timeout_s=timeout_s)
        return _signed_word(Function.READ_SENSOR, reply)

    def _get_word(self, function: Function, argument: bytes = b"") -> int:
        return _signed_word(function, self._port.call(function, argument)) & 0xFFFF

    def _set_word(self, function: Function, wanted: int) -> list[str]:
        """Write if it differs and read back; tells the change."""
        before = self._get_word(function)
        if before == wanted:
            return []
        self._port.call(function, _word(wanted))
        self._check(function, wanted, self._get_word(function))
        return [f"{function.name} {before} -> {wanted}"]

    def _move_shutter(self, position: int) -> None:
        # Always sent: the camera does not know of a shutter that a shock has moved.
        self._port.call(Function.SHUTTER_POSITION, _word(position))
        try:
            now = self._get_word(Function.SHUTTER_POSITION)
        except RefusedError:
            return  # it moves the shutter but does not tell where it is
        self._check(Function.SHUTTER_POSITION, position, now)

    def _set_xp(self, output: str) -> list[str]:
        wanted = _XP.get(output)
        if wanted is None:
            return []
        before = self._get_word(Function.DIGITAL_OUTPUT, _word(_GET_XP))
        if before == wanted:
            return []
        self._port.call(Function.DIGITAL_OUTPUT, _word(_SET_XP | wanted))
        self._check(
            Function.DIGITAL_OUTPUT,
            wanted,
            self._get_word(Function.DIGITAL_OUTPUT, _word(_GET_XP)),
        )
        return [f"XP output {before} -> {wanted}"]

    def _set_agc_roi(self, roi: tuple[int, int, int, int]) -> list[str]:
        # Asked with two bytes, newer firmware tells the regions of three zooms and wants all three
        # back; older tells two and takes that of the present zoom (B-9 of v150, B-7 of v100).
        wanted = struct.pack(">4h", *roi)
        regions = self._port.call(Function.AGC_ROI, _word(0))
        if regions[:8] == wanted:
            return []
        if len(regions) == 24:
            self._port.call(Function.AGC_ROI, wanted + regions[8:])
        else:
            self._port.call(Function.AGC_ROI, wanted)
        now = self._port.call(Function.AGC_ROI, _word(0))[:8]
        if now != wanted:
            raise CameraControlError(
                f"the AGC region was set to {wanted.hex(' ')} but reads {now.hex(' ')}: check that "
                "it lies within the image"
            )
        before = struct.unpack(">4h", regions[:8].ljust(8, b"\0"))
        return [f"AGC_ROI {before} -> {roi}"]

    @staticmethod
    def _check(function: Function, wanted: int, now: int) -> None:
        if now != wanted:
            raise CameraControlError(
                f"{function.name} was set to {wanted} but reads {now}: the camera does not "
                "support this value"
            )


def agc_filter_word(settings: CameraSettings) -> int | None:
    """The code of ``agc_filter`` for the firmware; None to keep.

    Before Tau 2.7, 0 means immediate and nothing means frozen; since then 0 means frozen and 255
    immediate (FLIR application note 102-PS242-100-01).

    Raises ConfigError where the meaning is not certain.
    """
    text, firmware = settings.agc_filter, settings.firmware
    if text == KEEP:
        return None
    if text.isdecimal() and 1 <= int(text) <= 254:
        return int(text)
    if text not in ("immediate", "frozen"):
        raise ConfigError(
            f"agc_filter = '{text}' must be keep, immediate, frozen or a number from 1 to 254"
        )
    if firmware == "unknown":
        raise ConfigError(
            f"agc_filter = {text} needs 'firmware' (before_2_7 or 2_7): the code 0 means immediate "
            "on one and frozen on the other"
        )
    if firmware == "2_7":
        return 255 if text == "immediate" else 0
    if text == "frozen":
        raise ConfigError("agc_filter = frozen is unknown to firmware before 2.7")
    return 0


def parse_agc_roi(settings: CameraSettings) -> tuple[int, int, int, int] | None:
    """(left, top, right, bottom) of ``agc_roi``; None to keep.  Raises ConfigError."""
    if settings.agc_roi == KEEP:
        return None
    try:
        left, top, right, bottom = (int(part) for part in settings.agc_roi.split(","))
    except ValueError:
        raise ConfigError(
            f"agc_roi = '{settings.agc_roi}' must be keep or four whole numbers "
            "left,top,right,bottom"
        ) from None
    if not (-320 <= left < right <= 320 and -256 <= top < bottom <= 256):
        raise ConfigError(
            f"agc_roi = {settings.agc_roi} must have left < right within -320..320 and top < "
            "bottom within -256..256"
        )
    return left, top, right, bottom


def open_serial(port: str, baud: int) -> SerialPort:
    """Open a serial port, 8N1.  Raises CameraControlError."""
    try:
        import serial
    except ImportError:
        raise CameraControlError(
            "camera control needs pyserial: apt install python3-serial"
        ) from None
    try:
        opened: SerialPort = serial.Serial(
            port, baud, timeout=0.02, write_timeout=0.5, exclusive=True
        )
    except (OSError, ValueError) as error:
        raise CameraControlError(
            f"the control port {port} cannot be opened: {error}; check the udev name and the group "
            "'dialout'"
        ) from None
    return opened


def _word(value: int) -> bytes:
    return value.to_bytes(2, "big")


def _signed_word(function: Function, data: bytes) -> int:
    if len(data) < 2:
        raise CameraControlError(
            f"the camera answers {function.name} with {len(data)} bytes instead of 2: is it a Tau?"
        )
    return int.from_bytes(data[:2], "big", signed=True)
