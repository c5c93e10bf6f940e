"""Reading and setting a Tau 2, against a pseudo-terminal that plays it."""

from __future__ import annotations

import struct

import pytest

from thermal_stereo_vo.capture.camera_control import (
    CameraSettings,
    StatusFlags,
    Tau2Control,
    agc_filter_word,
    open_serial,
    parse_agc_roi,
)
from thermal_stereo_vo.capture.cci import CameraControlError, CciPort, Function, RefusedError
from thermal_stereo_vo.core.errors import ConfigError

DO_FFC, SENSOR, ROI = 0x0C, 0x20, 0x4C


@pytest.fixture
def control(pty_camera):
    port = open_serial(pty_camera.port, 57600)
    yield Tau2Control(CciPort(port, timeout_s=240.0, reply_s=240.0))
    port.close()


def written(camera):
    """What was sent with data, questions left out."""
    return [
        (function, data.hex())
        for function, data in camera.received
        if data and function != SENSOR and not (function == ROI and len(data) == 2)
    ]


def test_identity(control):
    assert str(control.identity()) == "serial 12345, sensor 67890, software 2.7, firmware 3.1"


def test_temperatures(control, pty_camera):
    assert control.fpa_temperature_kelvin() == pytest.approx(298.45)
    assert control.housing_temperature_kelvin() == pytest.approx(304.35)
    pty_camera.sensors[0x00] = -105
    assert control.fpa_temperature_kelvin() == pytest.approx(262.65)
    pty_camera.refused[SENSOR] = 0x03
    assert control.housing_temperature_kelvin() is None
    with pytest.raises(RefusedError, match="range error"):
        control.fpa_temperature_kelvin()


def test_flags(control, pty_camera):
    pty_camera.sensors[0x11] = 0b0010_0101
    flags = control.flags()
    assert StatusFlags.OVER_TEMPERATURE in flags
    assert flags.asks_for_ffc
    assert flags.asks_for_long_ffc
    pty_camera.sensors[0x11] = 0b0000_0100
    assert control.flags().asks_for_ffc
    assert not control.flags().asks_for_long_ffc
    pty_camera.sensors[0x11] = 0b0000_0001
    assert not control.flags().asks_for_ffc


def test_a_correction_is_seen_through_the_flag(control, pty_camera):
    pty_camera.blocked_during_ffc = False
    control.do_ffc(long=True)
    assert pty_camera.received == [(DO_FFC, b"\0\1")]
    assert StatusFlags.FFC_IN_PROGRESS in control.flags()


def test_settings_are_written_where_they_differ_and_read_back(control, pty_camera):
    settings = CameraSettings(
        gain_mode="high",
        agc_type="linear",
        agc_filter="16",
        external_sync="right_master",
        lvds_output="14_bit",
        xp_output="bt656",
        video_standard="NTSC_30",
        zoom="1x",
        ffc_warn_frames=0,
    )
    changes = control.configure(settings, "left")
    assert changes == (
        "GAIN_MODE 0 -> 2",
        "DIGITAL_OUTPUT 2 -> 0",
        "AGC_TYPE 0 -> 5",
        "AGC_FILTER 64 -> 16",
        "EXTERNAL_SYNC 0 -> 1",
        "FFC_WARN_TIME 60 -> 0",
        "XP output 0 -> 1",
    )
    assert pty_camera.registers[0x0A] == b"\0\2"
    assert pty_camera.xp == 1
    pty_camera.received.clear()
    assert control.configure(settings, "left") == ()
    assert written(pty_camera) == [(0x12, "0200")]  # the question for the XP bus


@pytest.mark.parametrize(
    ("setting", "left", "right"),
    [("disabled", 0, 0), ("slaves", 1, 1), ("left_master", 2, 1), ("right_master", 1, 2)],
)
def test_who_gives_the_pulse(control, pty_camera, setting, left, right):
    for camera, word in (("left", left), ("right", right)):
        control.configure(CameraSettings(external_sync=setting), camera)
        assert pty_camera.registers[0x21] == bytes([0, word])


def test_keep_touches_nothing(control, pty_camera):
    assert control.configure(CameraSettings(), "left") == ()
    assert pty_camera.received == []


