"""When which camera corrects itself."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.capture.camera_control import NO_FLAGS, StatusFlags
from thermal_stereo_vo.capture.ffc_policy import FfcConfig, FfcPolicy

S = 1_000_000_000
START = 5000 * S
FFC = StatusFlags.FFC_DESIRED
TABLE = StatusFlags.TABLE_SWITCH_DESIRED


def policy(**settings):
    defaults = {"period_s": 100.0, "temperature_delta_kelvin": 0.0, "force_after_s": 20.0}
    return FfcPolicy(FfcConfig(**(defaults | settings)), ("left", "right"), START)


def simulate(rules, seconds, *, duration_s=1, flags=None, kelvin=None, each_second=None):
    """Both cameras asked every second; returns (second, camera, order) of each correction."""
    orders, running = [], {}
    for second in range(seconds):
        now_ns = START + second * S
        if each_second is not None:
            each_second(second, now_ns)
        for camera in ("left", "right"):
            if camera in running and second - running[camera] >= duration_s:
                del running[camera]
                rules.finished(camera, now_ns, done=True)
            if camera not in running:
                seen = flags(second, camera) if flags else NO_FLAGS
                rules.observe(camera, now_ns, seen, kelvin(second, camera) if kelvin else None)
                order = rules.take_order(camera, now_ns)
                if order:
                    orders.append((second, camera, order))
                    running[camera] = second
    return orders


def test_staggered_by_half_a_period():
    orders = simulate(policy(), 260)
    assert [(second, camera) for second, camera, _ in orders] == [
        (50, "right"),
        (100, "left"),
        (151, "right"),
        (201, "left"),
        (252, "right"),
    ]
    assert {order.reason for *_, order in orders} == {"period"}
    assert not any(order.long for *_, order in orders)


def test_together_in_one_gap():
    orders = simulate(policy(schedule="together"), 210)
    assert [(second, camera) for second, camera, _ in orders] == [
        (100, "left"),
        (100, "right"),
        (201, "left"),
        (201, "right"),
    ]
    assert orders[1][2].reason == "together with the other camera"


@given(st.lists(st.tuples(st.integers(1, 90), st.sampled_from(["left", "right"])), max_size=8))
def test_staggered_cameras_are_never_blind_at_once_or_in_quick_succession(wishes):
    asks = {camera: set() for camera in ("left", "right")}
    for second, camera in wishes:
        asks[camera].update(range(second, second + 5))
    rules = policy(separation_s=3.0, period_s=40.0)
    orders = simulate(
        rules, 100, duration_s=2, flags=lambda s, camera: FFC if s in asks[camera] else NO_FLAGS
    )
    assert orders
    for (first, camera, _), (second, other, _) in itertools.pairwise(orders):
        if camera != other:
            assert second - first >= 2 + 3


def test_temperature_calls_for_a_correction():
    rules = policy(period_s=0.0, temperature_delta_kelvin=0.5)
    orders = simulate(rules, 100, kelvin=lambda s, camera: 300.0 + 0.02 * s * (camera == "left"))
    assert [(second, camera, order.reason) for second, camera, order in orders][:2] == [
        (25, "left", "temperature"),
        (50, "left", "temperature"),
    ]
    assert {camera for _, camera, _ in orders} == {"left"}


def test_what_the_camera_asks_for_is_given_long_where_only_that_helps():
    rules = policy(period_s=0.0)
    orders = simulate(rules, 20, flags=lambda s, c: TABLE if (s, c) == (4, "right") else NO_FLAGS)
    assert [(s, c, o.long, o.reason) for s, c, o in orders] == [
        (4, "right", True, "the camera asks for it")
    ]
    rules = policy(period_s=0.0)
    orders = simulate(rules, 20, flags=lambda s, c: FFC if (s, c) == (4, "right") else NO_FLAGS)
    assert [o.long for *_, o in orders] == [False]


def test_inhibited_while_renewed_then_the_watchdog_lets_go():
    rules = policy(period_s=30.0, inhibit_limit_s=10.0)

    def hold(second, now_ns):
        if second <= 50 and second % 5 == 0:
            rules.inhibit(now_ns)

    orders = simulate(rules, 70, each_second=hold)
    assert orders[0][0] == 60


def test_release_ends_an_inhibition_at_once():
    rules = policy(period_s=30.0)

    def act(second, now_ns):
        if second < 40:
            rules.inhibit(now_ns)
        elif second == 40:
            rules.release()

    assert simulate(rules, 60, each_second=act)[0][0] == 40


@pytest.mark.parametrize("authority", ["host", "camera"])
def test_a_camera_that_asks_too_long_gets_it_in_spite_of_an_inhibition(authority):
    rules = policy(period_s=0.0, authority=authority)
    orders = simulate(
        rules,
        40,
        flags=lambda s, camera: FFC if s >= 5 and camera == "left" else NO_FLAGS,
        each_second=lambda s, now_ns: rules.inhibit(now_ns),
    )
    assert orders[0][:2] == (25, "left")
    assert orders[0][2].reason == "the camera has asked for 20 s"


def test_a_request_goes_before_an_inhibition_but_not_side_by_side():
    rules = policy(period_s=0.0, separation_s=3.0)

    def act(second, now_ns):
        rules.inhibit(now_ns)
        if second == 7:
            rules.request()

    orders = simulate(rules, 20, each_second=act)
    assert [(s, c, o.reason) for s, c, o in orders] == [
        (7, "left", "requested"),
        (11, "right", "requested"),
    ]


def test_one_camera_can_be_asked_for():
    rules = policy(period_s=0.0, authority="none")
    orders = simulate(rules, 20, each_second=lambda s, _: s == 3 and rules.request("right"))
    assert [(s, c) for s, c, _ in orders] == [(3, "right")]


def test_the_camera_s_own_mode_is_on_unless_inhibited():
    rules = policy(authority="camera")
    assert rules.camera_may_decide(START)
    rules.inhibit(START)
    assert not rules.camera_may_decide(START + S)
    assert rules.camera_may_decide(START + 31 * S)
    assert not policy(authority="host").camera_may_decide(START)
    assert simulate(policy(authority="camera"), 300) == []


def test_a_failed_correction_is_tried_again_later():
    rules = policy(period_s=10.0)
    rules.observe("left", START, NO_FLAGS, None)
    assert rules.take_order("left", START + 10 * S)
    assert rules.take_order("left", START + 11 * S) is None
    rules.finished("left", START + 12 * S, done=False)
    assert rules.take_order("left", START + 13 * S) is None
    assert rules.take_order("left", START + 17 * S)
