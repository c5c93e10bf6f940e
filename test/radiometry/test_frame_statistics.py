from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.radiometry import frame_statistics
from thermal_stereo_vo.radiometry.frame_statistics import StatisticsMaker


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("stride", [1, 2])
def test_block_sums_equal_their_numpy_twin(rng, dtype, stride):
    image = rng.integers(0, 255, (64, 96)).astype(dtype)
    previous = rng.integers(0, 255, (64, 96)).astype(dtype)
    blocks = (64 // (8 * stride), 96 // (8 * stride))
    sums = np.empty((5, *blocks))
    frame_statistics.block_sums(image, previous, stride, sums)
    np.testing.assert_allclose(
        sums, frame_statistics.block_sums_reference(image, previous, stride, blocks)
    )


def test_noise_step_and_scene_are_told_apart(scene, rng):
    maker = StatisticsMaker(scene.shape)
    still = maker.measure(scene.view(0), scene.view(0))
    assert still.quiet == pytest.approx(1.5 * np.sqrt(2), rel=0.2)
    assert still.busy == pytest.approx(1.5 * np.sqrt(2), rel=0.25)
    assert abs(still.step) < 0.1
    assert still.grain == pytest.approx(1.5, rel=0.25)

    stepped = maker.measure(scene.noisy(scene.clean(0) + 25.0), scene.view(0))
    assert stepped.step == pytest.approx(25.0, abs=0.2)
    assert stepped.common == 1.0
    assert stepped.quiet == pytest.approx(still.quiet, rel=0.1)

    moved = maker.measure(scene.view(6), scene.view(0))
    assert moved.busy > 3 * still.busy
    assert moved.common < 0.9

    bland = maker.measure(scene.noisy(np.full(scene.shape, 8000.0)), scene.view(0))
    assert bland.contrast < 0.05 * still.contrast
    assert bland.texture < 0.2 * still.texture


def test_identical_and_constant_images(scene):
    maker = StatisticsMaker(scene.shape)
    image = scene.view(0)
    assert maker.measure(image, image.copy()).identical
    other = image.copy()
    other[-1, -1] += 1
    assert not maker.measure(image, other).identical
    assert not maker.measure(image, image).constant
    assert maker.measure(np.full_like(image, 7), image).constant


def test_large_counts_lose_no_precision(rng):
    image = np.round(65_000 + rng.normal(0, 1.5, (240, 320))).astype(np.uint16)
    statistics = StatisticsMaker(image.shape).measure(image, image)
    assert statistics.texture == pytest.approx(1.5, rel=0.3)
