"""The detector against box filters written out, and on blobs whose place is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate

from thermal_stereo_vo.odometry.feature_based.fast_hessian import (
    FILTER_SIDES_PX,
    FastHessian,
    FastHessianConfig,
    bright_blobs,
    find_peaks,
    hessian_determinant,
    interpolate_peaks,
)

seeds = st.integers(0, 2**32 - 1)
EVERYWHERE = np.ones((1, 1), np.bool_)
TRIPLES = np.array([[0, 1, 2], [1, 2, 3], [1, 3, 4], [3, 4, 5]], dtype=np.int64)


def box_kernels(lobe):
    """Dxx, Dyy, Dxy of Bay et al. figure 2 as images of weights, each box a mean."""
    side, half = 3 * lobe, (3 * lobe) // 2
    Dyy = np.zeros((side, side))
    columns = slice(half - (lobe - 1), half + lobe)
    Dyy[:, columns] = 1.0
    Dyy[lobe : 2 * lobe, columns] = -2.0
    Dyy /= lobe * (2 * lobe - 1)
    Dxy = np.zeros((side, side))
    before, after = slice(half - lobe, half), slice(half + 1, half + 1 + lobe)
    Dxy[before, before] = Dxy[after, after] = 1.0
    Dxy[before, after] = Dxy[after, before] = -1.0
    return Dyy.T, Dyy, Dxy / lobe**2


@pytest.mark.parametrize("side", FILTER_SIDES_PX)
def test_determinant_is_that_of_the_box_filters(side, rng):
    image = rng.integers(0, 256, (83, 97)).astype(np.uint8)
    found = np.full(image.shape, np.nan, np.float32)
    hessian_determinant(cv2.integral(image), side // 3, found)
    xx, yy, xy = (
        correlate(image.astype(float), k, mode="constant") for k in box_kernels(side // 3)
    )
    expected = xx * yy - 0.81 * xy**2
    half = side // 2
    inner = np.s_[half : 83 - half, half : 97 - half]
    scale = np.abs(expected[inner]).max()
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-5 * scale)
    outside = np.ones(image.shape, bool)
    outside[inner] = False
    assert not found[outside].any()


@pytest.mark.parametrize("shape", [(8, 8), (9, 9), (10, 60), (60, 10), (51, 51), (3, 3)])
def test_images_smaller_than_the_filters_have_no_response_there(shape, rng):
    image = rng.integers(0, 256, shape).astype(np.uint8)
    for side in FILTER_SIDES_PX:
        out = np.full(shape, np.nan, np.float32)
        hessian_determinant(cv2.integral(image), side // 3, out)
        assert np.isfinite(out).all()
        if min(shape) < side:
            assert not out.any()
    points = FastHessian(FastHessianConfig()).detect(image)
    assert len(points) >= 0


def naive_peaks(responses, triples, threshold):
    """All strict maxima of 3 x 3 x 3 neighbourhoods: {(triple, y, x)}."""
    _, height, width = responses.shape
    peaks = set()
    for k, layers in enumerate(triples):
        stack = responses[layers]
        for y in range(1, height - 1):
            for x in range(1, width - 1):
                cube = stack[:, y - 1 : y + 2, x - 1 : x + 2]
                value = stack[1, y, x]
                if value > threshold and (cube < value).sum() == 26:
                    peaks.add((k, y, x))
    return peaks


@given(seeds, st.floats(0.0, 0.95))
@settings(max_examples=15)
def test_peaks_are_the_maxima_of_their_neighbourhoods(seed, threshold):
    rng = np.random.default_rng(seed)
    responses = rng.random((6, 14, 19)).astype(np.float32)
    found = find_peaks(responses, TRIPLES, np.float32(threshold), 64, 1000, EVERYWHERE)
    assert {tuple(peak) for peak in found} == naive_peaks(responses, TRIPLES, threshold)


def test_a_plateau_gives_one_peak_not_many():
    responses = np.zeros((3, 12, 12), np.float32)
    responses[1, 5:7, 5:7] = 1.0
    found = find_peaks(responses, np.array([[0, 1, 2]]), np.float32(0.5), 64, 100, EVERYWHERE)
    assert found.tolist() == [[0, 5, 5]]


@given(seeds, st.integers(1, 5))
@settings(max_examples=15)
def test_each_cell_keeps_its_strongest(seed, per_cell):
    rng = np.random.default_rng(seed)
    responses = rng.random((6, 40, 50)).astype(np.float32)
    found = find_peaks(responses, TRIPLES, np.float32(0.2), 16, per_cell, EVERYWHERE)
    everything = find_peaks(responses, TRIPLES, np.float32(0.2), 64, 10_000, EVERYWHERE)

    def value(peak):
        return responses[TRIPLES[peak[0], 1], peak[1], peak[2]]

    for row in range(3):
        for column in range(4):

            def inside(peak, row=row, column=column):
                return peak[1] // 16 == row and peak[2] // 16 == column

            kept = [value(p) for p in found if inside(p)]
            all_of_cell = sorted((value(p) for p in everything if inside(p)), reverse=True)
            assert kept == all_of_cell[:per_cell]
    cells = [(y // 16) * 4 + x // 16 for _, y, x in found]
    assert cells == sorted(cells)


def test_masked_pixels_give_no_peaks_and_free_their_place(rng):
    responses = rng.random((6, 40, 50)).astype(np.float32)
    mask = np.zeros((40, 50), bool)
    mask[:, 25:] = True
    mask.flags.writeable = False
    found = find_peaks(responses, TRIPLES, np.float32(0.2), 64, 5, mask)
    assert len(found) == 5
    assert (found[:, 2] >= 25).all()
    nowhere = np.zeros((40, 50), bool)
    nowhere.flags.writeable = False
    assert len(find_peaks(responses, TRIPLES, np.float32(0.2), 64, 5, nowhere)) == 0


@given(*[st.floats(-0.9, 0.9)] * 3, seeds)
def test_a_quadratic_peak_is_found_exactly(ox, oy, os, seed):
    """One Newton step is exact on a quadratic: place, scale and height."""
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(3, 3))
    H = -(B @ B.T + 0.5 * np.eye(3))
    responses = np.zeros((3, 5, 5), np.float32)
    for s in range(3):
        for y in range(5):
            for x in range(5):
                d = np.array([x - 2 - ox, y - 2 - oy, s - 1 - os])
                responses[s, y, x] = 10.0 + 0.5 * d @ H @ d
    sides = np.array([9.0, 15.0, 27.0], np.float32)
    pixels, size, response = interpolate_peaks(
        responses, sides, np.array([[0, 1, 2]]), np.array([[0, 2, 2]])
    )
    np.testing.assert_allclose(pixels[0], [2 + ox, 2 + oy], atol=2e-3)
    assert size[0] == pytest.approx(15.0 + (12.0 if os > 0 else 6.0) * os, abs=2e-2)
    assert response[0] == pytest.approx(10.0, abs=1e-3)


def test_a_peak_that_would_leave_its_neighbourhood_is_dropped():
    ramp = np.zeros((3, 5, 5), np.float32)
    ramp[:] = np.arange(5) - 0.05 * (np.arange(5) - 2.0) ** 2
    arguments = (
        np.array([9.0, 15.0, 27.0], np.float32),
        np.array([[0, 1, 2]]),
        np.array([[0, 2, 2]]),
    )
    assert len(interpolate_peaks(ramp, *arguments)[0]) == 0
    assert len(interpolate_peaks(np.zeros((3, 5, 5), np.float32), *arguments)[0]) == 0


def blobs(places, sigma_px, amplitude, shape=(240, 320), ground=110.0):
    """An 8-bit image with Gaussian blobs at (N, 2) sub-pixel places."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    image = np.full(shape, ground)
    for (u, v), sigma, height in zip(places, sigma_px, amplitude, strict=True):
        image += height * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / sigma**2)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def scattered_blobs(rng):
    """24 blobs, well apart, dark and bright, of scales 2.6 to 6.5 px."""
    grid = np.stack(np.meshgrid(np.arange(40, 300, 48), np.arange(40, 220, 46)), -1).reshape(-1, 2)
    places = grid + rng.uniform(-2.0, 2.0, grid.shape)
    n = len(places)
    sigma_px = rng.uniform(2.6, 6.5, n)
    amplitude = np.where(np.arange(n) % 2, 1, -1) * rng.uniform(40, 100, n)
    return places, sigma_px, amplitude


