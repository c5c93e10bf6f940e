"""Pixels of ROS image messages: nothing lost, nothing guessed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.image_encoding import decode_pixels


def padded(image: np.ndarray, padding: int) -> tuple[int, bytes]:
    """(step, bytes) of an image whose rows are followed by rubbish."""
    rows = image.reshape(len(image), -1).view(np.uint8).reshape(len(image), -1)
    rubbish = np.full((len(image), padding), 0xAB, np.uint8)
    return rows.shape[1] + padding, np.hstack([rows, rubbish]).tobytes()


@given(
    image=arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 11))),
    padding=st.integers(0, 7),
    big=st.booleans(),
    encoding=st.sampled_from(["mono16", "16UC1"]),
)
def test_sixteen_bit_any_byte_order_any_step(image, padding, big, encoding):
    wire = image.astype(">u2" if big else "<u2")
    step, data = padded(np.ascontiguousarray(wire), padding)
    got = decode_pixels(encoding, *image.shape, step, big, data, "left")
    assert got.dtype == np.uint16
    assert got.dtype.isnative
    assert np.array_equal(got, image)


@given(
    image=arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 11))),
    padding=st.integers(0, 7),
    big=st.booleans(),
)
def test_eight_bit_has_no_byte_order(image, padding, big):
    step, data = padded(image, padding)
    assert np.array_equal(decode_pixels("mono8", *image.shape, step, big, data, "left"), image)


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("rgba8", (0, 1, 2)), ("bgra8", (2, 1, 0))],
)
def test_colour_order_is_heeded(encoding, order, rng):
    image = rng.integers(0, 256, (6, 7, 4 if "a8" in encoding else 3), dtype=np.uint8)
    step, data = padded(image, 5)
    got = decode_pixels(encoding, 6, 7, step, False, data, "left")
    red, green, blue = (image[..., i].astype(float) for i in order)
    assert np.abs(got - (0.299 * red + 0.587 * green + 0.114 * blue)).max() <= 1.0


def test_last_row_may_lack_its_padding(rng):
    image = rng.integers(0, 256, (4, 5), dtype=np.uint8)
    step, data = padded(image, 3)
    assert np.array_equal(decode_pixels("mono8", 4, 5, step, False, data[:-3], "left"), image)


def test_result_does_not_share_the_message(rng):
    data = bytearray(rng.integers(0, 256, 20, dtype=np.uint8).tobytes())
    got = decode_pixels("mono8", 4, 5, 5, False, data, "left").copy()
    again = decode_pixels("mono8", 4, 5, 5, False, data, "left")
    data[:] = bytes(20)
    assert np.array_equal(again, got)
    assert again.flags.writeable


@pytest.mark.parametrize("encoding", ["rgb16", "bayer_rggb8", "32FC1", "yuv422", ""])
def test_encodings_without_a_grey_value_are_refused(encoding):
    with pytest.raises(FrameError, match=f"'{encoding}', which cannot be read as grey"):
        decode_pixels(encoding, 4, 5, 10, False, bytes(40), "/left")


@pytest.mark.parametrize(
    ("height", "width", "step", "size"), [(4, 5, 5, 15), (4, 5, 4, 20), (0, 5, 5, 0), (4, 0, 0, 0)]
)
def test_data_that_does_not_fit_is_refused(height, width, step, size):
    with pytest.raises(FrameError, match=rf"says {width}x{height} pixels of mono8 .* {size} bytes"):
        decode_pixels("mono8", height, width, step, False, bytes(size), "/left")


def test_grey_agrees_with_opencv_for_plain_colour(rng):
    image = rng.integers(0, 256, (6, 7, 3), dtype=np.uint8)
    got = decode_pixels("8UC3", 6, 7, 21, False, image.tobytes(), "left")
    assert np.array_equal(got, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
