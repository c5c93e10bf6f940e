"""The onboard node as a process of its own, fed over DDS or by a recording that plays cameras."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_srvs.srv import Trigger

from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.outputs.ros_fields import odometry_fields
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.replay import replay
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

EYES = (LEFT, RIGHT)
PERIOD_NS = 100_000_000
QOS = QoSProfile(depth=200)


def raw_rig() -> RigCalibration:
    """Two bent lenses that squint a little."""

    def camera(fx: float, k1: float) -> Camera:
        model = DistortionModel.RADIAL_TANGENTIAL
        return Camera(320, 240, fx, fx, 160.0, 119.0, model, (k1, 0.02, 0.0, 0.0, 0.0))

    T_left_right = exp_se3([0.3, 0.002, -0.003, 0.005, -0.01, 0.004])
    rig = RigCalibration(
        {LEFT: RigCamera(camera(260.0, -0.1)), RIGHT: RigCamera(camera(261.0, -0.08), T_left_right)}
    )
    return with_rectification(rig, RectificationConfig())[0]


class Listener:
    """Everything that the node says."""

    def __init__(self, ros) -> None:
        self.ros = ros
        self.odometry: list[Odometry] = []
        self.statuses: list[DiagnosticArray] = []
        self.health: list[DiagnosticArray] = []
        node = ros.node
        node.create_subscription(Odometry, "odom", self.odometry.append, QOS)
        node.create_subscription(DiagnosticArray, "status", self._on_status, QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, QOS)

    def _on_status(self, message: DiagnosticArray) -> None:
        if message.status[0].name == "odometry":
            self.statuses.append(message)

    def _on_health(self, message: DiagnosticArray) -> None:
        if "onboard" in message.status[0].name:
            self.health.append(message)

    def odom_stamps_ns(self) -> list[int]:
        return [conversions.stamp_from_msg(m.header.stamp) for m in self.odometry]

    def diagnosis(self) -> dict[str, str]:
        """The newest health."""
        return values(self.health[-1]) if self.health else {}

    def wait_for(self, **wanted: object) -> dict[str, str]:
        """Diagnostics in which these values stand."""
        texts = {key: str(value) for key, value in wanted.items()}
        self.ros.spin_until(
            lambda: texts.items() <= self.diagnosis().items(), f"{texts} in the diagnostics"
        )
        return self.diagnosis()


class Feeder(Listener):
    """Two raw cameras before the ramp, published by this process."""

    def __init__(self, ros, ramp) -> None:
        super().__init__(ros)
        self.rig = raw_rig()
        self._ramp = ramp
        node = ros.node
        self._images = {e: node.create_publisher(Image, f"{e}/image_raw", QOS) for e in EYES}
        infos = {e: node.create_publisher(CameraInfo, f"{e}/camera_info", QOS) for e in EYES}
        fields = infos_from_calibration(self.rig)

        def send_infos() -> None:
            for eye in EYES:
                infos[eye].publish(conversions.camera_info_to_msg(fields[eye], 0, f"{eye}_optical"))

        node.create_timer(0.5, send_infos)

    def wait_until_listening(self) -> None:
        self.ros.spin_until(
            lambda: all(p.get_subscription_count() > 0 for p in self._images.values()),
            "the node to ask for images",
        )

    def at(self, step: int) -> dict[str, np.ndarray]:
        """Both images after ``step`` steps of 8 cm ahead."""
        T_world_rig = exp_se3([0.0, 0.0, 0.08 * step, 0.0, 0.0, 0.0])
        return {
            eye: self._ramp.image(mounted.camera, T_world_rig @ mounted.T_rig_camera)
            for eye, mounted in self.rig.cameras.items()
        }

    def publish(self, stamp_ns: int, images: dict[str, np.ndarray]) -> None:
        for eye, image in images.items():
            self._images[eye].publish(conversions.image_to_msg(image, stamp_ns, f"{eye}_optical"))

    def answer(self, stamp_ns: int, images: dict[str, np.ndarray]) -> dict[str, str]:
        """Publish a pair; the status that answers it."""
        before = len(self.statuses)
        self.publish(stamp_ns, images)
        self.ros.spin_until(lambda: len(self.statuses) > before, f"a status at {stamp_ns}")
        assert len(self.statuses) == before + 1
        assert conversions.stamp_from_msg(self.statuses[-1].header.stamp) == stamp_ns
        return values(self.statuses[-1])


def values(message: DiagnosticArray) -> dict[str, str]:
    return {item.key: item.value for item in message.status[0].values}


def numbers(message: Odometry) -> np.ndarray:
    """Pose, twist and both covariances."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z]
    return np.concatenate([pose, message.pose.covariance, message.twist.covariance])


