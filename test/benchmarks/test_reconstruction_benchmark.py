"""Models and painted clouds of small simulated worlds against their truth."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.painting import painted_view
from thermal_stereo_vo.benchmarks.reconstruction import measure_model
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.reconstruction.config import ReconstructConfig

SMALL = ("render.scale=0.5", "render.workers=0", "world.density=0.2")


def test_a_short_flight_gives_a_model_near_the_true_surface():
    options = SourceOptions(rate_hz=4.0, length_m=3.0, overrides=SMALL)
    config = with_overrides(
        ReconstructConfig(),
        ["dense.disparities=48", "model.max_range_m=8", "model.keyframe_m=0.2"],
    )
    figures = measure_model(open_simulated("corridor", options), config)
    assert figures.points > 500
    assert 3 <= figures.keyframes <= 30
    assert figures.distance_median_m < 0.1
    assert figures.distance_median_m < figures.distance_p90_m < 1.0
    assert figures.temperature_points > 300
    assert figures.temperature_median_kelvin < 1.0
    assert f"{100 * figures.distance_median_m:.1f} cm" in figures.report()


@pytest.fixture(scope="module")
def office():
    return painted_view("ms-02", 0.3, SMALL)


def test_paint_is_the_temperature_of_the_surface_but_for_the_offset_of_the_camera(office):
    given = np.isfinite(office.painted_kelvin) & ~office.hidden
    error = (office.painted_kelvin - office.true_kelvin)[given]
    assert 0.7 < given.mean() < 1.0
    assert np.median(np.abs(error - np.median(error))) < 0.4
    assert abs(np.median(error)) < 3.0
    # Warm things are warm where they are: radiators, screens, somebody.
    warm = office.true_kelvin[given] > np.median(office.true_kelvin) + 8.0
    assert warm.sum() > 200
    assert np.median(office.painted_kelvin[given][warm]) > np.median(office.true_kelvin) + 6.0


def test_hidden_points_stay_bare(office):
    assert office.hidden.sum() > 20
    wrongly = np.isfinite(office.painted_kelvin[office.hidden]).mean()
    assert wrongly < 0.1
    assert "hidden" in office.report()
