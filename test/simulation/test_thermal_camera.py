from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from thermal_stereo_vo.core.frames import FfcState
from thermal_stereo_vo.simulation.settings import FfcConfig, ThermalCameraConfig
from thermal_stereo_vo.simulation.thermal_camera import (
    HIGHEST_COUNT,
    ThermalCamera,
    read_out,
    read_out_reference,
    smooth_field,
)
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature

from .small_worlds import QUIET, thermal_camera, uniform_signal

SHAPE = (120, 160)
NETD_COUNTS = 50e-3 * 30.0


def film(camera: ThermalCamera, frames: int, rate_hz: float = 30.0, kelvin: float = 300.0):
    """(frames, H, W) counts of a uniform source."""
    signal = uniform_signal(SHAPE, kelvin)
    return np.array(
        [camera.expose(signal, i / rate_hz, i).counts for i in range(frames)], dtype=np.float64
    )


def noise_components(frames: np.ndarray) -> dict[str, float]:
    """The 3-D noise model (D'Agostino & Webb 1991): standard deviations of the seven parts."""
    cube = frames - frames.mean()

    def mean(*axes: int) -> np.ndarray:
        return cube.mean(axis=axes, keepdims=True)

    t, v, h = mean(1, 2), mean(0, 2), mean(0, 1)
    tv, th, vh = mean(2) - t - v, mean(1) - t - h, mean(0) - v - h
    tvh = cube - t - v - h - tv - th - vh
    parts = {"t": t, "v": v, "h": h, "tv": tv, "th": th, "vh": vh, "tvh": tvh}
    return {name: float(part.std()) for name, part in parts.items()}


def test_the_netd_put_in_is_found_again() -> None:
    frames = film(thermal_camera(SHAPE, **{**QUIET, "netd_mk": 50.0}), 40)
    sigma = np.median(frames.std(axis=0, ddof=1))
    # Rounding to counts adds 1/12.
    expected = np.hypot(NETD_COUNTS, np.sqrt(1.0 / 12.0))
    assert 0.97 * expected < sigma < 1.03 * expected


@pytest.mark.parametrize(
    ("setting", "value", "part", "expected"),
    [
        ("fixed_pixel", 0.8, "vh", 0.8), ("fixed_column", 1.5, "h", 1.5),
        ("fixed_row", 1.5, "v", 1.5), ("row_noise", 1.0, "tv", 1.0),
        ("column_noise", 1.0, "th", 1.0),
    ],
)  # fmt: skip
def test_each_part_of_the_3d_noise_is_found_again(setting, value, part, expected) -> None:
    """One part at a time over plain pixel noise; the others stay at the level of rounding."""
    settings = {**QUIET, "netd_mk": 50.0, setting: value}
    found = noise_components(film(thermal_camera(SHAPE, **settings), 30))
    assert 0.85 * expected * NETD_COUNTS < found[part] < 1.15 * expected * NETD_COUNTS
    assert found["tvh"] == pytest.approx(np.hypot(NETD_COUNTS, np.sqrt(1 / 12)), rel=0.05)
    for name, value in found.items():
        if name not in (part, "tvh"):
            assert value < 0.25 * NETD_COUNTS, name


def test_slow_noise_stays_within_a_second_and_goes_after() -> None:
    frames = film(thermal_camera(SHAPE, **{**QUIET, "netd_mk": 50.0, "slow_noise": 1.0}), 90, 10.0)
    centred = frames - frames.mean(axis=0)
    near = np.mean(centred[:-1] * centred[1:])
    far = np.mean(centred[:-40] * centred[40:])
    assert 0.35 * NETD_COUNTS**2 < near < 0.9 * NETD_COUNTS**2
    assert abs(far) < 0.25 * NETD_COUNTS**2


def test_pattern_grows_with_the_temperature_of_the_array() -> None:
    """Ten minutes of warm-up: the pixel pattern gains 28 mK for each kelvin, the mean 1.5 K."""
    settings = {**QUIET, "drift_pixel_mk": 28.0, "drift_mean_mk": 1500.0, "running_s": 0.0}
    camera = thermal_camera(SHAPE, **settings)
    fpa = FpaTemperature(300.0, ThermalCameraConfig(**settings), 0.0, wander_kelvin=0.0)
    signal = uniform_signal(SHAPE)
    first = camera.expose(signal, 0.0, 0).counts.astype(float)
    last = camera.expose(signal, 600.0, 1).counts.astype(float)
    # The camera was corrected five seconds before the first frame.
    warmer = fpa.kelvin(600.0) - fpa.kelvin(0.0)
    assert 7.0 < warmer < 12.0
    growth = last - first
    assert growth.std() == pytest.approx(28e-3 * 30.0 * warmer, rel=0.06)
    assert growth.mean() == pytest.approx(1.5 * 30.0 * warmer, rel=0.02)


def test_gain_differs_from_pixel_to_pixel_away_from_the_shutter() -> None:
    """The correction hides gain errors at the shutter's temperature and shows them elsewhere."""
    settings = {**QUIET, "gain_percent": 1.0, "warm_up_kelvin": 0.0}
    at_shutter, warm = (film(thermal_camera(SHAPE, **settings), 1, kelvin=k)[0] for k in (300, 330))
    assert at_shutter.std() < 0.6  # rounding
    step = warm.mean() - at_shutter.mean()
    assert 900 < step < 1100
    assert warm.std() == pytest.approx(0.01 * step, rel=0.05)


