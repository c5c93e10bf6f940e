from __future__ import annotations

import itertools

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_so3, log_so3
from thermal_stereo_vo.simulation.navigation import inertial_measurements, satellite_fixes
from thermal_stereo_vo.simulation.schedule import START_NS
from thermal_stereo_vo.simulation.settings import NavigationConfig
from thermal_stereo_vo.simulation.trajectory import Hover, Leg, Limits, fly

PERFECT = NavigationConfig(
    gyro_noise=0.0, gyro_walk=0.0, accelerometer_noise=0.0, accelerometer_walk=0.0,
    gps_noise_m=0.0, gps_wander_m=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def flight():
    return fly((0, 0, 3), 0.0, [Leg(((30.0, 0.0, 3.0), (30.0, 20.0, 3.0)))], Limits(),
               np.random.default_rng(1))  # fmt: skip


def test_the_gyroscope_integrates_to_the_attitude(flight) -> None:
    samples = list(inertial_measurements(flight, 10.0, PERFECT, 0))
    assert samples[0].stamp_ns == START_NS
    assert samples[1].stamp_ns - samples[0].stamp_ns == 5_000_000
    assert len(samples) == 2001
    rates = np.array([s.rate_rad_s for s in samples])
    bias = rates[:50].mean(axis=0)  # at rest
    assert np.linalg.norm(bias) < 0.01
    R = flight.T_map_base(0.0)[:3, :3]
    for before, after in itertools.pairwise(rates):
        R = R @ exp_so3(((before + after) / 2 - bias) / 200.0)
    assert np.linalg.norm(log_so3(R.T @ flight.T_map_base(10.0)[:3, :3])) < 1e-4


def test_the_accelerometer_integrates_to_the_velocity(flight) -> None:
    samples = list(inertial_measurements(flight, 8.0, PERFECT, 0))
    forces = np.array([s.force_m_s2 for s in samples])
    bias = forces[:50].mean(axis=0) - [0, 0, 9.81]
    assert np.linalg.norm(bias) < 0.15
    velocity = np.zeros(3)
    for n, force in enumerate(forces[:-1]):
        R = flight.T_map_base(n / 200.0)[:3, :3]
        velocity += (R @ (force - bias) - [0, 0, 9.81]) / 200.0
    np.testing.assert_allclose(velocity, flight.velocity_m_s(8.0), atol=0.02)


def test_noise_densities_put_in_are_found_again() -> None:
    still = fly((0, 0, 3), 0.0, [Hover(12.0)], Limits(), np.random.default_rng(1), gust_m=0.0)
    config = NavigationConfig(gyro_walk=0.0, accelerometer_walk=0.0)
    samples = list(inertial_measurements(still, 12.0, config, 4))
    rates = np.array([s.rate_rad_s for s in samples])
    forces = np.array([s.force_m_s2 for s in samples])
    assert rates.std(axis=0).mean() == pytest.approx(config.gyro_noise * np.sqrt(200.0), rel=0.05)
    expected = config.accelerometer_noise * np.sqrt(200.0)
    assert forces.std(axis=0).mean() == pytest.approx(expected, rel=0.05)
    walking = list(inertial_measurements(still, 12.0, NavigationConfig(gyro_walk=1e-2), 4))
    assert np.std([s.rate_rad_s[0] for s in walking]) > 3 * rates.std(axis=0).mean()


def test_fixes_lie_where_the_rig_is(flight) -> None:
    fixes = list(satellite_fixes(flight, 10.0, PERFECT, 0))
    assert len(fixes) == 51
    last, first = fixes[-1], fixes[0]
    np.testing.assert_allclose(last.position_m, flight.T_map_base(10.0)[:3, 3], atol=1e-9)
    north = np.radians(last.latitude_deg - first.latitude_deg) * 6378137.0
    east = (
        np.radians(last.longitude_deg - first.longitude_deg)
        * 6378137.0
        * np.cos(np.radians(first.latitude_deg))
    )
    moved = last.position_m - first.position_m
    np.testing.assert_allclose([east, north], moved[:2], atol=1e-3)
    assert last.altitude_m - first.altitude_m == pytest.approx(moved[2])


def test_errors_of_fixes_wander_and_scatter() -> None:
    still = fly((0, 0, 3), 0.0, [Hover(300.0)], Limits(), np.random.default_rng(1), gust_m=0.0)
    config = NavigationConfig(gps_noise_m=0.4, gps_wander_m=1.2)
    error = np.array([f.position_m[:2] for f in satellite_fixes(still, 300.0, config, 5)])
    white = np.diff(error, axis=0).std() / np.sqrt(2)
    assert 0.36 < white < 0.48
    assert 0.5 < np.std([e.mean(axis=0) for e in np.array_split(error, 10)]) < 2.0
