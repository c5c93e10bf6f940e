"""A visible and a thermal camera over DDS, and odom that waits for metres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import Image, PointCloud2

from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.cameras import (
    THERMAL,
    VISIBLE,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.nodes import conversions, onboard_node
from thermal_stereo_vo.nodes.publisher import ResultPublisher
from thermal_stereo_vo.nodes.stereo_input import ImageInput
from thermal_stereo_vo.odometry.factory import METHODS
from thermal_stereo_vo.outputs.bag_writer import BagWriter
from thermal_stereo_vo.stereo.pairing import PairingConfig

pytestmark = pytest.mark.timeout(900)

needs_the_method = pytest.mark.skipif(
    "multispectral" not in METHODS, reason="there is no method of two bands"
)
ROLES = (VISIBLE, THERMAL)
QOS = QoSProfile(depth=200)
STAMPS_NS = [5_000_000_000 + i * 100_000_000 for i in range(10)]
BENT = DistortionModel.RADIAL_TANGENTIAL
RIG = RigCalibration(
    {
        VISIBLE: RigCamera(Camera(320, 240, 250.0, 250.0, 161.0, 119.0, BENT, (-0.1, 0.02, 0, 0))),
        THERMAL: RigCamera(
            Camera(240, 192, 210.0, 210.0, 119.0, 96.0, BENT, (-0.2, 0.05, 0, 0)),
            make_transform(np.eye(3), [0.1, 0.0, 0.0]),
        ),
    }
)


def result(stamp_ns: int, *, converged: bool | None) -> OdometryResult:
    return OdometryResult(
        stamp_ns, TrackingStatus.TRACKING, np.eye(4), np.eye(6), np.zeros(6), np.eye(6),
        scale_converged=converged,
    )  # fmt: skip


@pytest.mark.parametrize(("any_unit", "told"), [(False, [2, 3]), (True, [1, 2, 3])])
def test_odom_and_points_wait_for_metres_unless_asked_for(ros, any_unit, told) -> None:
    publisher = ResultPublisher(
        ros.node, np.eye(4), odom_frame="odom", base_frame="base_link", any_unit=any_unit
    )
    heard: dict[str, list[int]] = {"odom": [], "points": [], "status": []}
    for topic, kind in (("odom", Odometry), ("points", PointCloud2), ("status", DiagnosticArray)):
        ros.node.create_subscription(
            kind,
            topic,
            lambda m, topic=topic: heard[topic].append(conversions.stamp_from_msg(m.header.stamp)),
            QOS,
        )
    ros.spin_until(
        lambda: all(ros.node.count_subscribers(topic) > 0 for topic in heard), "the subscriptions"
    )
    cloud = PointCloud(np.ones((1, 3), np.float32), np.ones(1, np.float32))
    for i, converged in enumerate((False, True, None), start=1):
        publisher.on_result(result(i * 10**9, converged=converged))
        publisher.on_points(i * 10**9, cloud)
    ros.spin_until(lambda: len(heard["status"]) == 3, "three statuses")
    ros.spin_until(lambda: heard["points"][-1:] == [3 * 10**9], "the last points")
    assert heard["odom"] == heard["points"] == [i * 10**9 for i in told]


def test_pairs_are_those_of_the_topics_of_the_roles(ros) -> None:
    """Images of different size and depth, by the names of their cameras."""
    pairs = []

    class Node:
        """The node of the test with what ``BaseNode`` adds."""

        def __init__(self, node):
            self._node = node

        def __getattr__(self, name):
            return getattr(self._node, name)

        def saw(self, topic):
            """Nobody waits for inputs here."""

        def refuse(self, error):
            raise error

    images = ImageInput(
        Node(ros.node), "image_raw", PairingConfig(), True, pairs.append, print, roles=ROLES
    )
    assert images.topics == ["visible/image_raw", "thermal/image_raw"]
    images.open()
    senders = {role: ros.node.create_publisher(Image, f"{role}/image_raw", QOS) for role in ROLES}
    ros.spin_until(
        lambda: all(s.get_subscription_count() > 0 for s in senders.values()), "subscriptions"
    )
    grey, counts = np.full((24, 32), 90, np.uint8), np.full((19, 24), 7000, np.uint16)
    for role, image in ((VISIBLE, grey), (THERMAL, counts)):
        senders[role].publish(conversions.image_to_msg(image, 5_000_000_000, f"{role}_optical"))
    ros.spin_until(lambda: len(pairs) > 0, "a pair")
    np.testing.assert_array_equal(pairs[0].first.image, grey)
    np.testing.assert_array_equal(pairs[0].second.image, counts)
    assert (pairs[0].first.camera, pairs[0].second.camera) == ROLES
    counters = dict(images.counters())
    assert counters["received_visible"] == counters["received_thermal"] == counters["pairs"] == "1"
    images.close()


@needs_the_method
def test_the_onboard_node_waits_for_the_scale(ros, textured_ramp, tmp_path) -> None:
    """A few steps tell no scale: every pair is answered, and odom stays silent."""
    save_calibration(RIG, tmp_path)
    ros.start(
        "onboard_node",
        odometry__method="multispectral",
        rig_calibration=f"file://{tmp_path / 'rig.yaml'}",
        process_all=True,
    )
    odometry: list[Odometry] = []
    statuses: list[DiagnosticArray] = []
    health: list[DiagnosticArray] = []
    ros.node.create_subscription(Odometry, "odom", odometry.append, QOS)
    ros.node.create_subscription(DiagnosticArray, "status", statuses.append, QOS)
    ros.node.create_subscription(DiagnosticArray, "/diagnostics", health.append, QOS)
    senders = {role: ros.node.create_publisher(Image, f"{role}/image_raw", QOS) for role in ROLES}
    ros.spin_until(
        lambda: all(s.get_subscription_count() > 0 for s in senders.values()),
        "the node to ask for images",
    )
    rng = np.random.default_rng(3)
    for i in range(4):
        for role, image in ramp_pair(RIG, textured_ramp, i, rng).items():
            senders[role].publish(conversions.image_to_msg(image, STAMPS_NS[i], f"{role}_optical"))
        ros.spin_until(lambda i=i: len(statuses) == i + 1, f"the answer to pair {i}")
    values = [{v.key: v.value for v in message.status[0].values} for message in statuses]
    assert [value["scale_converged"] for value in values] == ["false"] * 4
    assert odometry == []
    ros.spin_until(
        lambda: any(
            value.key == "scale_converged" and value.value == "false"
            for message in health
            for status in message.status
            for value in status.values
        ),
        "the scale in the diagnostics",
    )


@needs_the_method
def test_recorded_bands_reach_the_odometry_through_nodes(ros, textured_ramp, tmp_path) -> None:
    """As ``replay`` answers them, pair by pair; lenses that bend no rays need no rectification."""
    straight = {
        role: replace(mounted, camera=mounted.camera.without_distortion())
        for role, mounted in RIG.cameras.items()
    }
    rig, bag, pairs = replace(RIG, cameras=straight), tmp_path / "bag", 6
    write_bands(bag, rig, textured_ramp, pairs)
    rig_file = save_rig(rig, tmp_path)
    arguments = [
        "replay", str(bag), "--method", "multispectral", "--calibration", str(rig_file),
        "--output", str(tmp_path / "run"), "--quiet",
    ]  # fmt: skip
    assert main(arguments) == 0
    expected = recorded_statuses(tmp_path / "run" / "result.mcap")
    assert len(expected) == pairs

    odometry: list[Odometry] = []
    statuses: list[DiagnosticArray] = []
    ros.node.create_subscription(Odometry, "odom", odometry.append, QOS)
    ros.node.create_subscription(DiagnosticArray, "status", statuses.append, QOS)
    shown: dict[str, list[Image]] = {role: [] for role in ROLES}
    for role in ROLES:
        ros.node.create_subscription(Image, f"{role}/image_raw", shown[role].append, QOS)
    ros.start(
        "stereo_odometry_node",
        {f"{role}/image_rect": f"{role}/image_raw" for role in ROLES},
        odometry__method="multispectral",
        rig_calibration=str(rig_file),
        process_all=True,
        use_sim_time=True,
    )
    ros.spin_until(lambda: ros.node.count_publishers("status") > 0, "the odometry node")
    replay = ros.start(
        "replay_node", source=bag, calibration=str(rig_file), rate=0.0, subscribers=2
    )
    ros.spin_until(lambda: replay.poll() is not None, "the end of the recording")
    ros.spin_until(lambda: len(statuses) == pairs, "an answer to every pair")
    ros.spin_until(lambda: all(len(got) == pairs for got in shown.values()), "all images")

    assert odometry == []
    assert [conversions.stamp_from_msg(m.header.stamp) for m in statuses] == STAMPS_NS[:pairs]
    assert [told(message) for message in statuses] == expected
    assert {values["scale_converged"] for values in expected} == {"false"}
    assert [values["status"][0] for values in expected] == ["I", *"TTTTT"]
    for role, encoding in ((VISIBLE, "mono8"), (THERMAL, "mono16")):
        assert {message.encoding for message in shown[role]} == {encoding}
        assert {(m.width, m.height) for m in shown[role]} == {rig[role].camera.size}


def write_bands(path: Path, rig: RigCalibration, ramp: Any, pairs: int) -> None:
    """A few steps before the ramp, in grey levels and in counts."""
    rng = np.random.default_rng(3)
    with BagWriter(path) as bag:
        for i, stamp_ns in enumerate(STAMPS_NS[:pairs]):
            for role, image in ramp_pair(rig, ramp, i, rng).items():
                bag.write_image(f"/{role}/image_raw", stamp_ns, image, f"{role}_optical")


def ramp_pair(
    rig: RigCalibration, ramp: Any, step: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    T_world_rig = exp_se3([0.02 * step, 0.0, 0.02 * step, 0.0, 0.004 * step, 0.0])
    images = {}
    for role, mounted in rig.cameras.items():
        image = ramp.image(mounted.camera, T_world_rig @ mounted.T_rig_camera)
        image = image + rng.integers(0, 8, image.shape, dtype=np.uint16)
        if role == VISIBLE:
            image = np.clip((image.astype(float) - 5000.0) / 16.0, 0, 255).astype(np.uint8)
        images[role] = image
    return images


def save_rig(rig: RigCalibration, folder: Path) -> Path:
    save_calibration(rig, folder)
    return folder / "rig.yaml"


def told(message: Any) -> dict[str, str]:
    """What a status says, but for times."""
    return {v.key: v.value for v in message.status[0].values if not v.key.endswith("_ms")}


def recorded_statuses(path: Path) -> list[dict[str, str]]:
    with AnyReader([path]) as reader:
        chosen = [c for c in reader.connections if c.topic == "/status"]
        return [
            told(reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages(chosen)
        ]


@needs_the_method
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "set rig_calibration to its rig.yaml"),
        (["-p", "rig_calibration:=RIG", "-p", "source:=recording"], "come from topics"),
        (["-p", "rig_calibration:=/nowhere/rig.yaml"], "there is no calibration file"),
    ],
)
def test_a_rig_that_nobody_knows_is_asked_for(
    arguments: list[str],
    complaint: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    save_calibration(RIG, tmp_path)
    arguments = [a.replace("RIG", str(tmp_path / "rig.yaml")) for a in arguments]
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    more = ["-p", "odometry.method:=multispectral"]
    assert onboard_node.main(["onboard_node", "--ros-args", *more, *arguments]) == 2
    assert complaint in capfd.readouterr().err
