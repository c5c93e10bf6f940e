"""The serial protocol: packets, the white list, and a line that misbehaves."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.capture.camera_control import open_serial
from thermal_stereo_vo.capture.cci import (
    WHITE_LIST,
    BusyError,
    CameraControlError,
    CciPort,
    Function,
    NoReplyError,
    RefusedError,
    Reply,
    ReplyParser,
    crc16,
    encode,
)

PATIENCE_S = 240.0

# The first two stand in the Tau User's Manual (B.5); the others follow its rule.
PACKETS = """
FFC auto            0b 0001  6e 00 00 0b 00 02 0f 08 00 01 10 21
get FFC mode        0b -     6e 00 00 0b 00 00 2f 4a 00 00
FFC manual          0b 0000  6e 00 00 0b 00 02 0f 08 00 00 00 00
FFC external        0b 0002  6e 00 00 0b 00 02 0f 08 00 02 20 42
DO_FFC              0c -     6e 00 00 0c 00 00 aa da 00 00
DO_FFC short        0c 0000  6e 00 00 0c 00 02 8a 98 00 00 00 00
DO_FFC long         0c 0001  6e 00 00 0c 00 02 8a 98 00 01 10 21
get FFC period      0d -     6e 00 00 0d 00 00 9d ea 00 00
FFC period 5400     0d 1518  6e 00 00 0d 00 02 bd a8 15 18 6f bf
FFC period 0        0d 0000  6e 00 00 0d 00 02 bd a8 00 00 00 00
get FFC delta       0e -     6e 00 00 0e 00 00 c4 ba 00 00
FFC delta 10        0e 000a  6e 00 00 0e 00 02 e4 f8 00 0a a1 4a
FPA temperature     20 0000  6e 00 00 20 00 02 79 3f 00 00 00 00
housing temperature 20 000a  6e 00 00 20 00 02 79 3f 00 0a a1 4a
status flags        20 0011  6e 00 00 20 00 02 79 3f 00 11 02 10
FPA raw             20 0001  6e 00 00 20 00 02 79 3f 00 01 10 21
sync slave          21 0001  6e 00 00 21 00 02 4e 0f 00 01 10 21
sync master         21 0002  6e 00 00 21 00 02 4e 0f 00 02 20 42
AGC linear          13 0005  6e 00 00 13 00 02 e5 ca 00 05 50 a5
AGC manual          13 0003  6e 00 00 13 00 02 e5 ca 00 03 30 63
shutter open        79 0000  6e 00 00 79 00 02 b9 60 00 00 00 00
shutter close       79 0001  6e 00 00 79 00 02 b9 60 00 01 10 21
LVDS 14 bits        12 0000  6e 00 00 12 00 02 d2 fa 00 00 00 00
gain high           0a 0002  6e 00 00 0a 00 02 38 38 00 02 20 42
NO_OP               00 -     6e 00 00 00 00 00 df bb 00 00
get revision        05 -     6e 00 00 05 00 00 34 4b 00 00
"""


@pytest.mark.parametrize("line", PACKETS.strip().splitlines(), ids=lambda line: line[:19].strip())
def test_packets_of_the_manual(line):
    function, data, expected = line[20:22], line[23:28].strip(), line[28:].strip()
    data = b"" if data == "-" else bytes.fromhex(data)
    assert encode(int(function, 16), data).hex(" ") == expected
    assert ReplyParser().feed(bytes.fromhex(expected)) == [Reply(0, int(function, 16), data)]


def test_the_crc_over_everything_is_the_crc_over_the_data():
    # The manual says the first, some drivers do the second.
    data = bytes.fromhex("1518")
    assert crc16(encode(Function.FFC_PERIOD, data)[:-2]) == crc16(data)


@given(
    st.binary(max_size=30),
    st.integers(0, 255),
    st.binary(max_size=20).map(lambda b: b + b),
    st.integers(1, 9),
)
def test_a_packet_is_found_in_garbage_however_it_is_cut(garbage, function, data, step):
    # A header in the garbage would swallow the packet: no process code, no header.
    garbage = garbage.replace(b"\x6e", b"")
    line = garbage + encode(function, data, status=3)
    parser = ReplyParser()
    replies = [r for at in range(0, len(line), step) for r in parser.feed(line[at : at + step])]
    assert replies == [Reply(3, function, data)]
    assert parser.skipped == len(garbage)


@given(st.integers(0, 7), st.integers(0, 11))
def test_a_damaged_packet_is_not_read(bit, byte):
    good = bytearray(encode(Function.FFC_MODE, b"\0\1"))
    good[byte] ^= 1 << bit
    assert ReplyParser().feed(bytes(good)) == []


class Recorder:
    """A port that nobody answers."""

    in_waiting = 0

    def __init__(self):
        self.sent = []

    def read(self, size=1):
        time.sleep(0.001)
        return b""

    def write(self, data):
        self.sent.append(data)
        return len(data)

    def close(self):
        pass


@given(st.integers(0, 255), st.one_of(st.just(b""), st.binary(min_size=2, max_size=2)))
def test_nothing_off_the_white_list_is_sent(function, data):
    port = Recorder()
    error = None
    try:
        CciPort(port, timeout_s=0.0, reply_s=0.0).call(function, data, repeat=False)
    except CameraControlError as raised:
        error = str(raised)
    listed = function in WHITE_LIST and WHITE_LIST[function].permits(data)
    assert bool(port.sent) == listed
    assert ("is not on the white list" in error) != listed


def test_what_changes_the_flash_or_blinds_the_camera_is_not_on_the_white_list():
    for function in (0x01, 0x02, 0x03, 0x07, 0xC6, 0xB1, 0xD4):
        assert function not in WHITE_LIST
    assert not WHITE_LIST[Function.FFC_MODE].permits(b"\0\2")
    assert not WHITE_LIST[Function.VIDEO_MODE].permits(b"\0\1")
    assert not WHITE_LIST[Function.FFC_PERIOD].permits(b"\0\0")


@pytest.fixture
def connect(pty_camera):
    """A port of this patience (s); a busy machine may keep any answer waiting."""
    serial = open_serial(pty_camera.port, 57600)
    yield lambda timeout_s, reply_s: CciPort(serial, timeout_s=timeout_s, reply_s=reply_s)
    serial.close()


@pytest.fixture
def port(connect):
    return connect(PATIENCE_S, PATIENCE_S)


def test_an_answer(port, pty_camera):
    assert port.call(Function.REVISION) == bytes.fromhex("0002000700030001")
    assert pty_camera.received == [(5, b"")]


@pytest.mark.parametrize(
    "mood",
    [
        {"busy_replies": 2},
        {"bad_crc_replies": 1},
        {"garbage": b"\x6e\x00\x6e\x00garbage"},
        {"cut_s": 0.05},
        {"delay_s": 0.1},
    ],
    ids=str,
)
def test_a_bad_line_is_lived_with(connect, pty_camera, mood):
    port = connect(PATIENCE_S, 0.15)
    vars(pty_camera).update(mood)
    assert port.call(Function.GAIN_MODE) == b"\0\0"


@pytest.mark.parametrize(
    ("mood", "timeout_s", "error", "text"),
    [
        ({"silent": True}, 0.6, NoReplyError, "does not answer GAIN_MODE: check power"),
        ({"busy_replies": 10**6}, 3.0, BusyError, "stays busy and does not execute GAIN_MODE"),
        ({"bad_crc_replies": 10**6}, 0.6, NoReplyError, "does not answer"),
        ({"delay_s": 3.0}, 0.6, NoReplyError, "does not answer"),
        ({"refused": {0x0A: 0x0A}}, PATIENCE_S, RefusedError, "GAIN_MODE: feature not enabled"),
        ({"refused": {0x0A: 0x77}}, PATIENCE_S, RefusedError, "status 0x77"),
    ],
    ids=str,
)
def test_a_worse_line_is_reported_within_the_time_out(
    connect, pty_camera, mood, timeout_s, error, text
):
    vars(pty_camera).update(mood)
    began = time.monotonic()
    with pytest.raises(error, match=text):
        connect(timeout_s, 0.15).call(Function.GAIN_MODE)
    # Far from hanging, even on a busy machine; and never before its time.
    took_s = time.monotonic() - began
    assert took_s < timeout_s + 60.0
    assert error is RefusedError or took_s > timeout_s - 0.1


def test_garbage_without_end_does_not_hold_a_call(connect, pty_camera):
    port = connect(0.6, 0.15)
    pty_camera.silent = True
    pty_camera.babble = b"\x6e\x00\x00\x0a" * 20
    for _ in range(2):
        with pytest.raises(NoReplyError):
            port.call(Function.GAIN_MODE)
    pty_camera.silent, pty_camera.babble = False, b""
    for _ in range(3):
        assert port.call(Function.GAIN_MODE, timeout_s=PATIENCE_S) == b"\0\0"


def test_a_late_answer_is_not_taken_for_the_next_one(port, pty_camera):
    pty_camera.delay_s = 2.0
    with pytest.raises(NoReplyError):
        port.call(Function.READ_SENSOR, b"\0\0", repeat=False, timeout_s=0.2)
    pty_camera.delay_s = 0.0
    assert port.call(Function.READ_SENSOR, b"\0\x0a") == (3120).to_bytes(2, "big")


@pytest.mark.parametrize("patience_s", [3.0, 0.2])
def test_answers_to_what_was_asked_again_are_not_taken_for_the_next_ones(
    connect, pty_camera, patience_s
):
    """A correction blocks the line: the question is sent several times, then answered as often."""
    port = connect(PATIENCE_S, 0.1)
    pty_camera.ffc_s = 0.7
    port.call(Function.DO_FFC, b"\0\0", repeat=False)
    answer = None
    while answer is None:
        try:
            answer = port.call(Function.READ_SENSOR, b"\0\x11", timeout_s=patience_s)
        except NoReplyError:
            continue
    for selector, value in ((0x00, 253), (0x0A, 3120), (0x01, 9000), (0x00, 253)):
        answer = port.call(Function.READ_SENSOR, bytes([0, selector]))
        assert int.from_bytes(answer, "big") == value
    assert pty_camera.received.count((0x20, b"\0\x11")) > 1


def test_an_answer_to_another_question_is_passed_over(port, pty_camera):
    pty_camera.garbage = encode(Function.FFC_MODE, b"\0\1")
    assert port.call(Function.GAIN_MODE) == b"\0\0"


def test_an_order_that_must_not_be_given_twice_is_sent_once(port, pty_camera, eventually):
    pty_camera.silent = True
    with pytest.raises(NoReplyError):
        port.call(Function.DO_FFC, b"\0\0", repeat=False, timeout_s=1.0)
    eventually(pty_camera.functions)
    assert pty_camera.functions() == [0x0C]
    pty_camera.silent = False
    assert port.call(Function.GAIN_MODE) == b"\0\0"
    pty_camera.received.clear()
    pty_camera.busy_replies = 1
    port.call(Function.DO_FFC, b"\0\0", repeat=False)
    assert pty_camera.functions() == [0x0C, 0x0C]


def test_a_port_that_is_not_there():
    with pytest.raises(CameraControlError, match="/dev/no_such_port cannot be opened"):
        open_serial("/dev/no_such_port", 57600)
