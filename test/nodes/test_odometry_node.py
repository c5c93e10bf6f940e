"""The odometry node when things go wrong: resets, bad images, blindness."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.nodes import conversions

# The very first run compiles every kernel, on a machine that may be busy.
pytestmark = pytest.mark.timeout(900)

EYES = (LEFT, RIGHT)
PERIOD_NS = 100_000_000


class FakeRectifier:
    """Publishes rectified pairs of the ramp and waits for the node's answer to each."""

    def __init__(self, ros, ramp) -> None:
        self._ros = ros
        self._ramp = ramp
        camera = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
        self._calibration = RigCalibration(
            {
                LEFT: RigCamera(camera),
                RIGHT: RigCamera(camera, make_transform(np.eye(3), [0.3, 0.0, 0.0])),
            },
            rectified=True,
        )
        self.camera = camera
        self.odometry: list[Odometry] = []
        self.statuses: list[DiagnosticArray] = []
        self.health: list[DiagnosticArray] = []
        node, qos = ros.node, QoSProfile(depth=100)
        node.create_subscription(Odometry, "odom", self.odometry.append, qos)
        node.create_subscription(DiagnosticArray, "status", self.statuses.append, qos)
        node.create_subscription(DiagnosticArray, "/diagnostics", self.health.append, qos)
        self._images = {e: node.create_publisher(Image, f"{e}/image_rect", qos) for e in EYES}
        infos = {e: node.create_publisher(CameraInfo, f"{e}/camera_info", qos) for e in EYES}
        fields = infos_from_calibration(self._calibration)

        def send_infos() -> None:
            for eye in EYES:
                infos[eye].publish(conversions.camera_info_to_msg(fields[eye], 0, f"{eye}_optical"))

        node.create_timer(0.5, send_infos)

    def wait_until_listening(self) -> None:
        self._ros.spin_until(
            lambda: all(p.get_subscription_count() > 0 for p in self._images.values()),
            "the node to ask for images",
        )

    def seen(self, eye: str, step: int) -> np.ndarray:
        """The eye's image after ``step`` steps of 8 cm ahead."""
        T_world_rig = exp_se3([0.0, 0.0, 0.08 * step, 0.0, 0.0, 0.0])
        return self._ramp.image(self.camera, T_world_rig @ self._calibration[eye].T_rig_camera)

    def publish(self, stamp_ns: int, images: dict[str, np.ndarray]) -> None:
        for eye, image in images.items():
            self._images[eye].publish(conversions.image_to_msg(image, stamp_ns, f"{eye}_optical"))

    def answer(self, stamp_ns: int, images: dict[str, np.ndarray]) -> dict[str, str]:
        """Publish a pair; the status that answers it."""
        before = len(self.statuses)
        self.publish(stamp_ns, images)
        self._ros.spin_until(lambda: len(self.statuses) > before, f"a status at {stamp_ns}")
        message = self.statuses[-1]
        assert conversions.stamp_from_msg(message.header.stamp) == stamp_ns
        return {item.key: item.value for item in message.status[0].values}

    def at(self, step: int) -> dict[str, np.ndarray]:
        return {eye: self.seen(eye, step) for eye in EYES}

    def last_x_m(self) -> float:
        """Distance ahead of the last pose."""
        return float(self.odometry[-1].pose.pose.position.x)