def test_a_flight_with_correction_loss_and_overload(ros, textured_ramp) -> None:
    rig = Feeder(ros, textured_ramp)
    # A busy machine may keep an answer, and so the next images, waiting for seconds.
    node = ros.start(
        "onboard_node", odometry__status__coast_max_s=0.55, front_end__gate__ffc_max_s=60.0
    )
    rig.wait_until_listening()
    # Stamps of now, one frame period apart, as from a live camera.
    start_ns = ros.node.get_clock().now().nanoseconds

    def stamp_ns(i: int) -> int:
        return start_ns + i * PERIOD_NS

    def odom_x_m() -> float:
        return float(rig.odometry[-1].pose.pose.position.x)

    # Every pair is answered, with a pose.
    statuses = [rig.answer(stamp_ns(i), rig.at(i))["status"] for i in range(8)]
    assert statuses == ["INITIALISING", *7 * ["TRACKING"]]
    ros.spin_until(lambda: len(rig.odometry) == 8, "a pose for every pair")
    assert 0.53 < odom_x_m() < 0.59
    assert rig.odometry[-1].header.frame_id == "odom"
    assert rig.odometry[-1].child_frame_id == "base_link"

    # A flat-field correction: the cameras repeat their last image, the poses go on at full rate.
    frozen = rig.at(7)
    answers = [rig.answer(stamp_ns(i), frozen) for i in range(8, 12)]
    assert [answer["status"] for answer in answers] == 4 * ["GAP"]
    assert "left eye" in answers[0]["reason"]
    ros.spin_until(lambda: len(rig.odometry) == 12, "a pose for every frozen pair")
    assert 0.85 < odom_x_m() < 0.91
    grown = [m.pose.covariance[0] for m in rig.odometry[7:]]
    assert all(later > earlier for earlier, later in pairwise(grown))
    after = [rig.answer(stamp_ns(i), rig.at(i))["status"] for i in range(12, 15)]
    assert after == 3 * ["TRACKING"]
    assert 1.09 < odom_x_m() < 1.15
    seen = rig.wait_for(gate_events=2, left_corrections=1, right_corrections=1, left_gate="settle")
    assert "camera 'right': ffc of 0.500 s" in seen["last_gate_event"]

    # Frozen for longer than it may coast: odom falls silent, status says why.
    ros.spin_until(lambda: len(rig.odometry) == 15, "a pose for every pair")
    frozen = rig.at(14)
    lost = [rig.answer(stamp_ns(i), frozen) for i in range(15, 23)]
    assert [answer["status"] for answer in lost] == 5 * ["GAP"] + 3 * ["LOST"]
    assert lost[-1]["reason"]
    assert rig.answer(stamp_ns(23), rig.at(15))["status"] in ("LOST", "TRACKING")
    back = rig.answer(stamp_ns(24), rig.at(16))
    assert back["status"] == "TRACKING"
    assert int(back["reset_counter"]) == 1
    ros.spin_until(lambda: rig.odom_stamps_ns()[-1] == stamp_ns(24), "the last pose")
    assert set(rig.odom_stamps_ns()).isdisjoint(stamp_ns(i) for i in range(20, 23))
    assert rig.odom_stamps_ns() == sorted(set(rig.odom_stamps_ns()))

    # Asked to start again: the pose goes on from the last one.
    x_m = odom_x_m()
    request = Trigger.Request()
    reset = ros.call(ros.node.create_client(Trigger, "onboard/reset"), request)
    assert reset.success
    assert "from its last pose" in reset.message
    assert rig.answer(stamp_ns(25), rig.at(17))["status"] == "INITIALISING"
    assert odom_x_m() == pytest.approx(x_m, abs=1e-6)
    seen = rig.wait_for(resets=1, reset_reason="asked for by service")
    assert "latency_ms_p95" in seen

    # The stamps go back, as when a recording starts anew: told, and no jump either.
    start_ns -= 3600_000_000_000
    assert rig.answer(stamp_ns(0), rig.at(18))["status"] == "INITIALISING"
    assert odom_x_m() == pytest.approx(x_m, abs=1e-6)
    seen = rig.wait_for(resets=2)
    assert "went back" in seen["reset_reason"]
    assert int(seen["stamps_of_another_time"]) >= 1

    # Too much at once: the newest wins, the dropped are counted, nothing is answered twice.
    answered = len(rig.statuses) - 1  # the pairing counts from where the stamps went back
    images = [rig.at(18 + i) for i in range(3)]
    sent = 0

    def burst() -> bool:
        nonlocal sent
        for _ in range(20):
            sent += 1
            rig.publish(stamp_ns(sent), images[sent % 3])
        return int(rig.diagnosis()["pairs_dropped"]) > 0

    ros.spin_until(burst, "dropped pairs")
    sent_s = time.monotonic()

    def newest_answered() -> bool:
        nonlocal sent, sent_s
        if conversions.stamp_from_msg(rig.statuses[-1].header.stamp) == stamp_ns(sent):
            return rig.diagnosis()["pairs_answered"] == str(len(rig.statuses))
        # The newest of a burst may be lost on the way too: cameras go on, so another follows.
        if time.monotonic() - sent_s > 5.0:
            sent, sent_s = sent + 1, time.monotonic()
            rig.publish(stamp_ns(sent), images[sent % 3])
        return False

    ros.spin_until(newest_answered, "the newest pair and its answer")
    seen = rig.diagnosis()
    answered = int(seen["pairs_answered"]) - answered
    alone = int(seen["left_alone"]) + int(seen["right_alone"])
    assert 1 < answered < sent
    decided = answered + int(seen["pairs_dropped"])
    assert int(seen["pairs"]) <= decided <= int(seen["pairs"]) + alone <= 2 * sent
    stamps = [conversions.stamp_from_msg(m.header.stamp) for m in rig.statuses[-answered:]]
    assert stamps == sorted(set(stamps))
    assert 0.0 < float(seen["cpu_percent"]) < 400.0
    assert 50.0 < float(seen["memory_mb"]) < 2000.0
    assert float(seen["skew_ms_max"]) == 0.0
    assert node.poll() is None


