"""Patches found again to a small part of a pixel, whatever gain and offset have become."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from thermal_stereo_vo.odometry.feature_based.image_pyramid import LEVELS, build_pyramid
from thermal_stereo_vo.odometry.feature_based.patch_alignment import (
    _sample_square,
    _sample_template,
    align_patches,
    correlation_reference,
    search_disparity,
    search_disparity_reference,
)

SHAPE = (120, 160)
RADIUS = 5
CONTRAST = 40.0


class Scene:
    """A smooth texture that is known between the pixels too, as a sum of waves."""

    def __init__(self, rng, waves=60):
        angle, length_px = rng.uniform(0, 2 * np.pi, waves), rng.uniform(7.0, 40.0, waves)
        self._k = 2 * np.pi / length_px * np.array([np.cos(angle), np.sin(angle)])
        self._phase = rng.uniform(0, 2 * np.pi, waves)

    def image(self, shift=(0.0, 0.0), warp=None, centre=(80.0, 60.0), shape=SHAPE):
        """Pixel x shows what is at ``centre + warp^-1 (x - centre - shift)``."""
        y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
        offset = np.stack([x - centre[0] - shift[0], y - centre[1] - shift[1]])
        inverse = np.eye(2) if warp is None else np.linalg.inv(warp)
        at = np.tensordot(inverse, offset, 1) + np.array(centre)[:, None, None]
        waves = np.sin(np.tensordot(self._k.T, at, 1) + self._phase[:, None, None])
        return 1000.0 + CONTRAST * waves.sum(axis=0) * np.sqrt(2.0 / len(self._phase))


def stack(image, smoothing_px=0.8):
    """Pyramid of one keyframe, as the kernel takes it."""
    return tuple(level[None] for level in build_pyramid(image, smoothing_px))


def centres(step=12, margin=30):
    x, y = np.meshgrid(*(np.arange(margin, size - margin, step) for size in SHAPE[::-1]))
    return np.column_stack([x.ravel(), y.ravel()]).astype(float)


def align(keyframe, image, host_px, start_px, warp=None, top_level=LEVELS - 1, iterations=15):
    n = len(host_px)
    warps = np.tile(np.eye(2) if warp is None else np.asarray(warp, float), (n, 1, 1))
    px, score = np.empty((n, 2)), np.empty(n)
    align_patches(
        stack(keyframe), build_pyramid(image, 0.8), np.zeros(n, np.int64), host_px, warps,
        np.array(start_px, float), top_level, RADIUS, iterations, px, score,
    )  # fmt: skip
    return px, score


# ------------------------------------------------------------------------------------------ samples


def test_samples_are_bilinear(rng):
    image = rng.normal(100, 20, (40, 50)).astype(np.float32)
    side = 2 * RADIUS + 1
    grid = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1][::-1].reshape(2, -1)
    for x, y in rng.uniform((12, 12), (36, 26), (10, 2)):
        out = np.empty(side * side, np.float32)
        mean = _sample_square(image, x, y, RADIUS, out)
        plain = ndimage.map_coordinates(image, (grid + np.array([[x], [y]]))[::-1], order=1)
        np.testing.assert_allclose(out, plain, rtol=1e-4)
        assert mean == pytest.approx(plain.mean(), rel=1e-5)
        warp = np.array([[0.9, 0.2], [-0.1, 1.1]])
        _sample_template(image, x, y, *warp.ravel(), RADIUS, out)
        plain = ndimage.map_coordinates(image, (warp @ grid + [[x], [y]])[::-1], order=1)
        np.testing.assert_allclose(out, plain, rtol=1e-4)


def test_correlation_is_that_of_numpy(rng):
    a, b = rng.normal(size=(2, 9, 9))
    assert correlation_reference(a, b) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1])
    assert correlation_reference(a, 7.0 - 2.0 * a) == pytest.approx(-1.0)


# ---------------------------------------------------------------------------------------- alignment


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, -0.25), (3.3, 1.7), (-9.4, 6.6)])
def test_a_shift_is_found_to_a_hundredth_of_a_pixel(rng, shift):
    scene, host_px = Scene(rng), centres()
    px, score = align(scene.image(), scene.image(shift), host_px, host_px)
    assert np.mean(score > 0.98) > (0.75 if np.linalg.norm(shift) > 10 else 0.95)
    off = (px - host_px - shift)[score > 0.98]
    assert np.abs(off.mean(axis=0)).max() < 0.01
    assert np.abs(off).max() < 0.08
    if any(shift):
        assert np.abs(off).max() > 1e-6


def test_noise_moves_a_patch_as_its_gradients_say(rng):
    """Two-sided: as good as the information of the patch allows, and not better."""
    scene, shift, sigma = Scene(rng), np.array([0.4, -0.3]), 2.0
    host_px = centres(8)
    clean = build_pyramid(scene.image(), 0.8)[0]
    errors, expected = [], []
    for _ in range(3):
        first, second = (scene.image(s) + rng.normal(0, sigma, SHAPE) for s in ((0, 0), shift))
        px, score = align(first, second, host_px, host_px)
        good = score > 0.8
        assert good.mean() > 0.95
        errors.append((px - host_px - shift)[good])
    gy, gx = np.gradient(clean)
    for x, y in host_px.astype(int):
        window = np.s_[y - RADIUS : y + RADIUS + 1, x - RADIUS : x + RADIUS + 1]
        g = np.stack([gx[window].ravel(), gy[window].ravel()])
        g -= g.mean(axis=1, keepdims=True)
        # White noise keeps its power at low frequencies through the Gaussian: 2 sigma^2 for both.
        expected.append(2.0 * sigma**2 * np.trace(np.linalg.inv(g @ g.T)))
    measured = np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))
    assert 0.3 < measured / np.mean(expected) < 1.1
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.02


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 300.0), (0.6, 0.0), (1.7, -500.0)])
def test_gain_and_offset_do_no_harm(rng, gain, offset):
    scene, host_px, shift = Scene(rng), centres(), (1.3, -0.6)
    px, score = align(scene.image(), gain * scene.image(shift) + offset, host_px, host_px)
    assert np.median(score) > 0.99
    assert np.abs(np.median(px - host_px - shift, axis=0)).max() < 0.01


def test_a_known_warp_is_taken_into_account(rng):
    scene, warp = Scene(rng), np.array([[1.15, 0.1], [-0.08, 0.9]])
    centre = np.array([[80.0, 60.0]])
    image = scene.image((0.7, -0.4), warp)
    px, score = align(scene.image(), image, centre, centre, warp)
    np.testing.assert_allclose(px, centre + np.array([0.7, -0.4]), atol=0.03)
    assert score[0] > 0.98
    _, without = align(scene.image(), image, centre, centre)
    _, opposite = align(scene.image(), image, centre, centre, np.linalg.inv(warp))
    assert opposite[0] < without[0] - 0.02 < score[0] - 0.03


def test_the_score_is_the_correlation_of_the_patches(rng):
    scene, centre = Scene(rng), np.array([[80.0, 60.0]])
    first, second = (scene.image(s) + rng.normal(0, 15.0, SHAPE) for s in ((0, 0), (2.0, 1.0)))
    px, score = align(first, second, centre, centre, iterations=40)
    a, b = (build_pyramid(image, 0.8)[0] for image in (first, second))
    grid = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1][::-1].reshape(2, -1)
    patches = (
        ndimage.map_coordinates(image, (grid + at.reshape(2, 1))[::-1], order=1)
        for image, at in ((a, centre), (b, px))
    )
    assert score[0] == pytest.approx(correlation_reference(*patches), abs=0.002)
    assert 0.6 < score[0] < 0.99


def test_the_end_is_a_minimum_of_what_is_left(rng):
    """Plain sums of squares (means and contrast taken out) around the place that was found."""
    scene, centre = Scene(rng), np.array([[80.0, 60.0]])
    first, second = (scene.image(s) + rng.normal(0, 5.0, SHAPE) for s in ((0, 0), (0.4, 0.8)))
    px, _ = align(first, second, centre, centre, iterations=40)
    a, b = (build_pyramid(image, 0.8)[0].astype(float) for image in (first, second))
    grid = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1][::-1].reshape(2, -1)

    def score(at):
        patches = (
            ndimage.map_coordinates(image, (grid + np.reshape(p, (2, 1)))[::-1], order=1)
            for image, p in ((a, centre[0]), (b, at))
        )
        return correlation_reference(*patches)

    here = score(px[0])
    for step in ([0.1, 0], [-0.1, 0], [0, 0.1], [0, -0.1]):
        assert score(px[0] + step) < here


def test_from_far_away_the_pyramid_helps(rng):
    scene, host_px, shift = Scene(rng), centres(), np.array([8.0, -5.0])
    fine = align(scene.image(), scene.image(shift), host_px, host_px, top_level=0)[0]
    coarse = align(scene.image(), scene.image(shift), host_px, host_px)[0]
    found = [np.mean(np.linalg.norm(px - host_px - shift, axis=1) < 0.1) for px in (fine, coarse)]
    assert found[0] < 0.7 < 0.95 < found[1]


def test_what_cannot_be_aligned_says_so(rng):
    scene = Scene(rng)
    image = scene.image()
    inside = np.array([[80.0, 60.0]])
    cases = {
        "not asked": (inside, [[np.nan, 60.0]], None, image),
        "start outside": (inside, [[3.0, 60.0]], None, image),
        "far outside": (inside, [[-1e6, 60.0]], None, image),
        "host at the border": (np.array([[4.0, 60.0]]), inside, None, image),
        "no area": (inside, inside, np.diag([0.1, 0.1]), image),
        "mirrored": (inside, inside, np.diag([-1.0, 1.0]), image),
        "flat": (inside, inside, None, np.full(SHAPE, 900.0)),
    }
    for name, (host, start, warp, target) in cases.items():
        _, score = align(image, target, host, start, warp)
        assert score[0] == -1.0, name
    _, score = align(np.full(SHAPE, 5.0), image, inside, inside)
    assert score[0] == -1.0
    edge = np.broadcast_to(1000.0 + 50.0 * np.tanh((np.arange(160) - 80) / 3), SHAPE)
    _, score = align(edge, edge, inside, inside)  # may slide along
    assert score[0] == -1.0


# --------------------------------------------------------------------------------- disparity search


def searched(left, right, pixels, least=0, most=20):
    disparity, score = np.empty(len(pixels), np.int64), np.empty(len(pixels))
    search_disparity(left, right, pixels, 4, least, most, disparity, score)
    return disparity, score


@pytest.mark.parametrize(("level", "contrast"), [(128.0, 30.0), (8000.0, 30.0), (8000.0, 4.0)])
@pytest.mark.parametrize("least", [0, -3, 5])
def test_the_search_is_the_plain_form(rng, level, contrast, least):
    """Even faint patterns on the high counts of a thermal camera."""
    left = (level + contrast * rng.normal(size=(60, 80))).astype(np.float32)
    left = cv2.GaussianBlur(left, (5, 5), 0.8)
    noise = 0.3 * contrast * rng.normal(size=left.shape)
    right = np.roll(left, -7, axis=1) + noise.astype(np.float32)
    left[:, 60:], right[:30, 30:45] = level, level
    pixels = rng.integers((0, 0), (80, 60), (150, 2))
    disparity, score = searched(left, right, pixels, least)
    plain = [search_disparity_reference(left, right, tuple(p), 4, least, 20) for p in pixels]
    plain_disparity, plain_score = np.array(plain).T
    agree = disparity == plain_disparity
    assert agree.mean() > 0.98  # ties may be broken by rounding
    np.testing.assert_allclose(score[agree], plain_score[agree], atol=5e-3)
    found = score > 0.5
    assert 30 < found.sum() < 130
    assert np.mean(disparity[found] == 7) > 0.95


def test_a_pattern_that_repeats_is_not_guessed(rng):
    period = np.tile(rng.normal(100, 20, (60, 8)), (1, 10)).astype(np.float32)
    pixels = np.array([[50, 30], [60, 20]])
    assert (searched(period, period, pixels)[1] == -1.0).all()
    alone = rng.normal(100, 20, (60, 80)).astype(np.float32)
    disparity, score = searched(alone, alone, pixels)
    np.testing.assert_array_equal(disparity, 0)
    np.testing.assert_allclose(score, 1.0, atol=1e-5)
