"""Pyramids of linear counts: what a level shows, and where."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from thermal_stereo_vo.odometry.feature_based.image_pyramid import (
    LEVELS,
    KeyframeImages,
    build_pyramid,
)

BINOMIAL = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0


def halved(image):
    """Every other pixel of the binomial mean (Burt & Adelson 1983)."""
    for axis in (0, 1):
        image = ndimage.correlate1d(image, BINOMIAL, axis=axis, mode="mirror")
    return image[::2, ::2]


def blurred(image, sigma_px):
    reach = int(np.ceil(2.5 * sigma_px))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    for axis in (0, 1):
        image = ndimage.correlate1d(image, kernel / kernel.sum(), axis=axis, mode="mirror")
    return image


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(48, 64), (45, 61)])
@pytest.mark.parametrize("smoothing_px", [0.0, 0.8, 1.4])
def test_levels_are_binomial_means(rng, dtype, shape, smoothing_px):
    image = rng.integers(0, 250 if dtype == np.uint8 else 16000, shape).astype(dtype)
    pyramid = build_pyramid(image, smoothing_px)
    assert len(pyramid) == LEVELS
    expected = image.astype(np.float64)
    if smoothing_px > 0.0:
        expected = blurred(expected, smoothing_px)
    for level in pyramid:
        assert level.dtype == np.float32
        np.testing.assert_allclose(level, expected, rtol=2e-6, atol=1e-3)
        expected = halved(expected)


def test_a_pixel_of_level_0_lies_at_a_share_of_itself_on_the_others():
    """The centre of mass of a blob at (x, y) comes out at (x, y) / 2^level."""
    y, x = np.mgrid[:128, :160]
    centre = np.array([70.4, 57.3])
    blob = 1000.0 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 6.0**2))
    for level, image in enumerate(build_pyramid(blob, 0.8)):
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        found = np.array([np.sum(u * image), np.sum(v * image)]) / np.sum(image)
        np.testing.assert_allclose(found * 2**level, centre, atol=0.01 * 2**level)


def test_smoothing_takes_off_noise(rng):
    noise = rng.normal(8000.0, 10.0, (100, 100))
    raw = build_pyramid(noise, 0.0)[0]
    assert raw.std() == pytest.approx(10.0, rel=0.1)
    for sigma_px in (0.8, 1.4, 4.0):
        smooth = build_pyramid(noise, sigma_px)[0][10:-10, 10:-10]
        assert smooth.std() == pytest.approx(10.0 / (2 * sigma_px * np.sqrt(np.pi)), rel=0.2)
        assert smooth.mean() == pytest.approx(8000.0, abs=0.5)


@pytest.mark.parametrize("shape", [(48, 64), (45, 61)])
def test_slots_hold_copies(rng, shape):
    images = KeyframeImages(3, shape)
    pyramid = build_pyramid(rng.integers(0, 255, shape), 0.8)
    images.store(1, pyramid)
    kept = [level.copy() for level in pyramid]
    for level in pyramid:
        level[:] = -1.0
    for stack, level in zip(images.stacks, kept, strict=True):
        assert stack.shape == (3, *level.shape)
        assert stack.flags.c_contiguous
        np.testing.assert_array_equal(stack[1], level)
        assert not stack[[0, 2]].any()