def test_a_correction_repeats_the_last_frame_and_then_steps() -> None:
    ffc = FfcConfig(mode="periodic", duration_s=0.5, jump_counts=40.0)
    camera = thermal_camera(
        SHAPE, ffc=ffc, corrections_s=(1.0,), **{**QUIET, "netd_mk": 50.0, "fixed_pixel": 1.0}
    )
    signal = uniform_signal(SHAPE)
    readings = [camera.expose(signal, i / 10.0, i) for i in range(30)]
    frames = np.array([r.counts for r in readings])
    for i in range(10, 15):
        np.testing.assert_array_equal(frames[i], frames[9])
        assert readings[i].telemetry.ffc_state is FfcState.IN_PROGRESS
        assert readings[i].correcting
    assert not np.array_equal(frames[9], frames[8])
    assert not np.array_equal(frames[15], frames[9])
    assert readings[15].telemetry.ffc_state is FfcState.COMPLETE
    assert readings[15].telemetry.frames_since_ffc == 0
    assert readings[17].telemetry.time_since_ffc_ns == pytest.approx(0.2e9, abs=1e6)
    before, after = frames[:10].astype(float).mean(0), frames[15:].astype(float).mean(0)
    step = after - before
    assert 2.0 < abs(step.mean()) < 160.0
    # Another residue: the difference of two independent patterns.
    assert step.std() == pytest.approx(np.sqrt(2) * NETD_COUNTS, rel=0.15)


def test_a_correction_before_the_first_frame_shows_nothing() -> None:
    camera = thermal_camera(SHAPE, ffc=FfcConfig(duration_s=0.5), corrections_s=(0.0,))
    assert camera.is_correcting(0.2)
    assert camera.expose(None, 0.2, 2) is None
    assert camera.expose(uniform_signal(SHAPE), 0.6, 6) is not None


def test_dead_pixels_are_filled_stuck_or_jumping() -> None:
    settings = {**QUIET, "netd_mk": 50.0, "stuck_pixels": 5, "flickering_pixels": 4,
                "replaced_percent": 1.0}  # fmt: skip
    frames = film(thermal_camera(SHAPE, **settings), 150)
    spread = frames.std(axis=0)
    assert (spread == 0.0).sum() == 5
    stuck = frames[0][spread == 0.0]
    assert np.all((stuck == 0) | (stuck == HIGHEST_COUNT))
    assert 3 <= (spread > 5 * NETD_COUNTS).sum() <= 4
    filled = (spread > 0) & (spread < 0.85 * NETD_COUNTS)
    # A filled pixel is the mean of two neighbours: its noise is less by the root of two.
    assert 0.7 < filled.sum() / (0.01 * spread.size) < 1.3


def test_the_same_seed_gives_the_same_bits_in_any_order() -> None:
    signal = uniform_signal(SHAPE)
    whole = [thermal_camera(SHAPE).expose(signal, i / 10, i).counts for i in range(4)]
    camera = thermal_camera(SHAPE)
    one_by_one = [camera.expose(signal, i / 10, i).counts for i in range(4)]
    np.testing.assert_array_equal(whole[0], one_by_one[0])
    np.testing.assert_array_equal(whole[3], one_by_one[3])
    other = thermal_camera(SHAPE, seed=2).expose(signal, 0.0, 0).counts
    assert np.mean(other == whole[0]) < 0.5


def test_the_optics_blur_a_point() -> None:
    signal = uniform_signal((41, 41))
    signal[20, 20] += 8000
    camera = thermal_camera((41, 41), **{**QUIET, "blur_px": 0.6})
    counts = camera.expose(signal, 0.0, 0).counts.astype(float)
    counts -= np.median(counts)
    x = np.arange(41) - 20.0
    sigma = np.sqrt((counts.sum(0) * x**2).sum() / counts.sum())
    assert 0.55 < sigma < 0.65
    assert counts.sum() == pytest.approx(1000.0, rel=0.02)


def test_fourteen_bits_are_never_left() -> None:
    camera = thermal_camera(SHAPE, offset_counts=12000.0)
    high = camera.expose(np.full(SHAPE, 65535, np.uint16), 0.0, 0).counts
    assert high.max() == HIGHEST_COUNT
    assert high.dtype == np.uint16


def test_the_kernel_agrees_with_plain_numpy(rng) -> None:
    shape = (13, 17)

    def field(scale: float) -> np.ndarray:
        return rng.normal(0, scale, shape).astype(np.float32)

    arguments = (
        field(5000.0) + 20000, 0.125, field(0.01), 1900.0, field(50.0) + 5000, field(3.0), 1.7,
        -4.0, field(2.0), 0.6, field(1.0), field(1.0), 0.3, field(1.0), 1.5,
        rng.normal(0, 1, 13).astype(np.float32), rng.normal(0, 1, 17).astype(np.float32),
    )  # fmt: skip
    counts = np.empty(shape, np.uint16)
    read_out(*arguments, counts)
    # float32 against float64 may round the other way where a value lies on the border.
    difference = counts.astype(int) - read_out_reference(*arguments).astype(int)
    assert np.abs(difference).max() <= 1
    assert np.mean(difference != 0) < 0.05


def test_smooth_shading_is_smooth_and_normalised(rng) -> None:
    field = smooth_field((60, 80), rng)
    assert abs(field.mean()) < 1e-9
    assert field.std() == pytest.approx(1.0)
    assert np.abs(np.diff(field, axis=1)).max() < 0.3


def test_all_settings_are_in_range_by_default() -> None:
    for config in (ThermalCameraConfig(), FfcConfig()):
        for item in dataclasses.fields(config):
            value, low, high = (
                getattr(config, item.name), item.metadata["minimum"], item.metadata["maximum"]
            )  # fmt: skip
            if low is not None:
                assert low <= value <= high, item.name