def test_a_recording_plays_the_cameras(ros, write_bag, tmp_path: Path) -> None:
    """Capture, pipeline and gyro in one process; images go out only to those who listen."""
    bag = tmp_path / "ramp"
    write_bag(bag)
    said = Listener(ros)
    ros.start(
        "onboard_node",
        source="recording",
        recording__recording=bag,
        recording__speed=0.5,
        odometry__gyro__enabled=True,
    )
    imu = ros.node.create_publisher(Imu, "imu", QOS)

    def turn() -> None:
        """The rig of the recording turns by (2, -4, 3) mrad in 0.2 s, in axes of the rig."""
        message = Imu()
        message.header.stamp = ros.node.get_clock().now().to_msg()
        rate = default_T_base_rig()[:3, :3] @ np.array([0.01, -0.02, 0.015]) + 0.1
        vector = message.angular_velocity
        vector.x, vector.y, vector.z = map(float, rate)
        imu.publish(message)

    ros.node.create_timer(0.01, turn)
    ros.spin_until(lambda: len(said.odometry) > 5, "poses")
    seen = said.wait_for(camera_left_state="streaming", camera_right_state="streaming")
    assert int(seen["camera_pairs"]) >= int(seen["pairs_answered"]) > 0
    stamps = said.odom_stamps_ns()
    assert stamps == sorted(set(stamps))

    pictures: dict[str, list[Image]] = {}
    for topic in ("left/image_rect", "view/left", "view/matches", "right/image_raw"):
        pictures[topic] = []
        ros.node.create_subscription(Image, topic, pictures[topic].append, QOS)
    ros.spin_until(lambda: all(len(p) > 1 for p in pictures.values()), f"pictures {pictures}")
    got = {topic: images[-1] for topic, images in pictures.items()}
    assert {topic: image.encoding for topic, image in got.items()} == {
        "left/image_rect": "mono16",
        "view/left": "mono8",
        "view/matches": "bgr8",
        "right/image_raw": "mono16",
    }
    assert {(image.width, image.height) for image in got.values()} == {(320, 240)}
    matches = np.frombuffer(got["view/matches"].data, np.uint8).reshape(240, 320, 3)
    coloured = np.ptp(matches.astype(int), axis=2) > 40
    assert 0.01 < coloured.mean() < 0.6

    ros.spin_until(lambda: float(said.diagnosis().get("gyro_error_rad_s", 0)) > 0, "a bias")
    seen = said.diagnosis()
    assert int(seen["imu_samples"]) > 10
    bias = np.array(seen["gyro_bias_rad_s"].split(), dtype=float)
    expected = default_T_base_rig()[:3, :3].T @ np.full(3, 0.1)
    np.testing.assert_allclose(bias, expected, atol=0.03)
    assert 0.0 < float(seen["latency_ms_median"]) <= float(seen["latency_ms_p95"])
    assert float(seen["latency_ms_p95"]) <= float(seen["latency_ms_max"]) < 60_000.0
    assert seen["stamps_of_another_time"] == "0"


