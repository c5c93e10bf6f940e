"""Only true loops close: synthetic features whose partners are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import exp_se3, inverse, transform_points
from thermal_stereo_vo.odometry.feature_based.description import Features
from thermal_stereo_vo.odometry.feature_based.loop_matching import (
    LoopMatchingConfig,
    StereoFeatures,
    match_loops,
)
from thermal_stereo_vo.odometry.feature_based.stereo_projection import StereoCamera

WIDTH, HEIGHT = 640, 512
CAMERA = StereoCamera(522.0, 522.0, 320.0, 256.0, 320.0, 0.268)
IMAGES = ("left", "right", "previous_left", "previous_right")
CONFIG = LoopMatchingConfig()


@dataclass
class Scene:
    """Four images' features; ``truth[image][i]`` is the point that feature i shows, or -1."""

    pixels: dict
    words: dict
    bright: dict
    truth: dict
    camera: StereoCamera
    T_previous_current: np.ndarray

    def features(self, image) -> Features:
        pixels = self.pixels[image].astype(np.float32)
        return Features(
            pixels, self.words[image], np.ones(len(pixels), np.float32), self.bright[image]
        )

    def match(self, predict=True, config=CONFIG, size=(WIDTH, HEIGHT)):
        view = Camera(*size, 522.0, 522.0, 320.0, 256.0)
        current = StereoFeatures.of(self.features("left"), self.features("right"), view)
        previous = StereoFeatures.of(
            self.features("previous_left"), self.features("previous_right"), view
        )
        return match_loops(
            current, previous, self.camera, self.T_previous_current if predict else None, config
        )

    def true_loops(self):
        """{(left, right, previous right, previous left)} of points seen in all four images."""
        where = {
            image: {p: i for i, p in enumerate(self.truth[image]) if p >= 0} for image in IMAGES
        }
        common = set.intersection(*(set(w) for w in where.values()))
        order = ("left", "right", "previous_right", "previous_left")
        return {tuple(where[image][p] for image in order) for p in common}

    def closed(self, **more):
        return {tuple(row) for row in self.match(**more).index.tolist()}