def test_a_value_that_does_not_stick_is_reported(control, pty_camera):
    pty_camera.stuck.add(0x21)
    with pytest.raises(CameraControlError, match="EXTERNAL_SYNC was set to 2 but reads 0"):
        control.configure(CameraSettings(external_sync="left_master"), "left")


def test_agc_region_of_newer_firmware_keeps_the_other_zooms(control, pty_camera):
    pty_camera.regions = struct.pack(">12h", -320, -240, 320, 240, *range(8))
    changes = control.configure(CameraSettings(agc_roi="-320,0,320,240"), "left")
    assert changes == ("AGC_ROI (-320, -240, 320, 240) -> (-320, 0, 320, 240)",)
    assert pty_camera.regions == struct.pack(">12h", -320, 0, 320, 240, *range(8))


def test_agc_region_of_older_firmware(control, pty_camera):
    pty_camera.regions = struct.pack(">8h", -320, -240, 320, 240, *range(4))
    control.configure(CameraSettings(agc_roi="-320,0,320,240"), "left")
    assert written(pty_camera) == [(ROI, struct.pack(">4h", -320, 0, 320, 240).hex())]
    assert pty_camera.regions == struct.pack(">8h", -320, 0, 320, 240, *range(4))


def test_agc_region_out_of_the_image():
    assert parse_agc_roi(CameraSettings()) is None
    for text in ("0,0,0,10", "-400,0,320,240", "10,10,5,20", "1,2,3", "a,b,c,d"):
        with pytest.raises(ConfigError, match="agc_roi"):
            parse_agc_roi(CameraSettings(agc_roi=text))


@pytest.mark.parametrize(
    ("text", "firmware", "word"),
    [
        ("keep", "unknown", None),
        ("16", "unknown", 16),
        ("immediate", "before_2_7", 0),
        ("immediate", "2_7", 255),
        ("frozen", "2_7", 0),
    ],
)
def test_agc_filter_by_firmware(text, firmware, word):
    assert agc_filter_word(CameraSettings(agc_filter=text, firmware=firmware)) == word


@pytest.mark.parametrize(
    ("text", "firmware", "answer"),
    [
        ("immediate", "unknown", "needs 'firmware'"),
        ("frozen", "before_2_7", "unknown to firmware before 2.7"),
        ("0", "2_7", "must be keep, immediate, frozen or a number from 1 to 254"),
        ("255", "2_7", "must be keep"),
        ("fast", "2_7", "must be keep"),
    ],
)
def test_an_agc_filter_of_uncertain_meaning_is_refused(text, firmware, answer):
    with pytest.raises(ConfigError, match=answer):
        agc_filter_word(CameraSettings(agc_filter=text, firmware=firmware))


def test_who_decides_on_corrections(control, pty_camera):
    control.set_ffc_automatic(False)
    assert pty_camera.registers[0x0B] == b"\0\0"
    control.set_ffc_automatic(True)
    assert pty_camera.registers[0x0B] == b"\0\1"


def test_shutter(control, pty_camera):
    control.close_shutter()
    control.open_shutter()
    control.open_shutter()
    assert written(pty_camera) == [(0x79, "0001"), (0x79, "0000"), (0x79, "0000")]
    pty_camera.stuck.add(0x79)
    with pytest.raises(CameraControlError, match="SHUTTER_POSITION was set to 1 but reads 0"):
        control.close_shutter()


def test_the_report_holds_the_camera_s_own_defaults(control, pty_camera):
    pty_camera.refused[0x3E] = 0x0A
    report = control.report()
    assert report["ffc_period_frames"] == "5400"
    assert report["ffc_temperature_delta_decikelvin"] == "10"
    assert report["gain_mode"] == "auto"
    assert report["agc_filter"] == "the camera refuses AGC_FILTER: feature not enabled"
    assert not any(data for _, data in pty_camera.received)


def test_an_answer_without_a_value_is_not_taken_for_zero(control, pty_camera):
    pty_camera.registers[0x0A] = b""
    with pytest.raises(CameraControlError, match="answers GAIN_MODE with 0 bytes"):
        control.report()


def test_every_function_in_use_is_known_to_the_white_list():
    from thermal_stereo_vo.capture.cci import WHITE_LIST

    assert set(WHITE_LIST) == set(Function)
