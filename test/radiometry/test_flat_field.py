from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.calibration.radiometric import FlatFrame, fit_flat_field
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.radiometry import flat_field
from thermal_stereo_vo.radiometry.flat_field import (
    FlatField,
    FlatFieldCalibration,
    FlatFieldConfig,
    neighbours_of_bad,
)

UNSMOOTHED = FlatFieldConfig(temperature_smoothing_s=0.0)


@pytest.fixture
def calibration(sensor) -> FlatFieldCalibration:
    frames = [
        FlatFrame(sensor.see(level, fpa), fpa, level)
        for fpa in (280.0, 290.0, 300.0, 310.0, 320.0)
        for level in (7000.0, 9000.0)
    ]
    return fit_flat_field(frames, serial="42", camera="left")


def uint16(counts: np.ndarray) -> np.ndarray:
    return np.clip(np.round(counts), 0, 65535).astype(np.uint16)


def test_a_scene_comes_out_as_it_is(sensor, calibration, small_scene):
    corrector = FlatField(calibration, UNSMOOTHED, "left", "42")
    truth = small_scene.clean(100)
    for k, fpa in enumerate((281.0, 297.3, 318.0)):
        raw = uint16(sensor.see(truth, fpa))
        corrected = corrector.process(raw, fpa, k).astype(float)
        good = ~sensor.dead
        error = corrected[good] - truth[good]
        assert np.std(raw[good] - truth[good]) > 20
        assert np.std(error) < 0.7
        assert corrector.status.ok
        assert corrector.status.text == f"FPA {fpa - 273.15:.1f} degC"


def test_dead_pixels_take_the_median_of_their_neighbours(sensor, calibration, small_scene):
    corrector = FlatField(calibration, UNSMOOTHED)
    truth = small_scene.clean(100)
    corrected = corrector.process(uint16(sensor.see(truth, 300.0)), 300.0, 0)
    assert calibration.bad[sensor.dead].all()
    difference = corrected[sensor.dead] - truth[sensor.dead]
    assert np.abs(difference).max() < 60, "within the texture, where a dead pixel is 5000 away"


@pytest.mark.parametrize(("reach", "corrected_for"), [(0.0, 320.0), (5.0, 325.0)])
def test_outside_its_range_it_says_so_and_clamps(sensor, calibration, reach, corrected_for):
    config = FlatFieldConfig(temperature_smoothing_s=0.0, extrapolation_kelvin=reach)
    corrector = FlatField(calibration, config)
    raw = uint16(sensor.see(8000.0, 330.0))
    far = corrector.process(raw, 330.0, 0)
    assert not corrector.status.ok
    assert corrector.status.text == (
        "FPA 56.9 degC is outside the calibrated 6.9 to 46.9 degC: corrected for "
        f"{corrected_for - 273.15:.1f} degC"
    )
    edge = FlatField(calibration, config).process(raw, corrected_for, 0)
    np.testing.assert_array_equal(far, edge)


def test_without_a_temperature_it_says_what_it_does(sensor, calibration):
    corrector = FlatField(calibration, UNSMOOTHED)
    raw = uint16(sensor.see(8000.0, 300.0))
    for told in (None, np.nan):
        corrected = corrector.process(raw, told, 0)
        assert not corrector.status.ok
        assert corrector.status.text == (
            "the camera tells no FPA temperature: corrected for 26.9 degC"
        )
        assert np.std(corrected[~calibration.bad]) < 1.0
    corrector.process(raw, 310.0, 1)
    corrector.process(raw, None, 2)
    assert "corrected for 36.9 degC" in corrector.status.text, "the last one known"


def test_a_coarse_temperature_is_smoothed(sensor, calibration):
    corrector = FlatField(calibration, FlatFieldConfig(temperature_smoothing_s=1.0))
    raw = uint16(sensor.see(8000.0, 300.0))
    corrector.process(raw, 300.0, 0)
    corrector.process(raw, 310.0, 1_000_000_000)
    assert corrector.status.text == f"FPA {300 + 10 * (1 - np.exp(-1)) - 273.15:.1f} degC"
    for k in range(2, 12):
        corrector.process(raw, 310.0, k * 1_000_000_000)
    assert corrector.status.text == "FPA 36.8 degC"


def test_8_bit_images_stay_8_bit(calibration):
    image = np.full(calibration.bad.shape, 200, np.uint8)
    corrected = FlatField(calibration, UNSMOOTHED).process(image, 300.0, 0)
    assert corrected.dtype == np.uint8
    assert corrected.max() == 255, "clipped, not wrapped"


