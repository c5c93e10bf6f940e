"""The nodes as processes, over DDS, give what the replay writes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2

# The very first run compiles every kernel, on a machine that may be busy.
pytestmark = pytest.mark.timeout(900)

REPOSITORY = Path(__file__).resolve().parent.parent.parent


def replayed(bag: Path, output: Path) -> dict[str, list[Any]]:
    """Topic -> messages of the bag that ``replay`` leaves."""
    arguments = ["replay", bag, "--output", output, "--quiet", "--no-plot"]
    run = subprocess.run(
        [sys.executable, "-m", "thermal_stereo_vo", *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    messages: dict[str, list[Any]] = {}
    with AnyReader([output / "result.mcap"]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append(message)
    return messages


def stamps_ns(messages: list[Any]) -> list[int]:
    return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]


def values(message: Any) -> dict[str, str]:
    """What a status says, but for times."""
    return {v.key: v.value for v in message.status[0].values if not v.key.endswith("_ms")}


def numbers(message: Any) -> np.ndarray:
    """Pose, twist and both covariances of an odometry message."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z]
    return np.concatenate([pose, message.pose.covariance, message.twist.covariance])


def listen_to_images(ros: Any) -> None:
    """Be the second subscriber of both images that a replay can be told to wait for.

    Topics find each other in the order in which they are made: such a replay has then found all
    that the test has asked for before, its clock too, which a short recording would else outrun.
    """
    for eye in ("left", "right"):
        ros.node.create_subscription(Image, f"{eye}/image_raw", lambda _: None, QoSProfile(depth=5))


@pytest.mark.parametrize(
    ("rate", "blind", "least_tracked"),
    [(1.0, range(0), 22), (0.0, range(8, 16), 12)],
    ids=["at rate 1", "as fast as answered, one eye blind for a while"],
)
def test_chain_of_nodes_equals_replay(
    ros, write_bag, tmp_path: Path, rate: float, blind: range, least_tracked: int
) -> None:
    bag = tmp_path / "ramp"
    write_bag(bag, blind=blind)
    expected = replayed(bag, tmp_path / "run")
    expected_odom, expected_status = expected["/odom"], expected["/status"]
    tracked = [m for m in expected_status if values(m)["status"] == "TRACKING"]
    assert len(expected_status) == 24
    assert least_tracked <= len(tracked) <= 23

    odometry: list[Odometry] = []
    statuses: list[DiagnosticArray] = []
    clouds: list[PointCloud2] = []
    clock_ns: list[int] = []
    qos = QoSProfile(depth=200)
    ros.node.create_subscription(Odometry, "odom", odometry.append, qos)
    ros.node.create_subscription(DiagnosticArray, "status", statuses.append, qos)
    ros.node.create_subscription(PointCloud2, "points", clouds.append, qos)
    ros.node.create_subscription(
        Clock, "/clock", lambda m: clock_ns.append(m.clock.sec * 10**9 + m.clock.nanosec), qos
    )
    listen_to_images(ros)
    ros.start("rectification_node", process_all=True, use_sim_time=True)
    ros.start("stereo_odometry_node", process_all=True, use_sim_time=True)
    ros.spin_until(lambda: ros.node.count_publishers("status") > 0, "the odometry node")
    replay = ros.start("replay_node", source=bag, rate=rate, subscribers=2)
    ros.spin_until(lambda: replay.poll() is not None, "the end of the recording")
    ros.spin_until(
        lambda: len(statuses) >= len(expected_status) and len(odometry) >= len(expected_odom),
        "a status and a pose for every pair",
    )
    ros.spin_until(lambda: len(clouds) >= len(expected_odom), "points for every pose")
    last_ns = stamps_ns(expected_status)[-1]
    ros.spin_until(lambda: bool(clock_ns) and clock_ns[-1] >= last_ns, "the clock of the last pair")
    assert "starts again" not in ros.logs()

    # No frame lost, none twice, none out of order.
    assert stamps_ns(odometry) == stamps_ns(expected_odom)
    assert stamps_ns(statuses) == stamps_ns(expected_status)
    assert stamps_ns(clouds) == stamps_ns(expected["/points"])
    # The same features, matches and inliers, so the same decisions.
    assert [values(m) for m in statuses] == [values(m) for m in expected_status]
    # The same numbers; only the baseline is divided once more on its way through camera_info.
    for got, wanted in zip(odometry, expected_odom, strict=True):
        assert got.header.frame_id == wanted.header.frame_id == "odom"
        assert got.child_frame_id == wanted.child_frame_id == "base_link"
        np.testing.assert_allclose(numbers(got), numbers(wanted), rtol=1e-6, atol=1e-9)
    for cloud, wanted in zip(clouds, expected["/points"], strict=True):
        assert cloud.width == wanted.width
        points = np.frombuffer(cloud.data, np.float32)
        np.testing.assert_allclose(points, wanted.data.view(np.float32), rtol=1e-5, atol=1e-5)
    # base_link looks along the optical axis, and the rig flew ahead by 8 cm a frame.
    assert 1.4 < odometry[-1].pose.pose.position.x < 2.2
    assert clouds[-1].width > 20

    assert clock_ns == sorted(clock_ns)
    assert stamps_ns(statuses)[0] <= clock_ns[0] <= clock_ns[-1] == stamps_ns(statuses)[-1]


GATED = {f"{eye}/image_raw": f"{eye}/image_corrected" for eye in ("left", "right")}


def test_corrections_reach_the_odometry_through_all_nodes(ros, write_bag, tmp_path: Path) -> None:
    """Both eyes freeze for 0.5 s, later one alone: the nodes answer every pair as the replay."""
    bag = tmp_path / "frozen"
    write_bag(bag, frozen={"left": range(8, 13), "right": [*range(8, 13), *range(17, 20)]})
    expected = replayed(bag, tmp_path / "run")
    expected_odom, expected_status = expected["/odom"], expected["/status"]
    letters = "".join(values(m)["status"][0] for m in expected_status)
    assert letters == "I" + 7 * "T" + 5 * "G" + 11 * "T"
    assert len(expected_odom) == len(expected_status) == 24

    odometry: list[Odometry] = []
    statuses: list[DiagnosticArray] = []

    def on_status(message: DiagnosticArray) -> None:
        if not message.status[0].name.startswith("thermal correction"):
            statuses.append(message)

    qos = QoSProfile(depth=200)
    ros.node.create_subscription(Odometry, "odom", odometry.append, qos)
    ros.node.create_subscription(DiagnosticArray, "status", on_status, qos)
    ros.start("thermal_correction_node", process_all=True, use_sim_time=True)
    ros.start("rectification_node", GATED, process_all=True, gated=True, use_sim_time=True)
    ros.start("stereo_odometry_node", process_all=True, gated=True, use_sim_time=True)
    ros.spin_until(lambda: ros.node.count_publishers("odom") > 0, "the odometry node")
    replay = ros.start("replay_node", source=bag, rate=0.0)
    ros.spin_until(lambda: replay.poll() is not None, "the end of the recording")
    ros.spin_until(lambda: len(statuses) >= 24 and len(odometry) >= 24, "every answer")

    assert stamps_ns(odometry) == stamps_ns(expected_odom)
    assert [values(m) for m in statuses] == [values(m) for m in expected_status]
    assert {values(m)["reason"] for m in statuses[8:13]} == {"left eye: frozen, right eye: frozen"}
    for got, wanted in zip(odometry, expected_odom, strict=True):
        np.testing.assert_allclose(numbers(got), numbers(wanted), rtol=1e-6, atol=1e-9)
