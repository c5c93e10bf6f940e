"""FLIR's serial camera control protocol (Tau User's Manual TAU-0035-00-10, appendix B).

A packet is ``6E status 00 function count(2) crc1(2) data crc2(2)``; numbers are big-endian, the
CRCs are CCITT-16 from 0 over all bytes before them.  The camera only ever answers.

Only what stands in ``WHITE_LIST`` leaves this file: a wrong word can change the camera's flash for
good (SET_DEFAULTS, RESTORE_FACTORY_DEFAULTS) or cut the line (BAUD).
"""

from __future__ import annotations

import binascii
import time
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from thermal_stereo_vo.core.errors import CaptureError

PROCESS_CODE = 0x6E
MAX_DATA = 500
_HEADER, _TRAILER = 8, 2
_BUSY_PAUSE_S = 0.05


class Function(IntEnum):
    """Function codes in use (table B-4)."""

    NO_OP = 0x00
    SERIAL_NUMBER = 0x04
    REVISION = 0x05
    GAIN_MODE = 0x0A
    FFC_MODE = 0x0B
    DO_FFC = 0x0C
    FFC_PERIOD = 0x0D
    FFC_TEMPERATURE_DELTA = 0x0E
    VIDEO_MODE = 0x0F
    DIGITAL_OUTPUT = 0x12
    AGC_TYPE = 0x13
    READ_SENSOR = 0x20
    EXTERNAL_SYNC = 0x21
    FFC_WARN_TIME = 0x3C
    AGC_FILTER = 0x3E
    AGC_ROI = 0x4C
    VIDEO_STANDARD = 0x72
    SHUTTER_POSITION = 0x79


class Status(IntEnum):
    """Status byte of a reply (table B-3)."""

    OK = 0x00
    BUSY = 0x01
    NOT_READY = 0x02
    RANGE_ERROR = 0x03
    CHECKSUM_ERROR = 0x04
    UNDEFINED_PROCESS = 0x05
    UNDEFINED_FUNCTION = 0x06
    TIMEOUT = 0x07
    BYTE_COUNT_ERROR = 0x09
    FEATURE_NOT_ENABLED = 0x0A


@dataclass(frozen=True)
class Allowed:
    """Arguments that may be sent: none at all, certain words, or so many bytes."""

    words: Collection[int] = ()
    lengths: Collection[int] = ()
    nothing: bool = True

    def permits(self, data: bytes) -> bool:
        """Whether ``data`` is among them."""
        if not data:
            return self.nothing
        if len(data) == 2 and int.from_bytes(data, "big") in self.words:
            return True
        return len(data) in self.lengths


WHITE_LIST = {
    Function.NO_OP: Allowed(),
    Function.SERIAL_NUMBER: Allowed(),
    Function.REVISION: Allowed(),
    Function.GAIN_MODE: Allowed(words=(0, 1, 2, 3)),
    # Not 2, external: it would burn the scene into the offsets.
    Function.FFC_MODE: Allowed(words=(0, 1)),
    Function.DO_FFC: Allowed(words=(0, 1)),
    Function.FFC_PERIOD: Allowed(),
    Function.FFC_TEMPERATURE_DELTA: Allowed(),
    # Not 1, freeze.
    Function.VIDEO_MODE: Allowed(words=(0, 4)),
    Function.DIGITAL_OUTPUT: Allowed(words=(0, 1, 2, 3, 0x0200, 0x0300, 0x0301, 0x0302)),
    Function.AGC_TYPE: Allowed(words=(0, 1, 2, 3, 5)),
    Function.READ_SENSOR: Allowed(words=(0x00, 0x01, 0x0A, 0x11), nothing=False),
    Function.EXTERNAL_SYNC: Allowed(words=(0, 1, 2)),
    Function.FFC_WARN_TIME: Allowed(words=range(0x10000)),
    Function.AGC_FILTER: Allowed(words=range(256)),
    Function.AGC_ROI: Allowed(words=(0,), lengths=(8, 24)),
    Function.VIDEO_STANDARD: Allowed(words=(0, 1, 3, 4)),
    Function.SHUTTER_POSITION: Allowed(words=(0, 1)),
}


class CameraControlError(CaptureError):
    """The camera cannot be controlled."""


class NoReplyError(CameraControlError):
    """Nothing, or nothing legible, came back in time."""


class BusyError(CameraControlError):
    """The camera was busy for the whole time."""


class RefusedError(CameraControlError):
    """The camera understood and declined."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class SerialPort(Protocol):
    """The part of ``serial.Serial`` in use; ``read`` must return within a few ten ms."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int = 1, /) -> bytes:
        """Up to ``size`` bytes."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Give the port back."""


def crc16(data: bytes) -> int:
    """CCITT-16 from 0."""
    return binascii.crc_hqx(data, 0)


def encode(function: int, data: bytes = b"", status: int = 0) -> bytes:
    """One packet.

    >>> encode(Function.FFC_MODE, bytes([0, 1])).hex(" ")
    '6e 00 00 0b 00 02 0f 08 00 01 10 21'
    """
    if len(data) > MAX_DATA or len(data) % 2:
        raise ValueError(f"a packet carries an even number of bytes up to {MAX_DATA}")
    packet = bytes([PROCESS_CODE, status, 0, function]) + len(data).to_bytes(2, "big")
    packet += crc16(packet).to_bytes(2, "big") + data
    return packet + crc16(packet).to_bytes(2, "big")


