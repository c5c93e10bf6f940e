from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.odometry.feature_count import fast_hessian_counter
from thermal_stereo_vo.simulation.image_statistics import (
    gradient_magnitude,
    power_spectrum,
    statistics_of,
)
from thermal_stereo_vo.simulation.realism import (
    pattern_table,
    recorded_samples,
    spread_verdict,
    statistics_table,
)


def coloured_noise(exponent: float, side: int = 256) -> np.ndarray:
    """An image whose power falls with this exponent of the frequency."""
    rng = np.random.default_rng(4)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    frequency[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((side, side))) * frequency ** (exponent / 2)
    image = np.fft.ifft2(spectrum).real
    return np.clip(128 + 40 * image / image.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("exponent", [-1.0, -2.0, -3.0])
def test_the_slope_put_in_is_found_again(exponent: float) -> None:
    found = statistics_of(coloured_noise(exponent), lambda _: 0)
    assert found.spectral_slope == pytest.approx(exponent, abs=0.2)


def test_a_wave_shows_at_its_frequency() -> None:
    x = np.arange(256)
    wave = (128 + 60 * np.sin(2 * np.pi * 0.125 * x) * np.ones((256, 1))).astype(np.uint8)
    frequency, power = power_spectrum(wave)
    assert frequency[np.argmax(power)] == pytest.approx(0.125, rel=0.08)


def test_gradients_are_in_grey_levels_a_pixel() -> None:
    ramp = np.tile(np.arange(0, 200, 2, dtype=np.uint8), (50, 1))
    inner = gradient_magnitude(ramp)[5:-5, 5:-5]
    np.testing.assert_allclose(inner, 2.0, atol=1e-5)
    found = statistics_of(np.full((64, 64), 100, np.uint8), lambda _: 0)
    assert found.flat_percent == 100.0


def test_blobs_are_counted() -> None:
    y, x = np.mgrid[:240, :320]
    image = np.full((240, 320), 60.0)
    places = [(px, py) for px in range(40, 300, 40) for py in range(40, 220, 40)]
    for px, py in places:
        image += 120 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 4.0**2))
    count = fast_hessian_counter(50.0)(image.astype(np.uint8))
    assert len(places) <= count < 2.5 * len(places)
    assert fast_hessian_counter(50.0)(np.full((240, 320), 60, np.uint8)) == 0


def test_recordings_are_measured_and_compared(recording) -> None:
    data = recording("tau2_stills").parent
    samples = recorded_samples(data, fast_hessian_counter(5.0))
    assert samples[0].name == "tau2_stills"
    assert len(samples[0].views) == 20
    assert 100 < np.median(samples[0].values("features")) < 250
    assert "real: tau2_stills" in statistics_table(samples)


def test_the_simulated_pattern_grows_as_that_of_a_real_core(recording) -> None:
    """The parts of the pattern stand in the proportions of a real core, within 20 %."""
    table = pattern_table(recording("flat_fields_fpa").parent)
    rows = {line.split("  ")[0].strip(): line.split()[-4:] for line in table.splitlines()[3:5]}
    real, simulated = (np.array(rows[name], float) for name in ("real core", "simulated"))
    np.testing.assert_allclose(simulated, real, rtol=0.2)


def test_without_the_reference_there_is_no_verdict() -> None:
    assert "not there to compare with" in spread_verdict([])
