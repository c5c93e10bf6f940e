from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, THERMAL, VISIBLE
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation.presets import all_presets, find_preset, plan_run
from thermal_stereo_vo.simulation.preview import GALLERY
from thermal_stereo_vo.simulation.town import height_m

TABLE_IV = {
    "seq1": (687, "cloudy_day"), "seq2": (497, "foggy_day"), "seq3": (701, "foggy_day"),
    "seq4": (460, "cloudy_day"), "seq5": (882, "cloudy_day"), "seq6": (489, "clear_cold_night"),
    "seq7": (399, "cloudy_night"), "seq8": (314, "cloudy_night"), "seq9": (655, "cloudy_night"),
}  # fmt: skip
TABLE_I = {"ms-01": (113.81, 29.2), "ms-04": (102.44, 39.5), "ms-07": (60.94, 31.7)}


def plan_of(name: str, *overrides: str):
    return plan_run(name, with_overrides(find_preset(name).config, overrides))


@pytest.mark.parametrize("name", list(TABLE_IV))
def test_the_nine_flights_are_those_of_table_iv(name: str) -> None:
    length_m, weather = TABLE_IV[name]
    plan = plan_of(name)
    assert plan.motion.length_m() == pytest.approx(length_m, rel=0.01)
    assert plan.weather.name == weather
    assert plan.roles == (LEFT, RIGHT)
    poses = np.array([plan.motion.T_map_base(t) for t in np.arange(0, plan.motion.duration_s, 0.5)])
    above = poses[:, 2, 3] - height_m(poses[:, 0, 3], poses[:, 1, 3])
    assert np.all(above > 1.9), "the rig scrapes along the cars"
    assert np.all(above < 7.0)


def test_the_clear_night_is_the_coldest() -> None:
    air = {name: plan_of(name).weather.air_kelvin for name in TABLE_IV}
    assert min(air, key=air.get) == "seq6"
    assert air["seq5"] > air["seq1"] + 10.0


@pytest.mark.parametrize("name", list(TABLE_I))
def test_hand_held_paths_are_those_of_table_i(name: str) -> None:
    duration_s, rotation = TABLE_I[name]
    plan = plan_of(name)
    assert plan.motion.duration_s == pytest.approx(duration_s)
    assert plan.roles == (VISIBLE, THERMAL)
    times = np.arange(0.0, duration_s, 0.1)
    rates = [np.linalg.norm(plan.motion.angular_velocity_rad_s(t)) for t in times]
    assert np.degrees(np.mean(rates)) == pytest.approx(rotation, rel=0.05)


def test_every_preset_can_be_planned_and_says_what_it_is() -> None:
    presets = all_presets()
    names = [preset.name for preset in presets]
    assert len(set(names)) == len(names)
    assert {
        "demo",
        "hover",
        "turn",
        "quick_turn",
        "ffc",
        "hot_arm",
        "corridor",
        "blackbody",
    } <= set(names)
    for preset in presets:
        plan = plan_of(preset.name)
        assert plan.motion.duration_s > 0.5
        assert preset.summary


@pytest.mark.parametrize(("name", "wanted_deg_s"), [("turn", 34.0), ("quick_turn", 60.0)])
def test_turns_reach_their_rate_as_a_quadrotor_can(name: str, wanted_deg_s: float) -> None:
    motion = plan_of(name, "flight.gust_m=0").motion
    times = np.arange(0.0, motion.duration_s, 0.05)
    yaw_rates = np.degrees([motion.angular_velocity_rad_s(t)[2] for t in times])
    assert yaw_rates.max() == pytest.approx(wanted_deg_s, rel=0.04)
    assert np.abs(np.gradient(yaw_rates, times)).max() < 60.0  # deg/s2
    assert np.sum(yaw_rates) * 0.05 == pytest.approx(360.0, abs=1.0)


def test_length_and_speed_may_be_chosen() -> None:
    plan = plan_of("seq4", "flight.length_m=100", "flight.speed_m_s=2.5")
    assert plan.motion.length_m() == pytest.approx(100.0, rel=0.015)
    assert 38.0 < plan.motion.duration_s < 65.0


def test_a_long_flight_goes_round_again() -> None:
    assert plan_of("seq8", "flight.length_m=800").motion.length_m() == pytest.approx(800, rel=0.01)


def test_the_demo_is_long_enough_and_has_one_correction() -> None:
    from thermal_stereo_vo.simulation.simulation import Simulation

    simulation = Simulation("demo", find_preset("demo").config)
    assert simulation.ground_truth().path_lengths_m[-1] > 60.0
    assert len(simulation.corrections_s(0)) == len(simulation.corrections_s(1)) == 1
    assert simulation.instants < 260


def test_an_unknown_preset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(SimulationError, match=r"no preset 'seq10': choose one of seq1, seq2"):
        find_preset("seq10")


def test_only_what_changes_pictures_changes_their_key() -> None:
    key = plan_of("hover").picture_key()
    for same in ("thermal.netd_mk=80", "ffc.mode=periodic", "render.workers=0",
                 "timing.hidden=true", "thermal.output=agc",
                 "navigation.gyro_noise=0"):  # fmt: skip
        assert plan_of("hover", same).picture_key() == key, same
    for other in ("thermal.time_constant_ms=5", "world.weather=sunny_day", "flight.seed=2",
                  "render.lag=none", "timing.skew_ms=3", "rate_hz=20"):  # fmt: skip
        assert plan_of("hover", other).picture_key() != key, other


def test_the_gallery_shows_every_preset_once() -> None:
    shown = [name for presets in GALLERY.values() for name in presets]
    assert sorted(shown) == sorted(preset.name for preset in all_presets())


def test_critical_motions_are_straight_ahead_and_nothing() -> None:
    still, forward = plan_of("ms-still").motion, plan_of("ms-forward").motion
    times = np.arange(0.0, 12.0, 0.25)
    np.testing.assert_array_equal([still.T_map_base(t) for t in times], [still.T_map_base(0)] * 48)
    poses = np.array([forward.T_map_base(t) for t in times])
    np.testing.assert_allclose(poses[:, :3, :3], np.tile(np.eye(3), (48, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(poses[:, 1:3, 3], poses[:1, 1:3, 3].repeat(48, axis=0), atol=1e-9)
    assert 1.5 < poses[-1, 0, 3] - poses[0, 0, 3] < 1.85
    assert np.all(np.diff(poses[8:, 0, 3]) > 0.03)


def test_the_flight_at_dusk_is_long_enough_and_has_two_bands() -> None:
    plan = plan_of("ms-dusk")
    assert plan.motion.length_m() > 300.0
    assert plan.roles == (VISIBLE, THERMAL)
    assert plan.weather.illumination == 0.01


def test_another_rig_may_be_carried_along_a_path() -> None:
    preset, stereo = plan_of("ms-01"), plan_of("ms-01", "rig=stereo")
    assert stereo.roles == (LEFT, RIGHT)
    assert plan_of("seq8", "rig=visible_thermal").roles == (VISIBLE, THERMAL)
    np.testing.assert_array_equal(stereo.motion.T_map_base(9.0), preset.motion.T_map_base(9.0))
    assert stereo.picture_key() != preset.picture_key()