def test_the_raw_image_is_left_alone(sensor, calibration):
    raw = uint16(sensor.see(8000.0, 300.0))
    raw.flags.writeable = False
    before = raw.copy()
    first = FlatField(calibration, UNSMOOTHED).process(raw, 300.0, 0)
    second = FlatField(calibration, UNSMOOTHED).process(raw, 300.0, 0)
    np.testing.assert_array_equal(raw, before)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("value", [0, 65535])
def test_black_and_saturated_frames_do_no_harm(calibration, value):
    image = np.full(calibration.bad.shape, value, np.uint16)
    corrected = FlatField(calibration, UNSMOOTHED).process(image, 300.0, 0)
    assert corrected.shape == image.shape
    assert abs(int(np.median(corrected)) - value) < 1000


class TestKernels:
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_correction_equals_its_numpy_twin(self, rng, dtype):
        largest = float(np.iinfo(dtype).max)
        image = rng.integers(0, int(largest) + 1, (31, 47)).astype(dtype)
        offset = rng.normal(0, 0.1 * largest, image.shape).astype(np.float32)
        gain = rng.normal(1, 0.1, image.shape).astype(np.float32)
        out = np.empty_like(image)
        flat_field.correct(image, 0.4 * largest, offset, gain, largest, out)
        reference = flat_field.correct_reference(image, 0.4 * largest, offset, gain, largest)
        assert np.abs(out.astype(int) - reference).max() <= 1
        assert np.mean(out != reference) < 0.01
        flat_field.subtract(image, offset, largest, out)
        one = np.ones_like(gain)
        reference = flat_field.correct_reference(image, 0.0, offset, one, largest)
        np.testing.assert_array_equal(out, reference)

    def test_evaluation_equals_numpy(self, rng):
        coefficients = rng.normal(0, 1, (4, 7, 9)).astype(np.float32)
        out = np.empty((7, 9), np.float32)
        for t in (-1.3, 0.0, 0.7):
            flat_field.evaluate(coefficients, t, out)
            expected = np.polynomial.polynomial.polyval(t, coefficients.astype(float))
            np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-5)

    def test_bad_pixels_and_clusters_are_replaced_from_sound_ones(self, rng):
        image = rng.integers(1000, 1100, (40, 50)).astype(np.uint16)
        bad = np.zeros(image.shape, np.bool_)
        bad[0, 0] = bad[39, 49] = bad[20, 20] = True
        bad[10:15, 10:15] = True
        image[bad] = 60_000
        where, neighbours = neighbours_of_bad(bad)
        assert len(where) == bad.sum()
        out = image.copy()
        flat_field.replace_bad(out, where, neighbours)
        assert out[bad].max() < 1100
        np.testing.assert_array_equal(out[~bad], image[~bad])
        around = [image[y, x] for y in (19, 20, 21) for x in (19, 20, 21) if (y, x) != (20, 20)]
        assert abs(int(out[20, 20]) - np.median(around)) <= 1

    def test_an_array_of_bad_pixels_is_left_as_it_is(self):
        bad = np.ones((30, 30), np.bool_)
        image = np.full((30, 30), 7, np.uint16)
        flat_field.replace_bad(image, *neighbours_of_bad(bad))
        assert (image == 7).all()


class TestWrongUse:
    def test_the_file_of_another_camera(self, calibration):
        with pytest.raises(CalibrationError, match="camera with serial 42, but camera 'left' has"):
            FlatField(calibration, UNSMOOTHED, "left", "43")
        with pytest.raises(CalibrationError, match="made for camera 'left', not for 'right'"):
            FlatField(calibration, UNSMOOTHED, "right")
        FlatField(calibration, UNSMOOTHED, "left", "42")
        FlatField(replace(calibration, serial="", camera=""), UNSMOOTHED, "right", "43")

    def test_another_size(self, calibration):
        corrector = FlatField(calibration, UNSMOOTHED, "left")
        with pytest.raises(FrameError, match=r"'left' delivers 64x48 images but its flat field is"):
            corrector.process(np.ones((48, 64), np.uint16), 300.0, 0)

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"gain": np.ones((1, 3, 3), np.float32)}, "do not fit together"),
            ({"offset": np.zeros((0, 96, 128), np.float32)}, "has no coefficients"),
            ({"offset": np.full((1, 96, 128), np.nan, np.float32)}, "not finite"),
            ({"scale_kelvin": 0.0}, "not finite"),
            ({"minimum_kelvin": 400.0}, "runs backwards"),
        ],
    )
    def test_contradictory_calibrations(self, calibration, change, match):
        with pytest.raises(CalibrationError, match=match):
            replace(calibration, **change)
