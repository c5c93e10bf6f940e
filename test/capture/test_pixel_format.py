"""Bytes to counts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.capture.pixel_format import (
    BIG_ENDIAN,
    PIXEL_FORMATS,
    fourcc,
    fourcc_name,
)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
@given(width=st.integers(1, 9), height=st.integers(1, 5), padding=st.integers(0, 7), data=st.data())
def test_each_sample_is_read_from_its_place(name, width, height, padding, data):
    pixel_format = PIXEL_FORMATS[name]
    line = width * pixel_format.step + padding
    raw = data.draw(st.binary(min_size=height * line, max_size=height * line))
    image = pixel_format.decode(memoryview(raw), width, height, line)
    assert image.shape == (height, width)
    assert image.dtype.isnative
    assert image.dtype == (np.uint8 if pixel_format.bits == 8 else np.uint16)
    for y in range(height):
        for x in range(width):
            at = y * line + x * pixel_format.step
            if pixel_format.bits > 8:
                order = "big" if name == "Y16-BE" else "little"
                expected = int.from_bytes(raw[at : at + 2], order)
            else:
                expected = raw[at + 1] if name == "UYVY" else raw[at]
            assert image[y, x] == expected


def test_the_last_line_needs_no_padding():
    grey = PIXEL_FORMATS["GREY"]
    assert grey.bytes_needed(4, 3, 10) == 24
    assert grey.decode(bytes(24), 4, 3, 10).shape == (3, 4)
    with pytest.raises((TypeError, ValueError)):
        grey.decode(bytes(23), 4, 3, 10)


def test_names_of_codes():
    assert fourcc("Y16") == 0x20363159
    assert fourcc_name(fourcc("Y16") | BIG_ENDIAN) == "Y16-BE"
    assert fourcc_name(fourcc("YUYV")) == "YUYV"
    assert fourcc_name(0x07) == "0x00000007"


def test_the_format_with_the_most_bits_comes_first():
    bits = [pixel_format.bits for pixel_format in PIXEL_FORMATS.values()]
    assert bits == sorted(bits, reverse=True)
