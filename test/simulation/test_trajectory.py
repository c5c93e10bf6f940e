from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.transforms import log_so3
from thermal_stereo_vo.simulation.trajectory import Hover, Leg, Limits, fly, wander

CORNER = (Leg(((40.0, 0.0, 3.0), (40.0, 30.0, 4.0))),)


@pytest.fixture(scope="module")
def flight():
    return fly((0, 0, 3), 0.0, CORNER, Limits(5.0), np.random.default_rng(1), gust_m=0.05)


def times_of(motion, rate_hz=20.0) -> np.ndarray:
    return np.arange(0.0, motion.duration_s, 1.0 / rate_hz)


def test_a_flight_starts_and_ends_at_rest(flight) -> None:
    for t in (0.0, 0.5, 1.0, flight.duration_s):
        assert np.linalg.norm(flight.velocity_m_s(t)) < 1e-3
    np.testing.assert_allclose(flight.T_map_base(0.0)[:3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(flight.T_map_base(-5.0), flight.T_map_base(0.0))
    assert np.linalg.norm(flight.T_map_base(flight.duration_s)[:2, 3] - [40, 30]) < 0.5


def test_limits_are_kept(flight) -> None:
    speed = [np.linalg.norm(flight.velocity_m_s(t)) for t in times_of(flight)]
    assert 4.5 < max(speed) < 5.6
    rate = [np.linalg.norm(flight.angular_velocity_rad_s(t)) for t in times_of(flight)]
    assert 0.3 < max(rate) < 1.6
    acceleration = [np.linalg.norm(flight.acceleration_m_s2(t)) for t in times_of(flight)]
    assert max(acceleration) < 4.0


def test_thrust_carries_gravity_acceleration_and_drag(flight) -> None:
    """What an accelerometer feels lies along the rotors' axis, but for drag."""
    for t in times_of(flight, 2.0):
        R = flight.T_map_base(t)[:3, :3]
        felt = flight.acceleration_m_s2(t) + [0, 0, 9.81] + 0.2 * flight.velocity_m_s(t)
        np.testing.assert_allclose(R.T @ felt, [0, 0, np.linalg.norm(felt)], atol=1e-9)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


def test_it_banks_into_a_left_turn_and_leans_forward(flight) -> None:
    turning = max(times_of(flight), key=lambda t: flight.angular_velocity_rad_s(t)[2])
    assert flight.T_map_base(turning)[2, 1] < -0.03  # the left wing is down
    cruising = times_of(flight)[
        np.argmax([np.linalg.norm(flight.velocity_m_s(t)) for t in times_of(flight)])
    ]
    assert flight.T_map_base(cruising)[2, 0] < -0.05  # the nose is down


def test_derivatives_are_those_of_the_pose(flight) -> None:
    step = 1e-4
    for t in (5.0, 9.0, 12.0):
        before, at, after = (flight.T_map_base(t + d) for d in (-step, 0.0, step))
        np.testing.assert_allclose(
            flight.velocity_m_s(t), (after - before)[:3, 3] / (2 * step), atol=1e-5
        )
        np.testing.assert_allclose(
            flight.acceleration_m_s2(t), (after - 2 * at + before)[:3, 3] / step**2, atol=1e-3
        )
        np.testing.assert_allclose(
            flight.angular_velocity_rad_s(t),
            log_so3(before[:3, :3].T @ after[:3, :3]) / (2 * step),
            atol=1e-4,
        )


def test_motion_is_smooth(flight) -> None:
    rates = np.array([flight.angular_velocity_rad_s(t) for t in times_of(flight, 200.0)])
    assert np.abs(np.diff(rates, axis=0)).max() * 200.0 < 8.0  # rad/s2


def test_length_is_kept_to_a_percent() -> None:
    legs = (Leg(((90.0, 0.0, 3.0), (90.0, 70.0, 4.0), (0.0, 70.0, 3.0), (0.0, 0.0, 3.0))),)
    motion = fly((0, 0, 3), 0.0, legs, Limits(5.0), np.random.default_rng(2), length_m=220.0)
    assert 218.0 < motion.length_m() < 222.5


def test_a_program_too_short_is_refused() -> None:
    with pytest.raises(SimulationError, match=r"ends \d+ m before the wanted length of 200 m"):
        fly((0, 0, 3), 0.0, CORNER, Limits(), np.random.default_rng(1), length_m=200.0)


def test_a_turn_on_the_spot_stays_on_the_spot() -> None:
    motion = fly(
        (1, 2, 3), 0.3, [Hover(2.0, 360.0)], Limits(), np.random.default_rng(1), gust_m=0.0
    )
    yaws = [np.arctan2(*motion.T_map_base(t)[1::-1, 0]) for t in times_of(motion)]
    turned = np.unwrap(yaws)
    assert turned[-1] - turned[0] == pytest.approx(2 * np.pi, abs=1e-3)
    assert motion.length_m() < 1e-6


def test_gusts_are_as_strong_as_asked_for() -> None:
    still, windy = (
        fly((0, 0, 3), 0.0, [Hover(200.0)], Limits(), np.random.default_rng(3), gust_m=g)
        for g in (0.0, 0.2)
    )
    off = np.array(
        [windy.T_map_base(t)[:3, 3] - still.T_map_base(t)[:3, 3] for t in np.arange(10, 190, 0.3)]
    )
    assert np.all(off.std(axis=0) > 0.1)
    assert np.all(off.std(axis=0) < 0.22)


@pytest.mark.parametrize(("speed", "rotation"), [(0.0688, 29.2), (0.1162, 45.0)])
def test_a_hand_held_walk_has_its_mean_speed_and_turn_rate(speed, rotation) -> None:
    motion = wander((0, 0, 1.5), (1.6, 2.0, 0.8), 40.0, speed, rotation, np.random.default_rng(4))
    assert motion.length_m() / 40.0 == pytest.approx(speed, rel=0.03)
    rates = [np.linalg.norm(motion.angular_velocity_rad_s(t)) for t in np.arange(0, 40, 0.11)]
    assert np.degrees(np.mean(rates)) == pytest.approx(rotation, rel=0.05)
    away = [np.abs(motion.T_map_base(t)[:3, 3] - [0, 0, 1.5]) for t in times_of(motion, 4.0)]
    assert np.max(away) < 1.5