def test_every_number_equals_that_of_the_replay(ros, write_bag, tmp_path: Path) -> None:
    """The same pipeline: fed over topics, the node says what the replay of the bag says."""
    bag = tmp_path / "ramp"
    write_bag(bag, blind=range(8, 14))
    dataset, _ = open_dataset(bag)
    results = replay(dataset, dataset.calibration(), Config()).results
    fields = [odometry_fields(result, default_T_base_rig()) for result in results]
    expected = [conversions.odometry_to_msg(field) for field in fields if field is not None]
    assert len(expected) > 12

    said = Listener(ros)
    node = ros.start("onboard_node", process_all=True)
    infos = infos_from_calibration(
        with_rectification(dataset.calibration(), RectificationConfig())[0]
    )
    images = {e: ros.node.create_publisher(Image, f"{e}/image_raw", QOS) for e in EYES}
    calibrations = {e: ros.node.create_publisher(CameraInfo, f"{e}/camera_info", QOS) for e in EYES}

    def listening() -> bool:
        for eye in EYES:
            calibrations[eye].publish(conversions.camera_info_to_msg(infos[eye], 0, eye))
        return all(publisher.get_subscription_count() > 0 for publisher in images.values())

    ros.spin_until(listening, "the node to ask for images")
    for frame in dataset.frames():
        images[frame.camera].publish(conversions.image_to_msg(frame.image, frame.stamp_ns, "x"))
    ros.spin_until(lambda: len(said.odometry) >= len(expected), "a pose for every result")
    for got, wanted in zip(said.odometry, expected, strict=True):
        assert got.header.stamp == wanted.header.stamp
        np.testing.assert_allclose(numbers(got), numbers(wanted), rtol=1e-6, atol=1e-9)

    # Then the cameras fall silent, which is told, and no reason to end.
    said.wait_for(left_gate="fault", right_gate="fault")
    blind = "left is blind: stuck shutter or dead stream"
    ros.spin_until(lambda: blind in said.health[-1].status[0].message, "an error")
    assert said.health[-1].status[0].level == b"\x02"
    assert "still going on" in said.diagnosis()["last_gate_event"]
    assert node.poll() is None