def nearest(points, places):
    """Index of the strongest point within 2 px of each place; fails when one is missing."""
    found = []
    for place in places:
        near = np.flatnonzero(np.linalg.norm(points.pixels - place, axis=1) < 2.0)
        assert len(near), f"no point at {place}"
        found.append(near[np.argmax(points.response[near])])
    return np.array(found)


def test_blobs_are_found_at_their_place_with_their_size_and_sign(rng):
    places, sigma_px, amplitude = scattered_blobs(rng)
    points = FastHessian(FastHessianConfig()).detect(blobs(places, sigma_px, amplitude))
    index = nearest(points, places)
    errors = np.linalg.norm(points.pixels[index] - places, axis=1)
    assert errors.max() < 0.35
    assert 0.005 < np.median(errors) < 0.12  # sub-pixel, and not the answer itself
    # The determinant of a Gaussian blob is largest where the side of the boxes is 5.25 sigma.
    ratio = points.size_px[index] / sigma_px
    assert np.all((ratio > 4.9) & (ratio < 5.8)), ratio
    np.testing.assert_array_equal(points.bright[index], amplitude > 0)
    assert points.pixels.dtype == points.size_px.dtype == points.response.dtype == np.float32


def test_a_shift_of_the_image_shifts_the_points(rng):
    places, sigma_px, amplitude = scattered_blobs(rng)
    detector = FastHessian(FastHessianConfig())
    here = detector.detect(blobs(places, sigma_px, amplitude))
    there = detector.detect(blobs(places + np.array([0.5, -0.25]), sigma_px, amplitude))
    shift = there.pixels[nearest(there, places)] - here.pixels[nearest(here, places)]
    np.testing.assert_allclose(np.median(shift, axis=0), [0.5, -0.25], atol=0.06)


