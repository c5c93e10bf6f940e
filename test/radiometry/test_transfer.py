from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.radiometry import transfer


def histogram_of(values: np.ndarray) -> np.ndarray:
    return np.bincount(values.astype(np.int64), minlength=transfer.COUNTS)


def plateau(histogram, cap=150.0, tail=0.005, gain=4.0, middle=127.0):
    curve = np.empty(transfer.COUNTS, np.float32)
    transfer.plateau_curve(histogram, cap, tail, gain, middle, curve)
    return curve


def linear(histogram, tail=0.005, gain=4.0, middle=127.0):
    curve = np.empty(transfer.COUNTS, np.float32)
    transfer.linear_curve(histogram, tail, gain, middle, curve)
    return curve


histograms = st.lists(
    st.tuples(st.integers(0, transfer.COUNTS - 1), st.integers(1, 3000)), min_size=1, max_size=40
)


def build(pairs: list[tuple[int, int]]) -> np.ndarray:
    histogram = np.zeros(transfer.COUNTS, np.int64)
    for count, pixels in pairs:
        histogram[count] += pixels
    return histogram


@settings(max_examples=40, deadline=None)
@given(
    pairs=histograms,
    cap=st.floats(1, 1000),
    tail=st.floats(0, 0.25),
    gain=st.floats(0.01, 255),
    middle=st.floats(0, 255),
)
def test_curves_equal_their_numpy_twins(pairs, cap, tail, gain, middle):
    histogram = build(pairs)
    np.testing.assert_allclose(
        plateau(histogram, cap, tail, gain, middle),
        transfer.plateau_reference(histogram, cap, tail, gain, middle),
        atol=2e-3,
    )
    np.testing.assert_allclose(
        linear(histogram, tail, gain, middle),
        transfer.linear_reference(histogram, tail, gain, middle),
        atol=2e-3,
    )
    assert transfer.tails(histogram, tail) == transfer.tails_reference(histogram, tail)


@settings(max_examples=40, deadline=None)
@given(pairs=histograms, cap=st.floats(1, 1000), gain=st.floats(0.01, 255))
def test_a_curve_never_falls_and_stays_within_grey_levels(pairs, cap, gain):
    histogram = build(pairs)
    for curve in (plateau(histogram, cap, gain=gain), linear(histogram, gain=gain)):
        assert np.diff(curve).min() >= 0
        assert curve.min() >= 0
        assert curve.max() <= 255


def test_no_occupied_step_is_steeper_than_the_gain_allows(rng):
    values = np.clip(rng.normal(8000, 6, 40_000), 0, 65535)
    for gain in (0.5, 2.0, 4.0):
        inner = slice(7990, 8010)
        for curve in (
            plateau(histogram_of(values), gain=gain),
            linear(histogram_of(values), gain=gain),
        ):
            steepest = np.diff(curve[inner]).max()
            assert 0.5 * gain < steepest <= gain * 1.001


def test_one_value_lies_at_the_midpoint():
    histogram = build([(5000, 10_000)])
    assert plateau(histogram)[5000] == pytest.approx(127.0, abs=0.01)
    assert linear(histogram)[5000] == pytest.approx(127.0, abs=0.01)


def test_a_linear_curve_spans_the_range_between_the_tails(rng):
    values = rng.integers(8000, 9000, 50_000)
    curve = linear(histogram_of(values), tail=0.01)
    low, high = transfer.tails(histogram_of(values), 0.01)
    assert curve[low] == pytest.approx(0.0, abs=1.0)
    assert curve[high] == pytest.approx(254.0, abs=1.0)
    slope = np.diff(curve[low + 3 : high - 3])
    np.testing.assert_allclose(slope, 255.0 / (high - low), rtol=0.02)


def test_tails_are_rejected_on_both_sides():
    histogram = build([(100, 4), (8000, 500), (8001, 492), (60_000, 4)])
    assert transfer.tails(histogram, 0.005) == (8000, 8001)
    assert transfer.tails(histogram, 0.0) == (100, 60_000)


def test_a_low_plateau_gives_a_hot_spot_fewer_levels_than_full_equalisation(rng):
    """Nine tenths sky in a few counts, one tenth ground over many."""
    sky = rng.integers(1000, 1020, 90_000)
    ground = rng.integers(2000, 2400, 10_000)
    histogram = histogram_of(np.concatenate([sky, ground]))
    capped = plateau(histogram, cap=20.0, gain=255.0, tail=0.0)
    full = plateau(histogram, cap=1e6, gain=255.0, tail=0.0)
    levels = [curve[2399] - curve[2000] for curve in (capped, full)]
    assert levels[0] > 150
    assert levels[1] < 40


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_histogram_and_application_equal_their_numpy_twins(rng, dtype, step):
    image = rng.integers(0, 250, (37, 53)).astype(dtype)
    if dtype == np.float32:
        image += rng.random(image.shape).astype(np.float32)
        image[3, 4], image[5, 6], image[7, 8] = np.nan, np.inf, -np.inf
    roi = rng.random(image.shape) > 0.3
    mask = rng.random(image.shape) > 0.2
    found = np.zeros(transfer.COUNTS, np.int64)
    added = transfer.add_to_histogram(image, roi, mask, step, found)
    np.testing.assert_array_equal(found, transfer.histogram_reference(image, roi, mask, step))
    assert added == found.sum() > 0

    curve = np.linspace(0, 255, transfer.COUNTS).astype(np.float32) ** 0.9
    shown = np.empty(image.shape, np.uint8)
    transfer.apply_curve(image, curve, shown)
    np.testing.assert_array_equal(shown, transfer.apply_reference(image, curve))


def test_saturated_fraction_counts_both_ends():
    histogram = build([(10, 100), (500, 700), (900, 200)])
    curve = np.clip((np.arange(transfer.COUNTS) - 100) * 0.5, 0, 255).astype(np.float32)
    assert transfer.saturated_fraction(histogram, curve) == pytest.approx(0.3)
    assert transfer.saturated_fraction(np.zeros_like(histogram), curve) == 0.0