def flip_bits(words, count, rng):
    """Flip ``count`` random bits of each 512-bit row."""
    noisy = words.copy()
    for row in noisy:
        for bit in rng.choice(512, count, replace=False):
            row[bit // 64] ^= np.uint64(1) << np.uint64(bit % 64)
    return noisy


def make_scene(
    rng, n=60, clutter=40, motion=(0.05, -0.02, -0.4, 0.01, 0.03, -0.01), bits=15, camera=CAMERA,
    depth_m=(4.0, 40.0), noise_px=0.2,
) -> Scene:  # fmt: skip
    """Points seen from two places, in random order, among features that show nothing."""
    T_previous_current = inverse(exp_se3(motion))
    z = np.exp(rng.uniform(*np.log(depth_m), n))
    u, v = rng.uniform((120, 90), (560, 430), (n, 2)).T
    current = np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    seen = {
        "left": camera.project(current)[:, :2],
        "right": camera.project(current)[:, 2:],
    }
    before = camera.project(transform_points(T_previous_current, current))
    seen |= {"previous_left": before[:, :2], "previous_right": before[:, 2:]}
    words = rng.integers(0, 2**64, (n, 8), dtype=np.uint64)
    bright = rng.random(n) < 0.5
    scene = Scene({}, {}, {}, {}, camera, T_previous_current)
    for image in IMAGES:
        order = rng.permutation(n + clutter)
        pixels = np.vstack([
            seen[image] + rng.normal(0, noise_px, (n, 2)),
            rng.uniform((0, 0), (WIDTH, HEIGHT), (clutter, 2)),
        ])  # fmt: skip
        all_words = np.vstack(
            [flip_bits(words, bits, rng), rng.integers(0, 2**64, (clutter, 8), dtype=np.uint64)]
        )
        scene.pixels[image] = pixels[order]
        scene.words[image] = np.ascontiguousarray(all_words[order])
        scene.bright[image] = np.concatenate([bright, rng.random(clutter) < 0.5])[order]
        scene.truth[image] = np.concatenate([np.arange(n), np.full(clutter, -1)])[order]
    return scene


@given(st.integers(0, 2**32 - 1), st.integers(0, 150))
@settings(max_examples=15)
@example(7339, 147)
def test_all_true_loops_close_and_next_to_no_others(seed, clutter):
    scene = make_scene(np.random.default_rng(seed), clutter=clutter)
    assert len(scene.true_loops()) == 60
    assert scene.closed() >= scene.true_loops()
    # Four random descriptors in the right places may resemble each other, once in many scenes.
    assert len(scene.closed() - scene.true_loops()) <= 1


def test_matches_say_what_their_index_says(rng):
    scene = make_scene(rng)
    matches = scene.match()
    for image, column in (("left", 0), ("right", 1), ("previous_right", 2), ("previous_left", 3)):
        expected = scene.pixels[image].astype(np.float32)[matches.index[:, column]]
        np.testing.assert_array_equal(getattr(matches, image), expected)
    assert len(matches) == 60
    # Each image has 15 of its own bits flipped: two differ in up to 30, four legs in up to 120.
    assert matches.distance.max() <= 120
    assert matches.distance.min() >= 80


def test_a_point_that_one_image_lacks_closes_no_loop(rng):
    for image in IMAGES:
        scene = make_scene(rng)
        gone = np.isin(scene.truth[image], range(10))
        scene.words[image][gone] = rng.integers(0, 2**64, (10, 8), dtype=np.uint64)
        scene.truth[image] = np.where(gone, -1, scene.truth[image])
        assert len(scene.true_loops()) == 50
        assert scene.closed() == scene.true_loops()


@pytest.mark.parametrize("image", ["right", "previous_right"])
@pytest.mark.parametrize(("rows_px", "loops"), [(1.0, 60), (-1.0, 60), (2.6, 0), (-2.6, 0)])
def test_eyes_must_agree_in_the_row(image, rows_px, loops, rng):
    scene = make_scene(rng)
    scene.pixels[image][:, 1] += rows_px
    found = len(scene.closed())
    assert found <= loops
    assert found >= 0.85 * loops


def test_a_point_must_lie_further_left_in_the_right_eye(rng):
    """Swapped eyes give no match at all, not matches of negative depth."""
    scene = make_scene(rng)
    swap = {"left": "right", "right": "left", "previous_left": "previous_right",
            "previous_right": "previous_left"}  # fmt: skip
    swapped = Scene(
        *({image: field[swap[image]] for image in IMAGES}
          for field in (scene.pixels, scene.words, scene.bright, scene.truth)),
        scene.camera, scene.T_previous_current,
    )  # fmt: skip
    assert len(swapped.true_loops()) == 60
    assert swapped.closed(predict=False) == set()


@pytest.mark.parametrize(
    ("depth_m", "loops"), [((4.0, 40.0), 60), ((0.5, 0.6), 0), ((3000.0, 4000.0), 0)]
)
def test_disparity_has_bounds(depth_m, loops, rng):
    """160 px is 0.87 m, half a pixel is 280 m."""
    scene = make_scene(rng, depth_m=depth_m, motion=(0.0,) * 6, noise_px=0.05)
    assert len(scene.closed()) == loops


def test_disparity_counts_from_the_principal_points(rng):
    """A rectification that shifts the right image must not shift the search away."""
    for cx_right in (250.0, 390.0):
        scene = make_scene(rng, camera=replace(CAMERA, cx_right=cx_right))
        assert len(scene.true_loops()) == 60
        assert scene.closed() == scene.true_loops()


FAST = (0.0, 0.0, 0.0, 0.0, 0.15, 0.0)
"""A turn that moves the image by about 80 px."""


def test_motion_beyond_the_radius_needs_a_prediction(rng):
    scene = make_scene(rng, motion=FAST)
    narrow = replace(CONFIG, motion_radius_px=45.0, wide_motion_radius_px=45.0)
    assert scene.closed(predict=False, config=narrow) == set()
    wide = replace(CONFIG, wide_motion_radius_px=120.0)
    assert scene.closed(predict=False, config=wide) == scene.true_loops()


def test_a_prediction_centres_the_search(rng):
    """With the true motion a radius far below the flow is enough, both ways round the loop."""
    scene = make_scene(rng, motion=FAST)
    narrow = replace(CONFIG, motion_radius_px=6.0)
    assert scene.closed(config=narrow) == scene.true_loops()


def test_dark_and_bright_never_match(rng):
    for image in IMAGES:
        scene = make_scene(rng, clutter=0)
        scene.bright[image] = ~scene.bright[image]
        assert scene.closed() == set()


def test_descriptors_must_be_alike(rng):
    assert len(make_scene(rng, bits=200).closed()) < 5


def test_the_ratio_test_thins_out(rng):
    scene = make_scene(rng, bits=60, clutter=900)
    every = replace(CONFIG, coarse_bits=128)
    all_loops = scene.closed(config=every)
    distinct = scene.closed(config=replace(every, ratio=0.47))
    assert distinct < all_loops
    assert 5 < len(distinct) < 0.8 * len(all_loops)


def test_a_twin_nearby_lets_no_wrong_loop_close(rng):
    """Two features with one descriptor: the loop must come back to where it began."""
    scene = make_scene(rng, clutter=0)
    for k in range(0, 20, 2):
        i, j = (int(np.flatnonzero(scene.truth["left"] == p)[0]) for p in (k, k + 1))
        scene.words["left"][j] = scene.words["left"][i]
        scene.bright["left"][j] = scene.bright["left"][i]
        scene.pixels["left"][j] = scene.pixels["left"][i] + (3.0, 0.0)
    lefts = {row[0] for row in scene.closed()}
    right = [row[1] for row in scene.closed()]
    assert len(right) == len(set(right))
    assert len(lefts) >= 40
    for row in scene.closed():
        if scene.truth["left"][row[0]] >= 20:
            assert row in scene.true_loops()


def test_no_features_no_loops(rng):
    empty = make_scene(rng, n=0, clutter=0)
    assert len(empty.match()) == 0
    assert len(empty.match(predict=False)) == 0
    assert empty.match().index.shape == (0, 4)
    scene = make_scene(rng)
    for image in ("previous_left", "previous_right"):
        scene.pixels[image], scene.words[image] = empty.pixels[image], empty.words[image]
        scene.bright[image], scene.truth[image] = empty.bright[image], empty.truth[image]
    assert len(scene.match()) == 0
