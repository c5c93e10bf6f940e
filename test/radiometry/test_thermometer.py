"""Counts to kelvin and back, and what has no temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.radiometry.thermometer import Thermometer, ThermometerConfig
from thermal_stereo_vo.simulation.thermal_field import PLANCK_B_KELVIN, PLANCK_F, Responsivity

CONFIG = ThermometerConfig(
    planck_r=Responsivity(30.0).planck_r,
    planck_b=PLANCK_B_KELVIN,
    planck_f=PLANCK_F,
    offset_counts=5000.0,
)


def test_temperatures_agree_with_the_curve_of_the_simulator():
    kelvin = np.array([240.0, 280.0, 300.0, 340.0])
    counts = 5000.0 + Responsivity(30.0).counts(kelvin)
    thermometer = Thermometer(CONFIG)
    np.testing.assert_allclose(thermometer.kelvin(counts), kelvin, atol=1e-3)
    np.testing.assert_allclose(thermometer.counts(kelvin), counts, rtol=1e-12)


def test_thirty_counts_are_a_kelvin_at_300():
    thermometer = Thermometer(CONFIG)
    at_300 = float(thermometer.counts(np.array(300.0)))
    step = thermometer.kelvin(np.array([at_300, at_300 + 30.0]))
    assert step[1] - step[0] == pytest.approx(1.0, abs=0.01)


def test_grey_surfaces_are_corrected_for_what_they_reflect():
    grey = Thermometer(replace(CONFIG, emissivity=0.8, surroundings_kelvin=250.0))
    black = Thermometer(CONFIG)
    own, reflected = black.counts(np.array([310.0, 250.0]))
    assert float(grey.kelvin(np.array(0.8 * own + 0.2 * reflected))) == pytest.approx(310, abs=1e-3)
    assert float(black.kelvin(np.array(0.8 * own + 0.2 * reflected))) < 305.0


def test_counts_below_the_offset_have_no_temperature():
    kelvin = Thermometer(CONFIG).kelvin(np.array([[4000, 5000, 9000]], np.uint16))
    np.testing.assert_array_equal(np.isnan(kelvin), [[True, True, False]])
    assert kelvin.dtype == np.float32


def test_without_a_calibration_there_is_no_thermometer():
    assert Thermometer.of(ThermometerConfig()) is None
    assert Thermometer.of(CONFIG) is not None
