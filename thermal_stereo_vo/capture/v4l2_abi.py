"""The part of Linux' video4linux2 interface that a capture needs, as ctypes.

Layouts and numbers are those of ``linux/videodev2.h`` on 64-bit machines (a test compares every one
of them with the header of the machine it runs on).
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
from ctypes import Structure, Union, c_char, c_int, c_long, c_uint8, c_uint32, c_uint64, c_ulong
from typing import Any

BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_ANY, FIELD_NONE = 0, 1
FIELD_TOP, FIELD_BOTTOM, FIELD_ALTERNATE = 2, 3, 7
FIELD_NAMES = (
    "any",
    "progressive",
    "top field only",
    "bottom field only",
    "interlaced",
    "fields one after the other, top first",
    "fields one after the other, bottom first",
    "alternating fields",
    "interlaced, top first",
    "interlaced, bottom first",
)

CAP_VIDEO_CAPTURE = 0x00000001
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000
CAP_TIMEPERFRAME = 0x1000

BUF_FLAG_ERROR = 0x0040
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000
BUF_FLAG_TSTAMP_SRC_MASK = 0x70000
BUF_FLAG_TSTAMP_SRC_SOE = 0x10000

FRMSIZE_TYPE_DISCRETE = 1

IN_ST_FAULTS = {
    0x00000001: "no power",
    0x00000002: "no signal",
    0x00000100: "no horizontal lock",
    0x00000400: "no vertical lock",
    0x00010000: "no synchronisation lock",
    0x00020000: "no equaliser lock",
    0x00040000: "no carrier",
}

STANDARDS = {"NTSC": 0x0000B000, "PAL": 0x000000FF}


class Capability(Structure):
    """``struct v4l2_capability``."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(Structure):
    """``struct v4l2_fmtdesc``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class _DiscreteSize(Structure):
    _fields_ = (("width", c_uint32), ("height", c_uint32))


class _StepwiseSize(Structure):
    _fields_ = (
        ("min_width", c_uint32),
        ("max_width", c_uint32),
        ("step_width", c_uint32),
        ("min_height", c_uint32),
        ("max_height", c_uint32),
        ("step_height", c_uint32),
    )


class _SizeUnion(Union):
    _fields_ = (("discrete", _DiscreteSize), ("stepwise", _StepwiseSize))


class FrameSizes(Structure):
    """``struct v4l2_frmsizeenum``."""

    _anonymous_ = ("sizes",)
    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("sizes", _SizeUnion),
        ("reserved", c_uint32 * 2),
    )


class PixFormat(Structure):
    """``struct v4l2_pix_format``."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class _FormatUnion(Union):
    # The kernel's union holds a pointer, which aligns it to 8 bytes.
    _fields_ = (("pix", PixFormat), ("raw", c_uint8 * 200), ("align", c_ulong))


class Format(Structure):
    """``struct v4l2_format``."""

    _anonymous_ = ("fmt",)
    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fraction(Structure):
    """``struct v4l2_fract``."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class _CaptureParameters(Structure):
    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParametersUnion(Union):
    _fields_ = (("capture", _CaptureParameters), ("raw", c_uint8 * 200))


class StreamParameters(Structure):
    """``struct v4l2_streamparm``."""

    _anonymous_ = ("parm",)
    _fields_ = (("type", c_uint32), ("parm", _ParametersUnion))


class RequestBuffers(Structure):
    """``struct v4l2_requestbuffers``."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _TimeVal(Structure):
    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class _BufferPlace(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_ulong))


class Buffer(Structure):
    """``struct v4l2_buffer``."""

    _anonymous_ = ("m",)
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", _TimeVal),
        ("timecode", c_uint32 * 4),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferPlace),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int),
    )


class Input(Structure):
    """``struct v4l2_input``."""

    _fields_ = (
        ("index", c_uint32),
        ("name", c_char * 32),
        ("type", c_uint32),
        ("audioset", c_uint32),
        ("tuner", c_uint32),
        ("std", c_uint64),
        ("status", c_uint32),
        ("capabilities", c_uint32),
        ("reserved", c_uint32 * 3),
    )


def _request(direction: int, number: int, kind: Any) -> int:
    # asm-generic/ioctl.h: direction (2 bits), size (14), type 'V' (8), number (8).
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


_WRITE, _READ = 1, 2

QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FormatDescription)
S_FMT = _request(_READ | _WRITE, 5, Format)
REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, c_int)
STREAMOFF = _request(_WRITE, 19, c_int)
G_PARM = _request(_READ | _WRITE, 21, StreamParameters)
S_PARM = _request(_READ | _WRITE, 22, StreamParameters)
G_STD = _request(_READ, 23, c_uint64)
S_STD = _request(_WRITE, 24, c_uint64)
ENUMINPUT = _request(_READ | _WRITE, 26, Input)
G_INPUT = _request(_READ, 38, c_int)
S_INPUT = _request(_READ | _WRITE, 39, c_int)
QUERYSTD = _request(_READ, 63, c_uint64)
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, FrameSizes)


def ioctl(fd: int, request: int, argument: Any) -> None:
    """One ioctl on ``fd`` that fills ``argument`` in place.  Raises OSError."""
    fcntl.ioctl(fd, request, argument, True)


def try_ioctl(fd: int, request: int, argument: Any) -> bool:
    """Like ``ioctl``; False where the driver does not know the request or the index."""
    try:
        ioctl(fd, request, argument)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY, errno.ENODATA):
            return False
        raise
    return True
