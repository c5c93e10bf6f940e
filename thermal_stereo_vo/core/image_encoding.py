"""Pixels of ``sensor_msgs/Image``: encodings, byte order and row padding, without ROS."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.frames import Image


@dataclass(frozen=True)
class Encoding:
    """Type of one value, values per pixel, and OpenCV's conversion to grey where it is colour."""

    dtype: type[np.uint8] | type[np.uint16]
    channels: int = 1
    to_grey: int | None = None


ENCODINGS = {
    "mono8": Encoding(np.uint8),
    "8UC1": Encoding(np.uint8),
    "mono16": Encoding(np.uint16),
    "16UC1": Encoding(np.uint16),
    "rgb8": Encoding(np.uint8, 3, cv2.COLOR_RGB2GRAY),
    "bgr8": Encoding(np.uint8, 3, cv2.COLOR_BGR2GRAY),
    "rgba8": Encoding(np.uint8, 4, cv2.COLOR_RGBA2GRAY),
    "bgra8": Encoding(np.uint8, 4, cv2.COLOR_BGRA2GRAY),
    "8UC3": Encoding(np.uint8, 3, cv2.COLOR_BGR2GRAY),
}


def decode_pixels(
    encoding: str,
    height: int,
    width: int,
    step: int,
    is_bigendian: bool,
    data: NDArray[np.uint8] | bytes,
    origin: str,
) -> Image:
    """(H, W) uint8 or uint16 in this machine's byte order; 8-bit colour becomes grey.

    ``step`` is the bytes of a row with its padding.  The result owns its memory.  ``origin`` names
    the topic or camera in messages.

    Raises FrameError for an encoding that has no linear grey value (16-bit colour, Bayer, float)
    and for data that does not fit the size.
    """
    known = ENCODINGS.get(encoding)
    if known is None:
        raise FrameError(
            f"images of {origin} have the encoding '{encoding}', which cannot be read as grey "
            f"counts: record one of {', '.join(ENCODINGS)}"
        )
    wire = np.dtype(known.dtype)
    if bool(is_bigendian) != (sys.byteorder == "big"):
        wire = wire.newbyteorder("S")
    row_bytes = width * known.channels * wire.itemsize
    values = np.frombuffer(data, dtype=np.uint8)
    if height < 1 or width < 1 or step < row_bytes or len(values) < (height - 1) * step + row_bytes:
        raise FrameError(
            f"an image of {origin} says {width}x{height} pixels of {encoding} with {step} bytes a "
            f"row, but brings {len(values)} bytes: the publisher fills the message wrongly"
        )
    if len(values) < height * step:  # the last row may come without its padding
        values = np.concatenate([values, np.zeros(height * step - len(values), np.uint8)])
    rows = values[: height * step].reshape(height, step)[:, :row_bytes]
    pixels: NDArray[Any] = np.ascontiguousarray(rows).view(wire).astype(known.dtype)
    if known.to_grey is not None:
        grey: Image = cv2.cvtColor(pixels.reshape(height, width, known.channels), known.to_grey)
        return grey
    return pixels
