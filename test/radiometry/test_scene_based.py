from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.radiometry import scene_based
from thermal_stereo_vo.radiometry.scene_based import (
    SceneBasedConfig,
    SceneBasedCorrection,
    shading_basis,
)


def pattern_of(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Columns, rows and pixels."""
    pattern = 6.0 * rng.standard_normal(shape[1])[None, :] + 3.0 * rng.standard_normal(shape)
    pattern += 2.0 * rng.standard_normal(shape[0])[:, None]
    return pattern - pattern.mean()


def fine(image: np.ndarray) -> np.ndarray:
    image = image.astype(np.float32)
    return image - cv2.GaussianBlur(image, (0, 0), 5)


def fly(correction, scene, pattern, positions, **state) -> np.ndarray:
    state = {"settled": True, "epoch": 0, **state}
    for x in positions:
        corrected = correction.process(scene.noisy(scene.clean(x) + pattern), **state)
    return corrected


def test_motion_removes_the_pattern(scene, rng):
    pattern = pattern_of(scene.shape, rng)
    correction = SceneBasedCorrection()
    fly(correction, scene, pattern, np.arange(0, 900, 4.0))
    truth = scene.clean(905)
    left = fly(correction, scene, pattern, [905]) - truth
    assert np.std(fine(pattern)) > 5
    assert np.std(fine(left)) < 0.42 * np.std(fine(pattern)), "noise of 1.5 counts included"
    learnt, wanted = fine(correction.offset).ravel(), fine(pattern).ravel()
    assert np.corrcoef(learnt, wanted)[0, 1] > 0.95


def test_it_never_takes_away_the_scene(scene):
    """No pattern: what is learnt stays far below the texture, and the picture is unharmed."""
    correction = SceneBasedCorrection()
    still = np.zeros(scene.shape)
    seen = fly(correction, scene, still, np.arange(0, 900, 4.0))
    truth = scene.clean(896)
    assert np.std(fine(seen - truth)) < 2.2, "1.5 counts of it are noise"
    assert np.corrcoef(fine(seen).ravel(), fine(truth).ravel())[0, 1] > 0.96


def test_hover_and_vibration_burn_nothing_in(scene, rng):
    pattern = pattern_of(scene.shape, rng)
    correction = SceneBasedCorrection()
    fly(correction, scene, pattern, np.arange(0, 600, 4.0))
    views, before = correction.views, correction.offset
    fly(correction, scene, pattern, 600 + 1.5 * np.sin(np.arange(300)))
    assert correction.views <= views + 1
    assert np.abs(correction.offset - before).mean() < 0.5


def test_a_stop_leaves_no_ghost(scene, rng):
    """After a long stop before one scene, another scene shows no trace of it."""
    correction = SceneBasedCorrection()
    still = np.zeros(scene.shape)
    fly(correction, scene, still, [*np.arange(0, 300, 4.0), *([300.0] * 400)])
    ghost = fine(correction.offset).ravel()
    texture = fine(scene.clean(300)).ravel()
    leaked = (ghost @ texture) / (texture @ texture)
    assert abs(leaked) < 0.03


def test_a_bland_scene_teaches_nothing(scene, rng):
    correction = SceneBasedCorrection()
    pattern = pattern_of(scene.shape, rng) * 0.1
    for k in range(50):
        image = scene.noisy(np.full(scene.shape, 8000.0 + 0.5 * k) + pattern)
        correction.process(image, settled=True, epoch=0)
    assert correction.views == 0
    assert not correction.offset.any()


def test_nothing_is_learnt_while_the_gate_forbids_it(scene, rng):
    correction = SceneBasedCorrection()
    fly(correction, scene, pattern_of(scene.shape, rng), np.arange(0, 200, 4.0), settled=False)
    assert correction.views == 0


class TestAfterACorrectionOfTheCamera:
    def test_a_pattern_that_no_longer_fits_is_forgotten(self, scene, rng):
        correction = SceneBasedCorrection()
        fly(correction, scene, pattern_of(scene.shape, rng), np.arange(0, 600, 4.0))
        fly(correction, scene, np.zeros(scene.shape), [600], epoch=1, settled=False)
        assert not correction.offset.any()

    def test_a_pattern_that_still_fits_is_kept(self, scene, rng):
        correction = SceneBasedCorrection()
        pattern = pattern_of(scene.shape, rng)
        fly(correction, scene, pattern, np.arange(0, 600, 4.0))
        before = correction.offset
        fly(correction, scene, pattern, [600], epoch=1, settled=False)
        np.testing.assert_array_equal(correction.offset, before)


def test_smooth_shading_is_learnt_and_the_horizon_is_not(scene):
    height, width = scene.shape
    x = np.linspace(-1, 1, width)[None, :]
    y = np.linspace(-1, 1, height)[:, None]
    shading = 60.0 * (x**2 + y**2 - 2 / 3)
    horizon = -80.0 * y * np.ones((1, width))
    correction = SceneBasedCorrection(SceneBasedConfig(shading_rate=0.1))
    fly(correction, scene, shading + horizon, np.arange(0, 1000, 3.0))
    smooth = cv2.GaussianBlur(correction.offset, (0, 0), 20)
    share = float((smooth * shading).sum() / (shading**2).sum())
    assert 0.6 < share < 1.3
    odd = float((smooth * horizon).sum() / (horizon**2).sum())
    assert abs(odd) < 0.1
    fixed = SceneBasedCorrection(SceneBasedConfig(shading_rate=0.0))
    fly(fixed, scene, shading + horizon, np.arange(0, 300, 3.0))
    smooth = cv2.GaussianBlur(fixed.offset, (0, 0), 20)
    assert float((smooth * shading).sum() / (shading**2).sum()) < 0.3


def test_shading_planes_are_even_and_without_mean():
    planes = shading_basis((48, 64))
    assert (planes[0] == 1).all()
    for plane in planes[1:]:
        assert abs(float(plane.mean())) < 1e-5
        np.testing.assert_allclose(plane, plane[::-1, ::-1], atol=1e-5)


def test_a_step_equals_its_numpy_twin(rng):
    shape = (31, 47)
    corrected, around, across, along, seen = rng.normal(0, 5, (5, *shape)).astype(np.float32)
    offset = np.zeros(shape, np.float32)
    columns, rows = np.zeros((2, shape[1])), np.zeros((2, shape[0]))
    step, after, by_column, by_row = scene_based.learn_reference(
        corrected, around, across, along, seen, 0.7, 3.0, 4.0, 0.2
    )
    assert 0.2 < np.mean(step != 0) < 0.9
    scene_based.learn_pixels(
        corrected, around, across, along, seen, 0.7, 3.0, 4.0, 0.2, offset, columns, rows
    )
    np.testing.assert_allclose(offset, step, atol=1e-5)
    np.testing.assert_allclose(seen, after, atol=1e-5)
    np.testing.assert_allclose(columns, by_column, atol=1e-3)
    np.testing.assert_allclose(rows, by_row, atol=1e-3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("value", [0, 255])
def test_constant_frames_do_no_harm(dtype, value):
    correction = SceneBasedCorrection()
    image = np.full((120, 160), value, dtype)
    for _ in range(3):
        np.testing.assert_array_equal(correction.process(image, settled=True, epoch=0), image)


def test_a_new_size_starts_anew(scene, rng):
    correction = SceneBasedCorrection()
    fly(correction, scene, pattern_of(scene.shape, rng), np.arange(0, 100, 4.0))
    smaller = scene.view(0)[:100, :120]
    out = correction.process(smaller, settled=True, epoch=0)
    np.testing.assert_array_equal(out, smaller)
    assert correction.views <= 1


def test_tiny_images_pass(rng):
    image = rng.integers(0, 1000, (5, 7)).astype(np.uint16)
    assert SceneBasedCorrection().process(image, settled=True, epoch=0).shape == (5, 7)


def roughness(image: np.ndarray) -> float:
    """L1 of the gradients over L1 of the image (Hayat et al.)."""
    image = image.astype(np.float64)
    gradients = np.abs(np.diff(image, axis=0)).sum() + np.abs(np.diff(image, axis=1)).sum()
    return float(gradients / np.abs(image).sum())


def test_a_real_drive_loses_its_pattern_and_keeps_no_ghost_of_its_stop(recording):
    """Strong fixed pattern; the car stops near frame 575."""
    video = cv2.VideoCapture(str(recording("lwir_drive") / "car_origin_1.avi"))
    correction = SceneBasedCorrection()
    raw_sum = corrected_sum = 0.0
    before, after, views, stopped = [], [], {}, None
    for k in range(600):
        good, picture = video.read()
        assert good
        raw = picture[..., 0].copy()
        corrected = correction.process(raw, settled=True, epoch=0)
        views[k] = correction.views
        if 300 <= k < 460:
            raw_sum, corrected_sum = raw_sum + raw.astype(float), corrected_sum + corrected
            if k % 20 == 0:
                before.append(roughness(raw))
                after.append(roughness(corrected))
        if k == 579:
            stopped = correction.offset
    assert np.mean(after) < 0.6 * np.mean(before)
    assert np.std(fine(corrected_sum / 160)) < 0.4 * np.std(fine(raw_sum / 160))
    assert views[599] - views[579] <= 2
    assert np.abs(correction.offset - stopped).mean() < 0.3