@dataclass(frozen=True)
class Reply:
    """A legible packet of the camera."""

    status: int
    function: int
    data: bytes


class ReplyParser:
    """Finds packets in what comes over a line; bytes that fit no packet are skipped."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped = 0

    def clear(self) -> None:
        """Forget a packet begun."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Reply]:
        """The packets that are complete now."""
        self._buffer += data
        replies = []
        while len(self._buffer) >= _HEADER:
            header = bytes(self._buffer[:_HEADER])
            count = int.from_bytes(header[4:6], "big")
            end = _HEADER + count + _TRAILER
            if header[0] != PROCESS_CODE or crc16(header) != 0 or count > MAX_DATA:
                self._skip()
            elif len(self._buffer) < end:
                break
            elif crc16(bytes(self._buffer[:end])) != 0:  # the CRC over its own value is 0
                self._skip()
            else:
                data = bytes(self._buffer[_HEADER : end - _TRAILER])
                replies.append(Reply(status=header[1], function=header[3], data=data))
                del self._buffer[:end]
        return replies

    def _skip(self) -> None:
        del self._buffer[0]
        self.skipped += 1


class CciPort:
    """Question and answer with one camera.

    A ``call`` returns or raises within ``timeout_s`` plus some ten ms, whatever the line does.
    """

    def __init__(self, port: SerialPort, *, timeout_s: float = 1.0, reply_s: float = 0.25) -> None:
        self._port = port
        self._timeout_s = timeout_s
        self._reply_s = reply_s
        self._parser = ReplyParser()
        self._unanswered = 0

    def call(
        self,
        function: Function,
        data: bytes = b"",
        *,
        repeat: bool = True,
        timeout_s: float | None = None,
    ) -> bytes:
        """Send one command and return the data of its answer.

        ``repeat``: it does no harm to send it again when no legible answer comes.  While the camera
        says that it is busy the command is repeated in any case, since it was not executed.

        Raises NoReplyError, BusyError, or RefusedError with the camera's reason.
        """
        allowed = WHITE_LIST.get(function)
        if allowed is None or not allowed.permits(data):
            raise CameraControlError(
                f"function 0x{function:02x} with '{data.hex(' ')}' is not on the white list: it "
                "will not be sent"
            )
        function = Function(function)
        deadline_s = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        if self._unanswered and not self._caught_up(deadline_s):
            raise _silence(function)
        status: Status | None = None
        while True:
            reply = self._exchange(function, data, deadline_s if not repeat else None, deadline_s)
            if reply is not None and reply.status == Status.OK:
                return reply.data
            if reply is not None and reply.status not in (
                Status.BUSY,
                Status.NOT_READY,
                Status.CHECKSUM_ERROR,
            ):
                raise _refusal(function, data, reply.status)
            if reply is not None:
                status = Status(reply.status)
            if time.monotonic() + _BUSY_PAUSE_S >= deadline_s:
                break
            if reply is not None:
                time.sleep(_BUSY_PAUSE_S)
        if status in (Status.BUSY, Status.NOT_READY):
            raise BusyError(f"the camera stays busy and does not execute {function.name}")
        if status is Status.CHECKSUM_ERROR:
            raise NoReplyError(
                f"the camera receives {function.name} damaged: check the wiring of the control port"
            )
        raise _silence(function)

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def _exchange(
        self, function: Function, data: bytes, until_s: float | None, deadline_s: float
    ) -> Reply | None:
        self._parser.clear()
        self._write(encode(function, data))
        self._unanswered += 1
        if until_s is None:
            until_s = min(deadline_s, time.monotonic() + self._reply_s)
        while time.monotonic() < until_s:
            for reply in self._parser.feed(self._read()):
                if reply.function == function:
                    self._unanswered -= 1
                    return reply
        return None

    def _caught_up(self, deadline_s: float) -> bool:
        """Let answers pass that are still to come, as after a correction that blocked the line.

        An answer does not say what was asked of a sensor: a late one would pass for the next.  The
        camera answers in order, so none is left once it has answered a NO_OP.
        """
        while time.monotonic() < deadline_s:
            if self._exchange(Function.NO_OP, b"", None, deadline_s) is not None:
                self._unanswered = 0
                return True
        return False

    def _read(self) -> bytes:
        try:
            return self._port.read(max(1, self._port.in_waiting))
        except OSError as error:
            raise CameraControlError(f"the control port has gone ({error})") from None

    def _write(self, packet: bytes) -> None:
        try:
            self._port.write(packet)
        except OSError as error:
            raise CameraControlError(f"the control port does not take data ({error})") from None


def _silence(function: Function) -> NoReplyError:
    return NoReplyError(
        f"the camera does not answer {function.name}: check power, wiring and baud rate of the "
        "control port"
    )


def _refusal(function: Function, data: bytes, status: int) -> RefusedError:
    known = {item.value: item.name.lower().replace("_", " ") for item in Status}
    reason = known.get(status, f"status 0x{status:02x}")
    sent = f" with '{data.hex(' ')}'" if data else ""
    return RefusedError(f"the camera refuses {function.name}{sent}: {reason}", status)