def test_x_and_y_are_treated_alike(rng):
    places, sigma_px, amplitude = scattered_blobs(rng)
    image = blobs(places, sigma_px, amplitude)
    detector = FastHessian(FastHessianConfig())
    plain, turned = detector.detect(image), detector.detect(np.ascontiguousarray(image.T))
    a = plain.pixels[nearest(plain, places)]
    b = turned.pixels[nearest(turned, places[:, ::-1])]
    np.testing.assert_allclose(a, b[:, ::-1], atol=1e-3)


def texture(rng, shape=(240, 320)):
    noise = rng.integers(0, 256, (shape[0] // 4, shape[1] // 4)).astype(np.uint8)
    return cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)


def test_contrast_scales_the_response_by_its_square(rng):
    """The threshold is in grey levels squared: half the contrast, a quarter of the response."""
    places, sigma_px, _ = scattered_blobs(rng)
    strong = FastHessian(FastHessianConfig()).detect(blobs(places, sigma_px, [100.0] * len(places)))
    weak = FastHessian(FastHessianConfig()).detect(blobs(places, sigma_px, [50.0] * len(places)))
    ratio = strong.response[nearest(strong, places)] / weak.response[nearest(weak, places)]
    assert np.median(ratio) == pytest.approx(4.0, rel=0.05)


def test_faint_parts_of_the_image_get_their_share(rng):
    """One global threshold would put all points on the contrasty half."""
    image = texture(rng).astype(float)
    image[:, 160:] = 110 + (image[:, 160:] - 110) * 0.15
    points = FastHessian(FastHessianConfig(features=200)).detect(image.astype(np.uint8))
    on_the_faint_half = np.mean(points.pixels[:, 0] >= 160)
    assert 0.35 < on_the_faint_half < 0.6
    strongest = np.argsort(points.response)[-len(points) // 2 :]
    assert np.mean(points.pixels[strongest, 0] >= 160) < 0.05


@pytest.mark.parametrize("features", [50, 200, 1000])
def test_about_as_many_points_as_asked_for(features, rng):
    found = len(FastHessian(FastHessianConfig(features=features)).detect(texture(rng)))
    cells = 4 * 5
    assert 0.5 * features <= found <= features + cells


@pytest.mark.parametrize("level", [0, 127, 255])
def test_an_even_image_has_no_points(level):
    image = np.full((240, 320), level, np.uint8)
    points = FastHessian(FastHessianConfig()).detect(image)
    assert len(points) == 0
    assert points.pixels.shape == (0, 2)


def test_masked_image_parts_have_no_points(rng):
    mask = np.zeros((240, 320), bool)
    mask[50:150, 100:250] = True
    mask.flags.writeable = False
    points = FastHessian(FastHessianConfig()).detect(texture(rng), mask)
    x, y = points.pixels.T
    assert len(points) > 50
    # Interpolation may carry a point up to one pixel beyond.
    assert x.min() > 98
    assert x.max() < 251
    assert y.min() > 48
    assert y.max() < 151


def test_the_detector_remembers_nothing_of_earlier_images(rng):
    """Work arrays are reused; sizes may change in between."""
    a, b = texture(rng), texture(rng, (200, 400))
    fresh = FastHessian(FastHessianConfig()).detect(a)
    detector = FastHessian(FastHessianConfig())
    detector.detect(b)
    detector.detect(texture(rng))
    again = detector.detect(a)
    for name in ("pixels", "size_px", "response", "bright"):
        assert np.array_equal(getattr(fresh, name), getattr(again, name))


def test_the_image_is_not_changed(rng):
    image = texture(rng)
    before = image.copy()
    image.flags.writeable = False
    FastHessian(FastHessianConfig()).detect(image)
    assert np.array_equal(image, before)


def test_brightness_of_blobs_up_to_the_border():
    places = np.array([[4.0, 4.0], [60.0, 40.0], [119.0, 79.0]])
    for sign in (1, -1):
        image = blobs(places, [2.0] * 3, [80.0 * sign] * 3, (80, 120))
        bright = bright_blobs(
            cv2.integral(image), places.astype(np.float32), np.full(3, 15.0, np.float32)
        )
        assert bright[:2].tolist() == [sign > 0] * 2
