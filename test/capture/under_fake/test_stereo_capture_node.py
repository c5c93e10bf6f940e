"""The node on two fake devices: topics, services, diagnostics, recording."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from std_srvs.srv import SetBool, Trigger

from thermal_stereo_vo.core.calibration_yaml import dump_camera_info
from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.rosbag import open_bag
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_capture_node import StereoCaptureNode
from thermal_stereo_vo.outputs.bag_writer import BagWriter
from thermal_stereo_vo.outputs.ros_fields import ERROR, OK, WARN, telemetry_from_values

REPOSITORY = Path(__file__).resolve().parents[3]
EYES = ("left", "right")


@pytest.fixture
def calibration(tmp_path):
    """camera_info files of the two eyes, 64x48 pixels."""
    for eye, shift in (("left", 0.0), ("right", -12.0)):
        info = CameraInfoFields(
            width=64,
            height=48,
            distortion_model="plumb_bob",
            d=(0.0,) * 5,
            k=(60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0),
            p=(60.0, 0.0, 32.0, shift, 0.0, 60.0, 24.0, 0.0, 0.0, 0.0, 1.0, 0.0),
            name=eye,
        )
        (tmp_path / f"{eye}.yaml").write_text(dump_camera_info(info))
    return tmp_path


@pytest.fixture
def start(start_node, left, right, calibration):
    def run(*arguments, **parameters):
        settings = {"pairing__tolerance_ms": 16.7, "grabbers__recovery__longest_wait_s": 0.1}
        for device in (left, right):
            device.control.millihertz = 30_000
        for eye, device in zip(EYES, (left, right), strict=True):
            settings |= {
                f"grabbers__{eye}__device": device.path,
                f"grabbers__{eye}__timeout_s": 60.0,
                f"grabbers__{eye}__width": 64,
                f"grabbers__{eye}__height": 48,
                f"{eye}_calibration": f"file://{calibration / eye}.yaml",
            }
        return start_node(*arguments, **(settings | parameters))

    return run


def said_of_pairs(node):
    """Stamp -> what ``status`` says of the pair."""
    messages = list(node.heard["status"])
    return {conversions.stamp_from_msg(m.header.stamp): m.status[0].message for m in messages}


def painted_by_the_fake(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return len(np.unique((image.astype(np.int64) - x * 7 - y * 13) % 65536)) == 1


def test_pairs_go_out_under_one_stamp_with_calibration_and_status(start, eventually):
    node = start()
    eventually(lambda: len(node.heard["right/image_raw"]) > 10, node.said)
    eventually(lambda: node.heard["/diagnostics"] and node.health()[0] == OK, node.said)
    topics = ("status", *(f"{eye}/{what}" for what in ("image_raw", "camera_info") for eye in EYES))
    stamps = {topic: node.stamps(topic) for topic in topics}
    # From when all were listened to until what all have heard.
    begin, end = (choose(s[i] for s in stamps.values()) for choose, i in ((max, 0), (min, -1)))
    heard = {topic: [s for s in some if begin <= s <= end] for topic, some in stamps.items()}
    pairs = {s for s, message in said_of_pairs(node).items() if message == "pair"}
    assert len(pairs) > 5
    for topic, some in heard.items():
        assert all(b > a for a, b in pairwise(some)), topic
        assert set(some) & pairs == set(heard["status"]) & pairs, topic
    image = node.heard["left/image_raw"][-1]
    assert (image.encoding, image.width, image.height, image.step) == ("mono16", 64, 48, 128)
    assert image.header.frame_id == "left_optical"
    assert painted_by_the_fake(conversions.image_from_msg(image))
    info = node.heard["right/camera_info"][-1]
    assert (info.header.frame_id, info.p[3]) == ("right_optical", -12.0)
    status = next(m.status for m in reversed(node.heard["status"]) if m.status[0].message == "pair")
    assert [entry.name for entry in status] == ["stereo capture", "left", "right"]
    assert [entry.hardware_id for entry in status] == ["", "left", "right"]
    values = {entry.key: entry.value for entry in status[0].values}
    assert abs(int(values["skew_ns"])) <= 16_700_000
    _, message, health = next(told for told in node.healths() if told[0] == OK)
    assert message.startswith("streaming at ")
    assert health["left_format"] == "Y16 64x48 at 30 Hz from fake grabber"
    assert health["right_stamps"] == "end of frame"


def test_telemetry_and_services(start, eventually, two_pty_cameras):
    node = start(
        grabbers__control__left_port=two_pty_cameras["left"].port,
        grabbers__control__right_port=two_pty_cameras["right"].port,
        grabbers__control__poll_period_s=0.05,
        grabbers__control__timeout_s=10.0,
        grabbers__ffc__limit_s=60.0,
        grabbers__ffc__separation_s=0.2,
        grabbers__ffc__duration_s=0.1,
        grabbers__camera__gain_mode="high",
        grabbers__camera__external_sync="left_master",
    )

    def telemetry(eye):
        entries = [e for m in node.heard["status"] for e in m.status if e.name == eye]
        values = [{v.key: v.value for v in entry.values} for entry in entries]
        return [said for said in map(telemetry_from_values, values) if said is not None]

    for camera in two_pty_cameras.values():
        camera.ffc_s = 1.0
    eventually(
        lambda: all(
            any(said.fpa_temperature_kelvin == pytest.approx(298.45) for said in telemetry(eye))
            for eye in EYES
        ),
        node.said,
    )
    assert two_pty_cameras["left"].registers[0x21] == b"\0\2"
    assert two_pty_cameras["right"].registers[0x21] == b"\0\1"
    answer = node.call(SetBool, "/stereo_capture/inhibit_ffc", SetBool.Request(data=True))
    assert (answer.success, answer.message) == (True, "no corrections for 30 s")
    eventually(lambda: node.health()[2]["ffc_inhibited"] == "true", node.said)
    assert node.call(SetBool, "/stereo_capture/inhibit_ffc", SetBool.Request(data=False)).success
    assert node.call(Trigger, "/stereo_capture/do_ffc", Trigger.Request()).success
    for eye in EYES:
        eventually(
            lambda e=eye: any(t.ffc_state.value == "in_progress" for t in telemetry(e)),
            node.said,
        )
        eventually(lambda e=eye: telemetry(e)[-1].ffc_state.value == "complete", node.said)
    eventually(lambda: node.health()[2]["left_ffc_count"] == "1", node.said)
    for camera in two_pty_cameras.values():
        camera.registers[0x79] = b"\0\1"
    assert node.call(Trigger, "/stereo_capture/open_shutter", Trigger.Request()).success
    for camera in two_pty_cameras.values():
        eventually(lambda c=camera: c.registers[0x79] == b"\0\0", node.said)
    assert node.health()[2]["left_camera"].startswith("serial 12345")


def test_a_lost_eye(start, eventually, right):
    node = start()
    eventually(lambda: len(node.heard["right/image_raw"]) > 3, node.said)
    right.control.unplugged = 1
    eventually(lambda: "right: waiting to reconnect: " in node.health()[1], node.said)
    assert node.health()[0] == ERROR
    lefts = len(node.heard["left/image_raw"])
    eventually(lambda: len(node.heard["left/image_raw"]) > lefts + 3, node.said)
    lefts, rights = (len(node.heard[f"{eye}/image_raw"]) for eye in EYES)
    eventually(lambda: len(node.heard["left/image_raw"]) > lefts + 10, node.said)
    assert len(node.heard["right/image_raw"]) == rights
    alone = node.heard["status"][-1].status
    assert (alone[0].level, alone[0].message) == (bytes([WARN]), "left alone")
    right.control.unplugged = 0
    eventually(lambda: len(node.heard["right/image_raw"]) > rights + 5, node.said)
    eventually(lambda: node.health()[0] < ERROR, node.said)
    answer = node.call(Trigger, "/stereo_capture/reconnect", Trigger.Request())
    assert answer.success
    eventually(lambda: node.health()[2]["left_connections"] == "2", node.said)
    answer = node.call(Trigger, "/stereo_capture/do_ffc", Trigger.Request())
    assert not answer.success
    assert "no camera has a control port" in answer.message


def test_frames_without_partner_are_an_error_until_there_are_pairs(start, eventually, right):
    node = start(pairing__tolerance_ms=0.0)
    eventually(lambda: "frames found no partner, 0 pairs did" in node.health()[1], node.said)
    assert node.health()[0] == ERROR
    assert node.heard["right/image_raw"] == []


def test_drops_and_unknown_stamps_are_warned_of(start, eventually, left):
    left.control.buffer_flags = 0
    node = start()
    eventually(lambda: len(node.heard["left/image_raw"]) > 3, node.said)
    left.control.damaged = 20

    def told():
        return [health for health in node.healths() if "lost or damaged" in health[1]]

    eventually(told, node.said)
    level, message, values = told()[0]
    assert level == WARN
    assert "left: the driver's stamps are on no known clock" in message
    assert int(values["left_damaged"]) > 0


def test_what_is_recorded_replays_bit_for_bit(start, eventually, tmp_path):
    node = start()
    topics = [f"{eye}/{what}" for what in ("image_raw", "camera_info") for eye in EYES]
    eventually(lambda: all(len(node.heard[topic]) > 20 for topic in topics), node.said)
    sent = {eye: list(node.heard[f"{eye}/image_raw"])[:20] for eye in EYES}
    with BagWriter(tmp_path / "bag") as bag:
        for eye in EYES:
            for image, info in zip(sent[eye], node.heard[f"{eye}/camera_info"], strict=False):
                stamp_ns = conversions.stamp_from_msg(image.header.stamp)
                bag.write_image(
                    f"/{eye}/image_raw", stamp_ns, conversions.image_from_msg(image), eye
                )
                fields = conversions.camera_info_from_msg(info)
                bag.write_camera_info(f"/{eye}/camera_info", stamp_ns, fields, eye)
    dataset, _ = open_bag(tmp_path / "bag", SourceOptions())
    replayed = {eye: [frame for frame in dataset.frames() if frame.camera == eye] for eye in EYES}
    for eye in EYES:
        assert len(replayed[eye]) == 20
        for frame, message in zip(replayed[eye], sent[eye], strict=True):
            assert frame.stamp_ns == conversions.stamp_from_msg(message.header.stamp)
            assert frame.image.tobytes() == bytes(message.data)
            assert painted_by_the_fake(frame.image)
    assert dataset.calibration().baseline_m == pytest.approx(0.2)


def test_ctrl_c_ends_the_process_with_everything_closed(left, right, eventually, tmp_path):
    for device in (left, right):
        device.control.millihertz = 100_000
    arguments = [sys.executable, "-m", "thermal_stereo_vo.nodes.stereo_capture_node", "--ros-args"]
    for eye, device in zip(EYES, (left, right), strict=True):
        arguments += ["-p", f"grabbers.{eye}.device:={device.path}"]
        arguments += ["-p", f"grabbers.{eye}.timeout_s:=60.0"]
        arguments += ["-p", f"grabbers.{eye}.width:=64", "-p", f"grabbers.{eye}.height:=48"]
    process = subprocess.Popen(
        arguments,
        cwd=REPOSITORY,
        env={**os.environ, "ROS_LOG_DIR": str(tmp_path), "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
        stderr=subprocess.PIPE,
        text=True,
    )
    eventually(lambda: left.control.produced > 20 and right.control.produced > 20)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=240)
    assert (process.returncode, error) == (0, "")
    for device in (left, right):
        assert device.control.opened == device.control.closed == 1


@pytest.mark.parametrize("name", ["sensoray", "boson", "analog"])
def test_the_ready_settings_start_the_node(start, eventually, left, right, name):
    for device in (left, right):
        device.control.standard = 0x1000
    node = start(
        "--params-file",
        str(REPOSITORY / "config" / f"stereo_capture_{name}.yaml"),
        grabbers__left__pixel_format="Y16",
        grabbers__right__pixel_format="Y16",
        pairing__tolerance_ms=16.7,
    )
    eventually(lambda: len(node.heard["left/image_raw"]) > 3, node.said)
    assert node.node.config.left_calibration.startswith("file:///")
    assert node.node.config.grabbers.ffc.authority == ("host" if name == "sensoray" else "none")


@pytest.mark.parametrize(
    ("parameters", "answer"),
    [
        ({"grabbers.left.device": "/x", "grabbers.right.device": "/x"}, "are both '/x'"),
        ({"grabbers.left.divice": "/x"}, "unknown setting 'grabbers.left.divice': did you mean"),
        ({"left_calibration": "http://x/y.yaml"}, "must begin with file:// or package://"),
        ({"left_calibration": "package://no_such_package/y"}, "'no_such_package' .* not installed"),
        ({"left_calibration": "CALIBRATION"}, "is for 64x48 pixels, the stream has 640x512"),
        ({"grabbers.left.buffers": "2"}, r"grabbers.left.buffers = 2 is out of range.*4\.\.8"),
        ({"source": "recording"}, "recording.recording names none"),
    ],
    ids=str,
)
def test_wrong_settings_end_the_node_with_a_sentence(
    calibration, capsys, monkeypatch, tmp_path, parameters, answer
):
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    settings = {"grabbers.left.device": "/left", "grabbers.right.device": "/right"} | parameters
    arguments = ["node", "--ros-args"]
    for name, value in settings.items():
        text = f"file://{calibration / 'left.yaml'}" if value == "CALIBRATION" else value
        arguments += ["-p", f"{name}:={text}"]
    assert runtime.run(StereoCaptureNode, arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("stereo_capture_node: ")
    assert re.search(answer, error)
