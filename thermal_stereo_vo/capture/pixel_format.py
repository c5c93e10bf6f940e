"""How the bytes of a video buffer become an image of counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BIG_ENDIAN = 1 << 31


def fourcc(text: str) -> int:
    """The kernel's number of a four-letter code."""
    return int.from_bytes(text.ljust(4).encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    """``Y16``, ``Y16-BE``, ``YUYV``; hexadecimal where the code is not printable."""
    text = (code & ~BIG_ENDIAN).to_bytes(4, "little").decode("latin-1")
    if not (text.isascii() and text.isprintable()):
        return f"0x{code:08x}"
    return text.rstrip() + ("-BE" if code & BIG_ENDIAN else "")


@dataclass(frozen=True)
class PixelFormat:
    """One sample a pixel somewhere in the buffer.

    ``step`` is the distance of two pixels and ``offset`` the place of the sample within one, in
    bytes; ``bits`` counts the bits in use.
    """

    name: str
    code: int
    dtype: str
    step: int
    bits: int
    offset: int = 0

    def bytes_needed(self, width: int, height: int, bytes_per_line: int) -> int:
        """Bytes that hold all pixels; the last line may lack its padding."""
        return (height - 1) * bytes_per_line + width * self.step

    def decode(
        self, data: memoryview | bytes, width: int, height: int, bytes_per_line: int
    ) -> NDArray[Any]:
        """A copy of the samples: (H, W) uint16 or uint8 in the byte order of the machine."""
        samples: NDArray[Any] = np.ndarray(
            (height, width), self.dtype, data, self.offset, (bytes_per_line, self.step)
        )
        return samples.astype(samples.dtype.newbyteorder("="), order="C", copy=True)


# In order of preference: the most bits first; then the formats without colour to throw away.
PIXEL_FORMATS = {
    pixel_format.name: pixel_format
    for pixel_format in (
        PixelFormat("Y16", fourcc("Y16"), "<u2", 2, 16),
        PixelFormat("Y16-BE", fourcc("Y16") | BIG_ENDIAN, ">u2", 2, 16),
        PixelFormat("Y14", fourcc("Y14"), "<u2", 2, 14),
        PixelFormat("Y12", fourcc("Y12"), "<u2", 2, 12),
        PixelFormat("Y10", fourcc("Y10"), "<u2", 2, 10),
        PixelFormat("GREY", fourcc("GREY"), "u1", 1, 8),
        PixelFormat("YUYV", fourcc("YUYV"), "u1", 2, 8),
        PixelFormat("UYVY", fourcc("UYVY"), "u1", 2, 8, offset=1),
    )
}
