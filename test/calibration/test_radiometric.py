from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.calibration.flat_field_recordings import read_flat_fields
from thermal_stereo_vo.calibration.radiometric import (
    FlatFieldOrders,
    FlatFrame,
    describe_fit,
    every_second_temperature,
    fit_flat_field,
    held_out_counts,
    non_uniformity,
    residual_counts,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.radiometry.flat_field import FlatField

SHAPE = (48, 64)
COLD, WARM = 280.0, 310.0


class Array:
    """Pixels with random offset polynomials, response and a dead pixel."""

    def __init__(self, rng: np.random.Generator) -> None:
        scales = np.array([40.0, 15.0, 4.0])[:, None, None]
        self.offsets = rng.normal(0, 1, (3, *SHAPE)) * scales
        self.offsets -= self.offsets.mean(axis=(1, 2), keepdims=True)
        self.response = 0.03 * rng.standard_normal(SHAPE)
        self.response -= self.response.mean()

    def see(self, source_kelvin: float, fpa_kelvin: float) -> np.ndarray:
        t = (fpa_kelvin - 300.0) / 20.0
        level = 8000.0 + 25.0 * (source_kelvin - 295.0) - 60.0 * t
        offset = np.tensordot(t ** np.arange(3), self.offsets, axes=1)
        counts = level + offset + self.response * (level - 8000.0)
        counts[7, 9] = 3000.0
        return counts


@pytest.fixture
def array(rng: np.random.Generator) -> Array:
    return Array(rng)


def frames(array: Array, fpa: list[float], sources: list[float | None]) -> list[FlatFrame]:
    return [
        FlatFrame(array.see(source or COLD, kelvin), kelvin, source, f"{kelvin}")
        for kelvin in fpa
        for source in sources
    ]


def test_two_points_make_every_level_between_uniform(array):
    calibration = fit_flat_field(frames(array, [300.0], [COLD, WARM]))
    assert calibration.gain.shape == (1, *SHAPE)
    between = [FlatFrame(array.see(kelvin, 300.0), 300.0) for kelvin in (285.0, 295.0, 305.0)]
    before = [non_uniformity(frame.image, calibration.bad) for frame in between]
    after = residual_counts(calibration, between)
    assert min(before) > 35
    assert max(after) < 0.4, "rounding to whole counts alone"


def test_one_level_leaves_the_gain_at_one(array):
    calibration = fit_flat_field(frames(array, [300.0], [None]))
    assert (calibration.gain == 1.0).all()
    other = FlatFrame(array.see(WARM, 300.0), 300.0)
    assert 10 < residual_counts(calibration, [other])[0] < 40


def test_offset_and_gain_follow_the_fpa_temperature(array):
    fpa = [280.0, 288.0, 296.0, 304.0, 312.0, 320.0]
    calibration = fit_flat_field(frames(array, fpa, [COLD, WARM]))
    assert (calibration.minimum_kelvin, calibration.maximum_kelvin) == (280.0, 320.0)
    unseen = [FlatFrame(array.see(295.0, kelvin), kelvin) for kelvin in (284.0, 300.0, 317.0)]
    assert residual_counts(calibration, unseen).max() < 0.5
    assert calibration.residual_counts.max() < 0.5
    assert calibration.uncorrected_counts.min() > 30
    bland = fit_flat_field(frames(array, fpa, [COLD, WARM]), orders=FlatFieldOrders(offset=0))
    assert residual_counts(bland, unseen).max() > 10


def test_the_mean_level_stays(array):
    calibration = fit_flat_field(frames(array, [290.0, 300.0, 310.0], [COLD, WARM]))
    image = array.see(295.0, 305.0)
    corrected = FlatField(calibration).process(np.round(image).astype(np.uint16), 305.0, 0)
    good = ~calibration.bad
    assert corrected[good].mean() == pytest.approx(image[good].mean(), abs=2.0)


def test_dead_pixels_are_found_and_sound_ones_kept(array):
    calibration = fit_flat_field(frames(array, [290.0, 300.0, 310.0], [COLD, WARM]))
    assert calibration.bad[7, 9]
    assert calibration.bad.sum() <= 3


def test_held_out_frames_are_every_second_by_temperature(array, rng):
    fpa = list(np.linspace(280, 320, 14))
    given = frames(array, fpa, [None])
    shuffled = [given[k] for k in rng.permutation(len(given))]
    residual = held_out_counts(shuffled)
    assert residual.shape == (7,)
    assert residual.max() < 1.0


def test_cold_and_warm_views_of_a_temperature_are_held_out_together(array):
    given = frames(array, list(np.linspace(280, 320, 10)), [COLD, WARM])
    fitted, tested = every_second_temperature(given)
    assert len(fitted) == len(tested) == 10
    assert {f.fpa_kelvin for f in fitted}.isdisjoint(f.fpa_kelvin for f in tested)
    assert held_out_counts(given).max() < 0.6


def test_a_table_for_people(array):
    calibration = fit_flat_field(
        frames(array, [300.0, 290.0], [COLD, WARM]), serial="42", camera="left"
    )
    lines = describe_fit(calibration).splitlines()
    assert len(lines) == 5
    assert lines[1].split()[0] == "16.85"
    text = calibration.describe()
    assert "camera 'left', serial 42, 64x48, FPA 16.9 to 26.9 degC" in text


def image(value: float = 0.0) -> np.ndarray:
    return np.arange(48 * 64, dtype=np.float64).reshape(48, 64) + value


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ([], "no flat field given: record a uniform source"),
        (
            [FlatFrame(image(), 300.0, name="a"), FlatFrame(image()[:10], 300.0, name="b")],
            r"'b' is \(10, 64\), the first is \(48, 64\)",
        ),
        ([FlatFrame(image(), np.nan, name="a")], "'a' has an FPA temperature of nan K"),
        ([FlatFrame(image(), 20.0, name="a")], "'a' has an FPA temperature of 20.0 K"),
        ([FlatFrame(image(np.nan), 300.0, name="a")], "'a' holds NaN"),
        ([FlatFrame(np.ones((48, 64)), 300.0, name="a")], "'a' has one value everywhere"),
    ],
)
def test_unusable_frames_are_refused(given, match):
    with pytest.raises(CalibrationError, match=match):
        fit_flat_field(given)


