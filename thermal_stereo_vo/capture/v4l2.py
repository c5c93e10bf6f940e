"""Memory-mapped streaming from a V4L2 device."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import select
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from thermal_stereo_vo.capture import v4l2_abi as abi
from thermal_stereo_vo.capture.negotiation import input_fault, negotiate
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.core.errors import CaptureError


class StampKind(Enum):
    """What the driver's stamp of a buffer means."""

    START_OF_FRAME = "start of frame"
    END_OF_FRAME = "end of frame"
    UNKNOWN_CLOCK = "unknown clock"


class GrabFault(Enum):
    """Why a buffer is not an image: the driver flags it, or bytes are missing."""

    DAMAGED = "damaged"
    SHORT = "short"


@dataclass(frozen=True)
class Grab:
    """One buffer, copied out.

    ``image`` is (H, W) uint16 or uint8, or None with the reason in ``fault``.  ``sequence`` is the
    driver's 32-bit count.  ``driver_ns`` is the driver's stamp and ``arrival_ns`` the moment the
    buffer was fetched, both on CLOCK_MONOTONIC (the first only if ``stamp_kind`` says so).
    """

    image: NDArray[Any] | None
    sequence: int
    driver_ns: int
    stamp_kind: StampKind
    arrival_ns: int
    fault: GrabFault | None = None


class V4l2Stream:
    """A streaming device; ``close`` (or leaving ``with``) gives everything back.

    Raises CaptureError when the device is absent, busy, or cannot deliver what ``config`` asks.
    """

    def __init__(self, path: str, config: StreamConfig) -> None:
        self._path = path
        self._maps: list[mmap.mmap] = []
        self._views: list[memoryview] = []
        self._poll_failed = False
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise device_error(path, error) from None
        try:
            self.format = negotiate(self._fd, path, config)
            self._map_buffers(config.buffers)
            abi.ioctl(self._fd, abi.STREAMON, ctypes.c_int(abi.BUF_TYPE_VIDEO_CAPTURE))
        except OSError as error:
            self.close()
            raise device_error(path, error) from None
        except BaseException:
            self.close()
            raise
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def __enter__(self) -> V4l2Stream:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def wait(self, timeout_s: float) -> bool:
        """Whether ``take`` has something to say within ``timeout_s``."""
        events = self._poll.poll(timeout_s * 1e3)
        self._poll_failed = bool(events) and not events[0][1] & select.POLLIN
        return bool(events)

    def take(self) -> Grab | None:
        """The oldest filled buffer, or None if there is none.

        Raises CaptureError when the device has gone or reports a fatal error.
        """
        try:
            with self._dequeued() as buffer:
                return self._copied(buffer, time.monotonic_ns())
        except BlockingIOError:
            if self._poll_failed:
                raise CaptureError(
                    f"{self._path} reports an error instead of frames: opening it anew may help"
                ) from None
            return None
        except OSError as error:
            raise device_error(self._path, error) from None

    def input_fault(self) -> str | None:
        """What the driver says is wrong at the input (``no signal``), or None."""
        try:
            return input_fault(self._fd)
        except OSError as error:
            raise device_error(self._path, error) from None

    def close(self) -> None:
        """Stop and give the device back; may be called again, also after an unplug."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        with suppress(OSError):
            abi.ioctl(fd, abi.STREAMOFF, ctypes.c_int(abi.BUF_TYPE_VIDEO_CAPTURE))
        # A map holds its own duplicate of the descriptor: one forgotten keeps the device busy.
        for view in self._views:
            view.release()
        for mapping in self._maps:
            mapping.close()
        self._views, self._maps = [], []
        with suppress(OSError):
            abi.ioctl(fd, abi.REQBUFS, self._buffer_request(0))
        with suppress(OSError):
            os.close(fd)

    def _map_buffers(self, count: int) -> None:
        request = self._buffer_request(count)
        abi.ioctl(self._fd, abi.REQBUFS, request)
        if request.count < 2:
            raise CaptureError(
                f"{self._path} has memory for {request.count} buffers of {count} asked: a stream "
                "needs 2; close other programs that capture video"
            )
        for index in range(request.count):
            buffer = self._buffer(index)
            abi.ioctl(self._fd, abi.QUERYBUF, buffer)
            mapping = mmap.mmap(self._fd, buffer.length, offset=buffer.offset)
            self._maps.append(mapping)
            self._views.append(memoryview(mapping))
            abi.ioctl(self._fd, abi.QBUF, buffer)

    @contextmanager
    def _dequeued(self) -> Iterator[abi.Buffer]:
        buffer = self._buffer()
        abi.ioctl(self._fd, abi.DQBUF, buffer)
        try:
            yield buffer
        finally:
            abi.ioctl(self._fd, abi.QBUF, buffer)

    def _copied(self, buffer: abi.Buffer, arrival_ns: int) -> Grab:
        layout = self.format
        needed = layout.pixel_format.bytes_needed(
            layout.width, layout.height, layout.bytes_per_line
        )
        image, fault = None, None
        if buffer.flags & abi.BUF_FLAG_ERROR:
            fault = GrabFault.DAMAGED
        elif buffer.bytesused < needed:
            fault = GrabFault.SHORT
        else:
            image = layout.pixel_format.decode(
                self._views[buffer.index], layout.width, layout.height, layout.bytes_per_line
            )
        stamp = buffer.timestamp
        return Grab(
            image=image,
            sequence=buffer.sequence,
            driver_ns=stamp.tv_sec * 1_000_000_000 + stamp.tv_usec * 1_000,
            stamp_kind=_stamp_kind(buffer.flags),
            arrival_ns=arrival_ns,
            fault=fault,
        )

    @staticmethod
    def _buffer(index: int = 0) -> abi.Buffer:
        return abi.Buffer(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)

    @staticmethod
    def _buffer_request(count: int) -> abi.RequestBuffers:
        return abi.RequestBuffers(
            count=count, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP
        )


def _stamp_kind(flags: int) -> StampKind:
    if flags & abi.BUF_FLAG_TIMESTAMP_MASK != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
        return StampKind.UNKNOWN_CLOCK
    if flags & abi.BUF_FLAG_TSTAMP_SRC_MASK == abi.BUF_FLAG_TSTAMP_SRC_SOE:
        return StampKind.START_OF_FRAME
    return StampKind.END_OF_FRAME


_WHAT_TO_DO = {
    errno.ENOENT: "is not there: check cable, power and the udev name",
    errno.ENXIO: "is not there: check cable, power and the udev name",
    errno.ENODEV: "has been unplugged: check cable and power",
    errno.EACCES: "may not be opened: add this user to the group 'video'",
    errno.EPERM: "may not be opened: add this user to the group 'video'",
    errno.EBUSY: "is in use by another program: stop it first ('fuser -v' names it)",
    errno.EIO: "reports a fatal error of its stream",
    errno.ENOSPC: "gets no bandwidth on its USB bus: use another port or a narrower format",
}


def device_error(path: str, error: OSError) -> CaptureError:
    """The operating system's error as a sentence about the device."""
    text = _WHAT_TO_DO.get(error.errno or 0)
    reason = (error.strerror or str(error)).lower()
    return CaptureError(f"{path} {text} ({reason})" if text else f"{path}: {reason}")