def test_odometry_goes_on_through_trouble(ros, textured_ramp) -> None:
    rig = FakeRectifier(ros, textured_ramp)
    node = ros.start("stereo_odometry_node", odometry__status__coast_max_s=0.25)
    rig.wait_until_listening()
    start_ns = 5_000_000_000

    def stamp_ns(step: int) -> int:
        return start_ns + step * PERIOD_NS

    statuses = [rig.answer(stamp_ns(i), rig.at(i))["status"] for i in range(4)]
    assert statuses == ["INITIALISING", "TRACKING", "TRACKING", "TRACKING"]
    assert 0.22 < rig.last_x_m() < 0.26

    # An image of another size is refused by name, and the next pair goes on.
    rig.publish(stamp_ns(4), {eye: np.zeros((120, 160), np.uint16) for eye in EYES})
    ros.spin_until(
        lambda: any("160x120 pixels, but the calib" in m.status[0].message for m in rig.health),
        "the refusal in the diagnostics",
    )
    assert rig.health[-1].status[0].level == b"\x02"
    assert rig.answer(stamp_ns(5), rig.at(5))["status"] == "TRACKING"
    assert 0.37 < rig.last_x_m() < 0.43

    # The same stamp again is no pair.
    rig.publish(stamp_ns(5), rig.at(5))

    # Asked to start again: the pose goes on from the last one.
    answer = ros.call(ros.node.create_client(Trigger, "stereo_odometry/reset"), Trigger.Request())
    assert answer.success
    assert "from its last pose" in answer.message
    assert rig.answer(stamp_ns(6), rig.at(6))["status"] == "INITIALISING"
    assert 0.37 < rig.last_x_m() < 0.43
    assert rig.answer(stamp_ns(7), rig.at(7))["status"] == "TRACKING"
    assert 0.45 < rig.last_x_m() < 0.51

    # A recording that starts anew: stamps go back, the pose does not jump.
    start_ns = 1_000_000_000
    assert rig.answer(stamp_ns(0), rig.at(8))["status"] == "INITIALISING"
    assert rig.answer(stamp_ns(1), rig.at(9))["status"] == "TRACKING"
    assert 0.53 < rig.last_x_m() < 0.59

    # Blind for longer than it may coast: odom falls silent, status says why.
    blank = {eye: np.full((240, 320), 7000, np.uint16) for eye in EYES}
    poses = len(rig.odometry)
    blind = [rig.answer(stamp_ns(2 + i), blank) for i in range(4)]
    assert [values["status"] for values in blind] == ["GAP", "GAP", "LOST", "LOST"]
    assert blind[-1]["reason"] != ""
    assert len(rig.odometry) == poses + 2
    assert rig.odometry[-1].pose.covariance[0] > 10 * rig.odometry[poses - 1].pose.covariance[0]

    assert rig.answer(stamp_ns(6), rig.at(10))["status"] == "LOST"
    back = rig.answer(stamp_ns(7), rig.at(11))
    assert back["status"] == "TRACKING"
    assert int(back["reset_counter"]) >= 1
    assert len(rig.odometry) == poses + 3
    assert np.all(np.isfinite(rig.odometry[-1].pose.covariance))

    ros.spin_until(
        lambda: (
            _counter(rig.health[-1], "pairs") is not None
            and _counter(rig.health[-1], "resets") == 2
            and _counter(rig.health[-1], "refused") == 1
            and _counter(rig.health[-1], "repeated_stamps") == 2
        ),
        "the counters in the diagnostics",
    )
    assert node.poll() is None


def test_recordings_wait_for_the_late_eye(ros, textured_ramp) -> None:
    """One eye's topic may be discovered later: with process_all no pair is torn apart."""
    rig = FakeRectifier(ros, textured_ramp)
    ros.start("stereo_odometry_node", process_all=True)
    rig.wait_until_listening()
    for eye in EYES:
        for step in range(12):
            rig.publish(1_000_000_000 + step * PERIOD_NS, {eye: rig.seen(eye, step)})
    ros.spin_until(lambda: len(rig.statuses) >= 12, "a status for every pair")
    statuses = [message.status[0].values[0].value for message in rig.statuses]
    assert statuses == ["INITIALISING"] + 11 * ["TRACKING"]
    assert 0.85 < rig.last_x_m() < 0.91


def test_a_clock_that_goes_back_starts_the_odometry_anew(ros) -> None:
    health: list[DiagnosticArray] = []
    ros.node.create_subscription(DiagnosticArray, "/diagnostics", health.append, 10)
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    ros.start("stereo_odometry_node", use_sim_time=True)
    ros.spin_until(lambda: clock.get_subscription_count() > 0, "the node to follow the clock")

    now_s = [100]
    ros.node.create_timer(0.1, lambda: clock.publish(conversions.clock_to_msg(now_s[0] * 10**9)))
    for now_s[0] in (100, 160):
        before = len(health)
        ros.spin_until(lambda: len(health) > before, "a report")  # noqa: B023
    now_s[0] = 20
    ros.spin_until(lambda: (_counter(health[-1], "resets") or 0) > 0, "the reset")
    assert _counter(health[-1], "resets") == 1, "a jump ahead is no reason"
    assert "the clock went back by 140.000 s" in ros.logs()


def test_a_calibration_no_stereo_can_use_is_told(ros, textured_ramp) -> None:
    """Zero baseline and exchanged eyes are said in the diagnostics; the node stays alive."""
    messages: list[str] = []
    ros.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: messages.append(m.status[0].message), 10
    )
    camera = RigCamera(Camera(320, 240, 260.0, 260.0, 160.0, 120.0))
    fields = infos_from_calibration(RigCalibration({LEFT: camera, RIGHT: camera}, rectified=True))
    out = {eye: ros.node.create_publisher(CameraInfo, f"{eye}/camera_info", 10) for eye in EYES}

    def send() -> None:
        for eye in EYES:
            out[eye].publish(conversions.camera_info_to_msg(fields[eye], 0, f"{eye}_optical"))

    ros.node.create_timer(0.5, send)
    ros.start("stereo_odometry_node")
    ros.spin_until(
        lambda: any("baseline of in camera_info is 0.000 mm" in text for text in messages),
        "the complaint about the baseline",
    )


def _counter(message: DiagnosticArray, key: str) -> int | None:
    for item in message.status[0].values:
        if item.key == key:
            return int(item.value)
    return None
