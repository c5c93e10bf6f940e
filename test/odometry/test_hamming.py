"""Nearest descriptors in windows, against a search that looks at everything."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numba import njit

from thermal_stereo_vo.odometry.feature_based.hamming import (
    CELL_PX,
    build_grid,
    match_in_windows,
    match_in_windows_reference,
    popcount,
)

seeds = st.integers(0, 2**32 - 1)
WIDTH, HEIGHT = 160, 120


@njit
def count_bits(word):
    return popcount(word)


@given(st.integers(0, 2**64 - 1))
@example(0)
@example(2**64 - 1)
@example(2**63)
def test_popcount_counts_bits(word):
    assert count_bits(np.uint64(word)) == word.bit_count()


@given(seeds, st.integers(0, 60))
def test_grid_holds_every_point_once_in_its_cell(seed, n):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (WIDTH, HEIGHT), (n, 2)).astype(np.float32)
    start, order = build_grid(pixels, WIDTH, HEIGHT)
    assert sorted(order) == list(range(n))
    columns = WIDTH // CELL_PX + 1
    for cell in range(len(start) - 1):
        for i in order[start[cell] : start[cell + 1]]:
            x, y = pixels[i]
            assert cell == int(y) // CELL_PX * columns + int(x) // CELL_PX


def test_grid_takes_points_on_the_last_pixel():
    pixels = np.array([[WIDTH - 0.01, HEIGHT - 0.01], [0.0, 0.0]], np.float32)
    start, order = build_grid(pixels, WIDTH, HEIGHT)
    assert start[-1] == 2
    assert sorted(order) == [0, 1]


def descriptors(rng, n, few_bits):
    """Random words; with ``few_bits`` only 1 bit in 16 is set, so that distances collide."""
    words = rng.integers(0, 2**64, (n, 8), dtype=np.uint64)
    if few_bits:
        for _ in range(4):
            words &= rng.integers(0, 2**64, (n, 8), dtype=np.uint64)
    return words


def search(query, bright, windows, pixels, other, other_bright, coarse_bits=128, ratio=1.0):
    grid = build_grid(pixels, WIDTH, HEIGHT)
    return match_in_windows(
        query,
        bright,
        windows,
        pixels,
        other,
        other_bright,
        *grid,
        WIDTH,
        HEIGHT,
        coarse_bits,
        ratio,
    )


@given(
    seeds, st.integers(0, 40), st.integers(0, 120), st.booleans(), st.sampled_from([4, 20, 70, 128])
)
def test_partners_are_those_of_an_exhaustive_search(seed, n, m, few_bits, coarse_bits):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (WIDTH, HEIGHT), (m, 2)).astype(np.float32)
    query, other = descriptors(rng, n, few_bits), descriptors(rng, m, few_bits)
    bright, other_bright = rng.random(n) < 0.5, rng.random(m) < 0.5
    # Windows of every size, some outside the image, some empty.
    centre = rng.uniform((-30, -30), (WIDTH + 30, HEIGHT + 30), (n, 2))
    half = rng.uniform(-3, 60, (n, 2))
    windows = np.stack(
        [centre[:, 0] - half[:, 0], centre[:, 0] + half[:, 0],
         centre[:, 1] - half[:, 1], centre[:, 1] + half[:, 1]], axis=1,
    ).astype(np.float32)  # fmt: skip
    partner, distance = search(query, bright, windows, pixels, other, other_bright, coarse_bits)
    _, expected = match_in_windows_reference(
        query, bright, windows, pixels, other, other_bright, coarse_bits
    )
    np.testing.assert_array_equal(distance, expected)
    for i in np.flatnonzero(partner >= 0):
        # Of several equally near ones any may be taken.
        j = partner[i]
        x, y = pixels[j]
        assert windows[i, 0] <= x <= windows[i, 1]
        assert windows[i, 2] <= y <= windows[i, 3]
        assert bright[i] == other_bright[j]
        assert np.unpackbits((query[i] ^ other[j]).view(np.uint8)).sum() == distance[i]
    np.testing.assert_array_equal(partner < 0, expected == 512)


def flipped(word_bits):
    """A descriptor with the given bits of the 512 set."""
    bits = np.zeros(512, np.uint8)
    bits[list(word_bits)] = 1
    return np.packbits(bits, bitorder="little").view(np.uint64)


EVERYWHERE = np.array([[0.0, WIDTH, 0.0, HEIGHT]], np.float32)


def one_against(*others, **more):
    """The zero descriptor against others at known places."""
    n = len(others)
    pixels = np.stack([10.0 + 12 * np.arange(n), np.full(n, 50.0)], axis=1).astype(np.float32)
    partner, distance = search(
        np.zeros((1, 8), np.uint64), np.array([True]), EVERYWHERE, pixels, np.array(others),
        np.ones(n, bool), **more,
    )  # fmt: skip
    return int(partner[0]), int(distance[0])


def test_the_coarse_gate_looks_at_the_first_16_bytes_only():
    coarse, fine = flipped(range(30)), flipped(range(128, 228))
    assert one_against(coarse, fine, coarse_bits=29) == (1, 100)
    assert one_against(coarse, fine, coarse_bits=30) == (0, 30)
    assert one_against(coarse, coarse_bits=29) == (-1, 512)


def test_the_ratio_compares_with_the_second_best():
    best, second = flipped(range(40)), flipped(range(128, 178))
    assert one_against(best, second, ratio=0.81) == (0, 40)
    assert one_against(second, best, ratio=0.81) == (1, 40)
    assert one_against(best, second, ratio=0.8) == (-1, 512)
    assert one_against(best, ratio=0.8) == (0, 40)


def test_the_window_includes_its_border():
    pixels = np.array([[50.0, 60.0]], np.float32)
    zero = np.zeros((1, 8), np.uint64)
    yes = np.array([True])
    for window, found in (
        ([50, 50, 60, 60], 0), ([50.1, 60, 60, 60], -1), ([40, 49.9, 0, 100], -1),
        ([0, 100, 60.1, 70], -1), ([0, 100, 50, 59.9], -1), ([60, 40, 0, 100], -1),
        ([np.nan, np.nan, 0, 100], -1),
    ):  # fmt: skip
        partner, _ = search(zero, yes, np.array([window], np.float32), pixels, zero, yes)
        assert partner[0] == found, window


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_to_match(n, m, rng):
    windows = np.tile(EVERYWHERE, (n, 1))
    partner, distance = search(
        descriptors(rng, n, False), np.ones(n, bool), windows,
        np.full((m, 2), 20, np.float32), descriptors(rng, m, False), np.ones(m, bool),
    )  # fmt: skip
    assert partner.tolist() == [-1] * n
    assert distance.tolist() == [512] * n