def test_degrees_beyond_the_recordings_are_refused(array):
    with pytest.raises(CalibrationError, match="2 flat fields at 1 FPA temperatures cannot carry"):
        fit_flat_field(frames(array, [300.0], [COLD, WARM]), orders=FlatFieldOrders(offset=2))
    with pytest.raises(CalibrationError, match="cannot carry an offset of degree 0 and a gain"):
        fit_flat_field(frames(array, [300.0], [COLD]), orders=FlatFieldOrders(gain=0))


@pytest.fixture(scope="module")
def flat_fields(recording) -> list[FlatFrame]:
    found = read_flat_fields(recording("flat_fields_fpa"))
    assert len(found.frames) == 40
    assert found.serial == "546515111"
    return sorted(found.frames, key=lambda frame: frame.fpa_kelvin)


class TestRealCore:
    """One uncooled core before uniform sources from -32 to +66 degC."""

    def test_every_second_temperature_corrects_the_others(self, flat_fields):
        fitted = fit_flat_field(flat_fields[0::2])
        others = flat_fields[1::2]
        middle = min(flat_fields[0::2], key=lambda frame: abs(frame.fpa_kelvin - 290.0))
        single = fit_flat_field([middle])
        before = np.array([non_uniformity(frame.image, fitted.bad) for frame in others])
        after = residual_counts(fitted, others, reach_kelvin=10.0)
        by_single = residual_counts(single, others)
        assert np.mean(before) / np.mean(after) > 10
        assert np.median(before / after) > 30
        assert np.mean(by_single) / np.mean(after) > 3
        assert 0.3 < np.median(after) < 10.0

    def test_ten_degrees_outside_cost_what_the_report_says(self, flat_fields):
        inside = [f for f in flat_fields if 263.0 < f.fpa_kelvin < 313.5]
        outside = min(flat_fields, key=lambda f: abs(f.fpa_kelvin - 323.3))
        fitted = fit_flat_field(inside)
        clamped = residual_counts(fitted, [outside])[0]
        followed = residual_counts(fitted, [outside], reach_kelvin=10.0)[0]
        before = non_uniformity(outside.image, fitted.bad)
        assert followed < clamped < 0.5 * before
        assert 20 < clamped < 300
