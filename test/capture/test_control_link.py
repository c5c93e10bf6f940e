"""The control of a live camera: connection, telemetry, corrections, and a line that dies."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from thermal_stereo_vo.capture.camera_control import CameraSettings
from thermal_stereo_vo.capture.cci import WHITE_LIST
from thermal_stereo_vo.capture.control_link import ControlConfig, ControlLink
from thermal_stereo_vo.capture.ffc_policy import FfcConfig, FfcPolicy
from thermal_stereo_vo.core.frames import FfcState

# Long enough that a busy machine does not pass for a silent camera.
CONFIG = ControlConfig(timeout_s=10.0, poll_period_s=0.02, reopen_s=0.05, stale_s=120.0)
DO_FFC, FFC_MODE, SHUTTER = 0x0C, 0x0B, 0x79


@pytest.fixture
def connect():
    """Start the control of cameras under one policy; stopped after the test."""
    links = []

    def start(cameras, settings=None, control=CONFIG, **ffc):
        defaults = {"period_s": 0.0, "settle_s": 0.02, "duration_s": 0.1, "limit_s": 60.0}
        config = FfcConfig(**(defaults | ffc))
        policy = FfcPolicy(config, tuple(cameras), time.monotonic_ns())
        started = {
            name: ControlLink(
                name, camera.port, control, settings or CameraSettings(), config, policy
            )
            for name, camera in cameras.items()
        }
        links.extend(started.values())
        for link in started.values():
            link.start()
        return started, policy

    yield start
    for link in links:
        link.stop()


@pytest.fixture
def one(connect, pty_camera, eventually):
    links, policy = connect({"left": pty_camera})
    eventually(lambda: links["left"].status().connected, links["left"].status)
    return links["left"], policy


def telemetry(link):
    return link.telemetry(time.monotonic_ns())


def test_what_the_camera_says_goes_out_with_the_frames(one, eventually):
    link, _ = one
    eventually(lambda: link.status().fpa_temperature_kelvin is not None)
    eventually(lambda: telemetry(link).ffc_state is not None)
    said = telemetry(link)
    assert said.fpa_temperature_kelvin == pytest.approx(298.45)
    assert said.housing_temperature_kelvin == pytest.approx(304.35)
    assert said.ffc_state is FfcState.NONE
    assert said.time_since_ffc_ns is None
    assert link.status().identity.startswith("serial 12345")
    assert link.status().settings["ffc_period_frames"] == "5400"


def test_a_camera_under_the_host_is_set_to_manual(one, pty_camera, eventually):
    eventually(lambda: pty_camera.registers[FFC_MODE] == b"\0\0")


def test_a_camera_under_itself_is_inhibited_by_switching_to_manual(connect, pty_camera, eventually):
    pty_camera.registers[FFC_MODE] = b"\0\0"
    _, policy = connect({"left": pty_camera}, authority="camera", inhibit_limit_s=0.3)
    eventually(lambda: pty_camera.registers[FFC_MODE] == b"\0\1")
    policy.inhibit(time.monotonic_ns())
    eventually(lambda: pty_camera.registers[FFC_MODE] == b"\0\0")
    eventually(lambda: pty_camera.registers[FFC_MODE] == b"\0\1")


def test_an_inhibition_does_not_outlive_the_program(connect, pty_camera, eventually):
    links, policy = connect({"left": pty_camera}, authority="camera")
    eventually(lambda: links["left"].status().connected)
    policy.inhibit(time.monotonic_ns())
    eventually(lambda: pty_camera.registers[FFC_MODE] == b"\0\0")
    links["left"].stop()
    assert pty_camera.registers[FFC_MODE] == b"\0\1"


def test_a_camera_left_alone_keeps_its_mode(connect, pty_camera, eventually):
    links, _ = connect({"left": pty_camera}, authority="none")
    eventually(lambda: telemetry(links["left"]) is not None)
    assert (FFC_MODE, b"\0\0") not in pty_camera.received
    assert pty_camera.registers[FFC_MODE] == b"\0\1"


@pytest.mark.parametrize("blocked", [True, False])
def test_frames_are_marked_from_before_the_order_until_after_the_end(
    one, pty_camera, eventually, blocked
):
    link, policy = one
    pty_camera.blocked_during_ffc = blocked
    pty_camera.ffc_s = 0.5
    states = []
    policy.request("left")

    def complete():
        before, said, after = pty_camera.correcting, telemetry(link), pty_camera.correcting
        states.append((before and after, said.ffc_state, said.time_since_ffc_ns))
        return said.ffc_state is FfcState.COMPLETE

    eventually(complete, link.status)
    assert 0 <= states[-1][2] < 60e9
    assert any(correcting for correcting, *_ in states)
    assert all(state is FfcState.IN_PROGRESS for correcting, state, _ in states if correcting)
    status = link.status()
    assert (status.ffc_count, status.ffc_failures, status.ffc_reason) == (1, 0, "requested")
    assert pty_camera.functions().count(DO_FFC) == 1


def test_a_correction_that_never_ends_is_a_failure(connect, pty_camera, eventually):
    links, policy = connect({"left": pty_camera}, limit_s=0.3)
    link = links["left"]
    eventually(lambda: link.status().connected)
    pty_camera.ffc_s = 3600.0
    policy.request("left")
    eventually(lambda: link.status().ffc_failures == 1, link.status)
    assert link.status().ffc_count == 0


def test_the_camera_s_own_correction_is_seen_in_its_flag(connect, pty_camera, eventually):
    links, _ = connect({"left": pty_camera}, authority="camera")
    link = links["left"]
    eventually(lambda: link.status().connected)
    pty_camera.sensors[0x11] = 1 << 2
    eventually(lambda: link.status().ffc_state is FfcState.IMMINENT)
    pty_camera.sensors[0x11] = 1 << 6
    eventually(lambda: link.status().ffc_state is FfcState.IN_PROGRESS)
    pty_camera.sensors[0x11] = 0
    eventually(lambda: link.status().ffc_state is FfcState.COMPLETE)
    assert link.status().ffc_count == 1
    assert DO_FFC not in pty_camera.functions()


def test_two_cameras_are_not_blind_at_once(connect, two_pty_cameras, eventually):
    camera_ffc_s = two_pty_cameras["left"].ffc_s
    links, policy = connect(two_pty_cameras, separation_s=0.2)
    eventually(lambda: all(link.status().connected for link in links.values()))
    policy.request()
    both_blind = []

    def both_corrected():
        both_blind.append(all(camera.correcting for camera in two_pty_cameras.values()))
        return all(link.status().ffc_count for link in links.values())

    eventually(both_corrected, lambda: [link.status() for link in links.values()])
    assert not any(both_blind)
    orders = {name: camera.ordered_s for name, camera in two_pty_cameras.items()}
    assert all(len(moments) == 1 for moments in orders.values())
    assert abs(orders["left"][0] - orders["right"][0]) >= camera_ffc_s + 0.2


def test_silence_is_unknown_and_is_recovered_from(connect, pty_camera, eventually):
    impatient = replace(CONFIG, timeout_s=0.3, stale_s=0.5)
    links, _ = connect({"left": pty_camera}, control=impatient)
    link = links["left"]
    eventually(lambda: link.status().connected, link.status)
    pty_camera.silent = True
    eventually(lambda: not link.status().connected, link.status)
    assert "does not answer" in link.status().reason
    eventually(lambda: telemetry(link) is None)
    assert link.status().ffc_state is None
    pty_camera.silent = False
    eventually(lambda: link.status().connected, link.status)
    eventually(lambda: telemetry(link) is not None)


def test_a_port_that_is_missing_is_waited_for(connect, pty_camera, eventually, tmp_path):
    class Absent:
        port = str(tmp_path / "left")

    links, _ = connect({"left": Absent})
    eventually(lambda: "cannot be opened" in links["left"].status().reason)
    (tmp_path / "left").symlink_to(pty_camera.port)
    eventually(lambda: links["left"].status().connected, links["left"].status)


def test_a_shutter_that_does_not_open_is_told_and_the_control_goes_on(
    one, pty_camera, eventually, caplog
):
    link, _ = one
    pty_camera.registers[SHUTTER] = b"\0\1"
    pty_camera.stuck.add(SHUTTER)
    link.open_shutter()
    eventually(lambda: "SHUTTER_POSITION was set to 0 but reads 1" in caplog.text)
    pty_camera.refused[SHUTTER] = 0x0A
    link.open_shutter()
    eventually(lambda: "refuses SHUTTER_POSITION" in caplog.text)
    heard_ns = link.status().heard_ns
    eventually(lambda: link.status().connected and link.status().heard_ns > heard_ns)
    assert pty_camera.functions().count(0x04) == 1  # connected once, and never again


def test_a_bad_line_brings_nothing_to_a_halt_and_nothing_off_the_list_is_sent(
    one, pty_camera, eventually
):
    link, policy = one
    moods = [
        {"busy_replies": 3},
        {"bad_crc_replies": 3},
        {"garbage": b"\x6e\x00\x00"},
        {"cut_s": 0.05},
        {"delay_s": 0.05},
    ]
    for mood in moods:
        policy.request("left")
        vars(pty_camera).update(mood)
        time.sleep(0.15)
    pty_camera.garbage, pty_camera.cut_s, pty_camera.delay_s = b"", 0.0, 0.0
    heard_ns = link.status().heard_ns
    eventually(lambda: link.status().connected and link.status().heard_ns > heard_ns, link.status)
    assert all(WHITE_LIST[function].permits(data) for function, data in pty_camera.received)
