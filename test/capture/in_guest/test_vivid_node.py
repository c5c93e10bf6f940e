"""The node on two virtual grabbers of a real kernel, through every fault they can show."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.outputs.ros_fields import ERROR, WARN

EYES = ("left", "right")


@pytest.fixture
def start(start_node, left, right):
    def run(**parameters):
        settings = {
            # Half a period, and the jitter of the driver's stamps.
            "pairing__tolerance_ms": 25.0,
            "grabbers__recovery__longest_wait_s": 0.3,
            "grabbers__left__device": left.device,
            "grabbers__right__device": right.device,
            "grabbers__left__height": 480,
            "grabbers__right__height": 512,
        }
        return start_node(**(settings | parameters))

    return run


def check(node):
    """What must hold of all that was published, whatever happened."""
    for eye in EYES:
        stamps = node.stamps(f"{eye}/image_raw")
        assert all(b > a for a, b in pairwise(stamps))
    alone = {
        stamp
        for stamp, message in zip(node.stamps("status"), list(node.heard["status"]), strict=False)
        if message.status[0].message != "pair"
    }
    seen = [set(node.stamps(f"{eye}/image_raw")) for eye in EYES]
    newest = max(seen[0] | seen[1])
    unexplained = {
        stamp for stamp in seen[0] ^ seen[1] if stamp not in alone and stamp < newest - 10**9
    }
    # The first images of one topic may come before the subscription of the other.
    assert len(unexplained) <= 3


def values(node):
    return node.health()[2]


def pairs(node):
    return len(node.heard["right/image_raw"])


def goes_on(node, eventually, more=10):
    wanted = pairs(node) + more
    eventually(lambda: pairs(node) >= wanted, node.said)


@pytest.mark.parametrize("pixel_format", ["Y16", "GREY"])
def test_two_cameras_at_30_hz(start, eventually, pixel_format):
    formats = {f"grabbers__{eye}__pixel_format": pixel_format for eye in EYES}
    node = start(**formats)
    eventually(lambda: pairs(node) > 45 and node.health()[0] != ERROR, node.said)
    check(node)
    for eye, height in zip(EYES, (480, 512), strict=True):
        messages = list(node.heard[f"{eye}/image_raw"])[5:]
        stamps = np.array(node.stamps(f"{eye}/image_raw")[5:])
        steps_ms = np.diff(stamps) * 1e-6
        # The listener shares the emulated processor and may miss a few.
        no_miss = steps_ms < 50
        assert np.mean(no_miss) > 0.9, node.said()
        assert np.mean(steps_ms[no_miss]) == pytest.approx(1000 / 30, rel=0.02), node.said()
        image = conversions.image_from_msg(messages[-1])
        assert messages[-1].encoding == {"Y16": "mono16", "GREY": "mono8"}[pixel_format]
        assert image.shape == (height, 640)
        assert len(np.unique(image)) >= 6
        assert int(values(node)[f"{eye}_lost"]) <= 2, node.said()
    assert values(node)["left_format"] == f"{pixel_format} 640x480 at 30 Hz from vivid"


def test_one_eye_is_unplugged_and_comes_back(start, eventually, right):
    node = start()
    goes_on(node, eventually)
    right.set("disconnect", 1)
    eventually(lambda: values(node)["right_connections"] == "2", node.said)
    goes_on(node, eventually)
    assert values(node)["left_failures"] == "0"
    assert int(values(node)["right_failures"]) >= 1
    check(node)


def test_both_are_unplugged_and_come_back_under_the_same_name(start, eventually, replug):
    unplug, plug = replug
    node = start()
    goes_on(node, eventually)
    unplug()
    eventually(lambda: node.health()[0] == ERROR, node.said)
    eventually(lambda: "no video device 'bus:platform:vivid-000'" in node.health()[1], node.said)
    before = pairs(node)
    plug()
    eventually(lambda: pairs(node) > before + 10, node.said)
    eventually(lambda: node.health()[0] < ERROR, node.said)
    check(node)


def test_a_fatal_error_of_the_driver(start, eventually, left):
    node = start()
    goes_on(node, eventually)
    left.set("fatal", 1)
    eventually(lambda: values(node)["left_failures"] == "1", node.said)
    goes_on(node, eventually)
    assert values(node)["right_failures"] == "0"
    check(node)


def test_dropped_and_damaged_buffers(start, eventually, left):
    node = start()
    goes_on(node, eventually)
    left.set("damaged", 1)
    eventually(lambda: values(node)["left_damaged"] == "1", node.said)
    left.set("percentage_dropped", 30)
    eventually(lambda: int(values(node)["left_lost"] or 0) >= 5, node.said)
    eventually(lambda: "left: " in node.health()[1], node.said)
    assert node.health()[0] == WARN
    assert "frames were lost or damaged" in node.health()[1]
    assert values(node)["left_failures"] == values(node)["right_failures"] == "0"
    check(node)


def test_sequence_and_stamps_wrap(start, eventually, left, right):
    left.set("sequence_wrap", 1)  # the count starts 128 frames before the wrap
    right.set("stamp_wrap", 1)  # stamps start 16 s before the wrap of 64 bits
    node = start()
    eventually(lambda: int(values(node)["left_frames"] or 0) > 160, node.said)
    assert int(values(node)["left_lost"]) < 5
    assert int(values(node)["right_by_arrival"]) > 100
    assert "stamps of the driver were far from the present" in node.health()[1]
    check(node)


def test_no_signal(start, eventually, right):
    node = start()
    goes_on(node, eventually)
    right.set("signal", 1)
    eventually(lambda: "right: no signal" in node.health()[1], node.said)
    assert node.health()[0] == ERROR
    before, lefts = pairs(node), len(node.heard["left/image_raw"])
    eventually(lambda: len(node.heard["left/image_raw"]) > lefts + 20, node.said)
    assert pairs(node) <= before + 5
    right.set("signal", 0)
    goes_on(node, eventually)
    check(node)


def test_a_busy_device_is_waited_for(start, eventually, right, another_program):
    release = another_program(right)
    node = start()
    eventually(lambda: "in use by another program" in node.health()[1], node.said)
    assert node.health()[0] == ERROR
    assert values(node)["left_state"] == "streaming"
    release()
    goes_on(node, eventually)
    eventually(lambda: node.health()[0] < ERROR, node.said)
    check(node)
