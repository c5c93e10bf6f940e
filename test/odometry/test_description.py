"""FREAK descriptors: which point each belongs to, and what they are invariant to."""

from __future__ import annotations

import cv2
import numpy as np

from thermal_stereo_vo.odometry.feature_based.description import (
    WORDS,
    DescriptionConfig,
    FreakDescriber,
)
from thermal_stereo_vo.odometry.feature_based.fast_hessian import InterestPoints


def texture(rng, side=300):
    noise = rng.integers(0, 256, (side // 6, side // 6)).astype(np.uint8)
    return cv2.GaussianBlur(
        cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC), None, 1.5
    )


def points_at(pixels, size_px=18.0) -> InterestPoints:
    pixels = np.asarray(pixels, np.float32).reshape(-1, 2)
    n = len(pixels)
    return InterestPoints(
        pixels,
        np.full(n, size_px, np.float32),
        np.arange(n, dtype=np.float32),
        np.arange(n) % 2 == 0,
    )


def bits(a, b):
    """Hamming distance of two descriptors."""
    return int(np.unpackbits((a ^ b).view(np.uint8)).sum())


def test_points_near_the_border_are_dropped_and_all_else_stays_together(rng):
    points = points_at([[150, 150], [1, 1], [100, 200], [299, 150], [200, 100]])
    features = FreakDescriber(DescriptionConfig()).describe(texture(rng), points)
    kept = features.response.astype(int)
    assert kept.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(features.pixels, points.pixels[kept])
    np.testing.assert_array_equal(features.bright, points.bright[kept])
    assert features.descriptors.shape == (3, WORDS)
    assert features.descriptors.dtype == np.uint64
    assert len(features) == 3


def test_words_are_opencvs_bytes_in_order(rng):
    """The first two words must be the first 16 bytes, the coarsest comparisons."""
    image = texture(rng)
    features = FreakDescriber(DescriptionConfig()).describe(image, points_at([[150, 140]]))
    freak = cv2.xfeatures2d.FREAK_create(False, True, 22.0, 4)
    _, expected = freak.compute(image, [cv2.KeyPoint(150, 140, 18)])
    np.testing.assert_array_equal(features.descriptors.view(np.uint8), expected)
    assert features.descriptors[:, :2].tobytes() == expected[:, :16].tobytes()


def test_no_points_no_features(rng):
    features = FreakDescriber(DescriptionConfig()).describe(texture(rng), points_at([]))
    assert len(features) == 0
    assert features.descriptors.shape == (0, WORDS)
    assert features.pixels.shape == (0, 2)
    only_border = FreakDescriber(DescriptionConfig()).describe(texture(rng), points_at([[0, 0]]))
    assert len(only_border) == 0


def rotated(image, angle_deg):
    """The image and the (2, 3) map, turned about its centre."""
    M = cv2.getRotationMatrix2D((149.5, 149.5), angle_deg, 1.0)
    return cv2.warpAffine(image, M, (300, 300), flags=cv2.INTER_LINEAR), M


def distances_after_turn(rng, angle_deg, rotation_invariant):
    image = texture(rng)
    turned, M = rotated(image, angle_deg)
    pixels = rng.uniform(110, 190, (40, 2))
    moved = pixels @ M[:, :2].T + M[:, 2]
    describer = FreakDescriber(DescriptionConfig(rotation_invariant=rotation_invariant))
    a = describer.describe(image, points_at(pixels))
    b = describer.describe(turned, points_at(moved))
    assert len(a) == len(b) == 40
    same = [bits(x, y) for x, y in zip(a.descriptors, b.descriptors, strict=True)]
    other = [
        bits(x, y) for x, y in zip(a.descriptors, np.roll(b.descriptors, 7, axis=0), strict=True)
    ]
    return np.median(same), np.median(other)


def test_upright_descriptors_bear_a_small_turn_and_no_large_one(rng):
    same, other = distances_after_turn(rng, 5.0, rotation_invariant=False)
    assert 0 < same < 0.5 * other
    same, other = distances_after_turn(rng, 60.0, rotation_invariant=False)
    assert same > 0.8 * other


def test_turned_descriptors_bear_any_turn(rng):
    same, other = distances_after_turn(rng, 60.0, rotation_invariant=True)
    assert 0 < same < 0.6 * other


def test_contrast_and_brightness_do_not_matter(rng):
    """Comparisons only: an 8-bit view that is a bit brighter gives the same bits."""
    image = (0.5 * texture(rng)).astype(np.uint8)
    describer = FreakDescriber(DescriptionConfig())
    points = points_at(np.random.default_rng(0).uniform(80, 220, (30, 2)))
    a, b = (describer.describe(i, points) for i in (image, image + np.uint8(60)))
    assert np.array_equal(a.descriptors, b.descriptors)


def test_pattern_scale_is_heeded(rng):
    image = texture(rng)
    points = points_at([[150, 150], [120, 170]])
    small, large = (
        FreakDescriber(DescriptionConfig(pattern_scale=s)).describe(image, points)
        for s in (12.0, 40.0)
    )
    assert not np.array_equal(small.descriptors, large.descriptors)
