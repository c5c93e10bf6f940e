"""Dense disparities of drawn pairs whose truth is known by construction."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.frames import CameraView, GapReason, RigFrame
from thermal_stereo_vo.core.transforms import make_transform
from thermal_stereo_vo.stereo.dense import DenseConfig, DenseStereo, DisparityMap
from thermal_stereo_vo.stereo.dense_refinement import Refinement
from thermal_stereo_vo.stereo.dense_view import fine_noise, matching_view, smoothed

HEIGHT, WIDTH = 160, 320
CAMERA = Camera(WIDTH, HEIGHT, 250.0, 250.0, 160.0, 80.0)
BASELINE_M = 0.25
NOISE_COUNTS = 1.5
CONFIG = DenseConfig(disparities=48)


def texture(rng, height=HEIGHT, width=WIDTH + 64, contrast_counts=10.0):
    """(H, W) float32 with detail of several pixels and more, as a lens leaves it."""
    total = np.zeros((height, width), np.float32)
    for cell in (4, 9, 25):
        coarse = rng.normal(size=(height // cell + 2, width // cell + 2)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return total / total.std() * contrast_counts


def slope(nearest=30.0, farthest=6.0):
    """(H, W) disparities of a floor that comes nearer downwards and a little to the right."""
    rows = np.linspace(farthest, nearest, HEIGHT)[:, None]
    return (rows + np.linspace(-1.0, 1.0, WIDTH)).astype(np.float32)


def pair(truth, rng, *, contrast_counts=10.0, noise=NOISE_COUNTS, level=(7000.0, 7025.0)):
    """Left and right (H, W) uint16 counts: left(x) = right(x - disparity)."""
    seen = texture(rng, contrast_counts=contrast_counts)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    at = (x + 64 - truth).astype(np.float32)
    left = cv2.remap(seen, at, y.astype(np.float32), cv2.INTER_CUBIC)
    counts = [
        image + offset + noise * rng.standard_normal(image.shape)
        for image, offset in zip((left, seen[:, 64:]), level, strict=True)
    ]
    return [np.clip(np.rint(image), 0, 16383).astype(np.uint16) for image in counts]


def rig_frame(left, right, masks=(None, None), right_cx=CAMERA.cx):
    T_left_right = make_transform(np.eye(3), [BASELINE_M, 0.0, 0.0])
    return RigFrame(
        5,
        {
            "left": CameraView(left, CAMERA, mask=masks[0]),
            "right": CameraView(right, replace(CAMERA, cx=right_cx), T_left_right, mask=masks[1]),
        },
    )


@pytest.fixture(scope="module")
def floor():
    return pair(slope(), np.random.default_rng(1))


@pytest.fixture(scope="module")
def dense_floor(floor):
    return DenseStereo(CONFIG).process(rig_frame(*floor))


def seen_by_both(truth):
    return np.arange(WIDTH) - truth >= 0.0


def test_a_slope_is_found_densely_and_without_bias(dense_floor):
    truth = slope()
    error = (dense_floor.disparity_px - truth)[seen_by_both(truth)]
    given = np.isfinite(error)
    assert 0.9 < given.mean() <= 1.0
    assert np.median(np.abs(error[given])) < 0.12
    assert abs(np.mean(error[given])) < 0.03
    assert np.mean(np.abs(error[given]) > 1.0) < 0.01


def test_nothing_is_claimed_where_the_right_eye_does_not_look(dense_floor):
    assert not np.isfinite(dense_floor.disparity_px[~seen_by_both(slope() - 1.0)]).any()


def test_the_standard_deviation_is_of_the_size_of_the_error(dense_floor):
    given = np.isfinite(dense_floor.disparity_px)
    error = (dense_floor.disparity_px - slope())[given]
    spread = 1.4826 * np.median(np.abs(error))
    assert 0.5 < spread / np.median(dense_floor.sigma_px[given]) < 2.0


def test_more_noise_gives_larger_standard_deviations_and_fewer_points():
    kept, sigmas = [], []
    for contrast in (10.0, 1.0):
        noisy = pair(slope(), np.random.default_rng(2), contrast_counts=contrast)
        found = DenseStereo(CONFIG).process(rig_frame(*noisy))
        kept.append(found.density)
        sigmas.append(np.nanmedian(found.sigma_px))
    assert kept[1] < 0.6 * kept[0]
    assert sigmas[1] > 2.0 * sigmas[0]


def test_depth_follows_from_focal_length_baseline_and_principal_points():
    disparity = np.array([[10.0, np.nan, 2.0, 1.0]], np.float32)
    made = DisparityMap(0, disparity, disparity, (0.0, 47.0), CAMERA, 158.0, 0.25, disparity)
    # f B / (d - (cx_left - cx_right)): 62.5 / 8, nothing known, then at and beyond infinity.
    np.testing.assert_allclose(made.depth_m, [[7.8125, np.nan, np.inf, np.inf]])
    assert made.density == 0.75


def test_the_map_knows_its_frame_and_its_limits(floor):
    found = DenseStereo(DenseConfig(disparities=40)).process(rig_frame(*floor, right_cx=150.0))
    assert (found.stamp_ns, found.right_cx, found.baseline_m) == (5, 150.0, BASELINE_M)
    assert found.limits_px == (0.0, 47.0)  # whole steps of 16
    assert found.counts is floor[0]


def test_sky_gives_no_points_and_what_stands_before_it_does():
    """A house with 20 px of disparity before cold, empty sky."""
    rng = np.random.default_rng(3)
    left, right = pair(np.full((HEIGHT, WIDTH), 20.0, np.float32), rng)
    house = np.zeros((HEIGHT, WIDTH), np.bool_)
    house[50:, 150:230] = True
    for image, seen in ((left, house), (right, np.roll(house, -20, axis=1))):
        empty = np.rint(6900 + NOISE_COUNTS * rng.standard_normal((HEIGHT, WIDTH)))
        image[~seen] = empty[~seen]
    found = np.isfinite(DenseStereo(CONFIG).process(rig_frame(left, right)).disparity_px)
    assert found[house].mean() > 0.9
    assert found[~house].mean() < 0.05
    careless = DenseStereo(replace(CONFIG, sky_contrast=0.0)).process(rig_frame(left, right))
    # Windows that hold an edge draw the house out into the sky.
    assert np.isfinite(careless.disparity_px[~house]).mean() > found[~house].mean() + 0.01


def test_masked_pixels_of_either_eye_give_no_points(floor):
    truth = slope()
    left_mask, right_mask = np.ones((2, HEIGHT, WIDTH), np.bool_)
    left_mask[:, 200:220] = False
    right_mask[:, 100:120] = False
    masked = DenseStereo(CONFIG).process(rig_frame(*floor, (left_mask, right_mask)))
    given = np.isfinite(masked.disparity_px)
    assert not given[:, 200:220].any()
    at = np.arange(WIDTH) - truth
    assert not given[(at > 101) & (at < 118)].any()
    assert given[:, 225:300].mean() > 0.9


def test_a_blind_eye_gives_nothing(floor):
    both = rig_frame(*floor)
    one = RigFrame(5, {"left": both.views["left"]}, {"right": GapReason.FFC})
    assert DenseStereo(CONFIG).process(one) is None


def test_the_same_frame_gives_the_same_map_whatever_came_before(floor, dense_floor):
    stereo = DenseStereo(CONFIG)
    other = pair(slope(20.0, 3.0), np.random.default_rng(8))
    stereo.process(rig_frame(*other))
    again = stereo.process(rig_frame(*floor))
    np.testing.assert_array_equal(again.disparity_px, dense_floor.disparity_px)


def test_eight_bit_images_serve_too():
    left, right = pair(slope(), np.random.default_rng(4), contrast_counts=30.0, level=(120, 130))
    images = [np.clip(image, 0, 255).astype(np.uint8) for image in (left, right)]
    found = DenseStereo(CONFIG).process(rig_frame(*images))
    given = np.isfinite(found.disparity_px)
    assert given[:, 40:].mean() > 0.9
    assert np.median(np.abs(found.disparity_px - slope())[given]) < 0.1


@pytest.mark.parametrize("content", ["flat", "noise", "black"])
def test_images_without_content_give_no_points(content):
    rng = np.random.default_rng(6)
    images = {
        "flat": np.full((2, HEIGHT, WIDTH), 7000, np.uint16),
        "noise": rng.integers(6990, 7010, (2, HEIGHT, WIDTH)).astype(np.uint16),
        "black": np.zeros((2, HEIGHT, WIDTH), np.uint16),
    }[content]
    assert DenseStereo(CONFIG).process(rig_frame(*images)).density < 0.02


def test_speckles_are_removed(floor):
    """A hot spot at another disparity than its surroundings is smaller than a patch must be."""
    left, right = (image.copy() for image in floor)
    left[80:92, 200:212] += 80
    right[80:92, 160:172] += 80
    kept = {}
    for size in (0, 1000):
        found = DenseStereo(replace(CONFIG, speckle_px=size)).process(rig_frame(left, right))
        kept[size] = (np.abs(found.disparity_px[80:92, 200:212] - 40.0) < 1.0).mean()
    assert kept[0] > 0.5
    assert kept[1000] < 0.1


@pytest.mark.parametrize("offset_px", [-0.4, 0.4])
def test_one_step_on_counts_removes_most_of_an_error(offset_px):
    truth = np.full((HEIGHT, WIDTH), 12.3, np.float32)
    left, right = pair(truth, np.random.default_rng(7), noise=0.5)
    refine = Refinement(HEIGHT, WIDTH, 15).refine
    found = refine(truth + np.float32(offset_px), smoothed(left, 0.7), smoothed(right, 0.7))
    inside = found.disparity_px[10:-10, 30:-30]
    assert abs(np.mean(inside) - 12.3) < 0.1
    assert found.noise_counts < 2.0


def test_pixels_without_disparity_stay_without_and_disturb_nobody():
    truth = np.full((HEIGHT, WIDTH), 12.3, np.float32)
    left, right = pair(truth, np.random.default_rng(7))
    start = truth.copy()
    start[:, 150:160] = np.nan
    found = Refinement(HEIGHT, WIDTH, 15).refine(start, left.astype("f4"), right.astype("f4"))
    np.testing.assert_array_equal(np.isnan(found.disparity_px), np.isnan(start))
    np.testing.assert_array_equal(np.isnan(found.sigma_px), np.isnan(start))
    assert abs(np.mean(found.disparity_px[20:-20, 140:148]) - 12.3) < 0.05


def test_the_noise_of_pixels_is_measured_beside_patterns_and_edges():
    rng = np.random.default_rng(9)
    image = 7000 + 3.0 * rng.standard_normal((240, 320))
    image += 20.0 * rng.standard_normal((1, 320)) + 20.0 * rng.standard_normal((240, 1))
    image[:, 150:] += 500.0
    assert fine_noise(np.rint(image).astype(np.uint16)) == pytest.approx(3.0, rel=0.08)
    assert fine_noise(np.full((240, 320), 7000, np.uint16)) == pytest.approx(12**-0.5)


def test_the_matching_view_shows_weak_and_strong_detail_alike_but_not_noise():
    rng = np.random.default_rng(10)
    wave = np.sin(np.arange(300) / 3.0)[None, :] * np.ones((90, 1))
    strength = np.repeat([200.0, 20.0, 0.0], 100)
    counts = (7000 + strength * wave + 0.3 * rng.standard_normal((90, 300))).astype(np.float32)
    view = matching_view(counts, 31, 3.0).astype(np.float64)
    strong, weak, nothing = (view[:, a : a + 60].std() for a in (20, 120, 220))
    assert 0.85 < weak / strong <= 1.0
    assert nothing < 0.15 * strong
    assert abs(view.mean() - 128) < 2.0
