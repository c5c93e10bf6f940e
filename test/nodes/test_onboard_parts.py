"""The parts of the onboard node one by one, and what it says to settings that cannot be."""

from __future__ import annotations

import mmap
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, Imu

from thermal_stereo_vo.core.calibration_yaml import dump_camera_info
from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.nodes import conversions, onboard_node
from thermal_stereo_vo.nodes.onboard_health import ANOTHER_TIME_MS, LatencyMeter
from thermal_stereo_vo.nodes.publisher import ResultPublisher
from thermal_stereo_vo.nodes.view_publisher import ViewPublisher
from thermal_stereo_vo.nodes.vitals import ProcessLoad, Window, resident_mb

EYES = (LEFT, RIGHT)
DEVICES = [
    text for eye in EYES for text in ("-p", f"grabbers.{eye}.device:=/dev/v4l/by-id/thermal_{eye}")
]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every image message that is made, by its encoding; they are made as ever."""
    encodings: list[str] = []
    real = conversions._image

    def counted(image, encoding, *rest):
        encodings.append(encoding)
        return real(image, encoding, *rest)

    monkeypatch.setattr(conversions, "_image", counted)
    return encodings


def test_no_image_is_made_unless_somebody_looks(ros, room, made) -> None:
    views = ViewPublisher(ros.node)
    T_world_rig = np.eye(4)
    T_world_rig[2, 3] = 0.5
    frame = room.rig_frame(5_000_000_000, T_world_rig)
    result = OdometryResult(5_000_000_000, TrackingStatus.TRACKING, T_world_rig, np.eye(6))
    ahead = T_world_rig[:3, 3] + np.array([[0.0, 0.0, 5.0], [1.0, -0.5, 6.0]])
    cloud = PointCloud(ahead.astype(np.float32), np.zeros(2, np.float32))

    def fly() -> None:
        views.on_rig_frame(frame)
        views.on_result(result)
        views.on_points(result.stamp_ns, cloud)

    fly()
    assert made == []

    right: list[Image] = []
    subscription = ros.node.create_subscription(
        Image, "right/image_rect", right.append, QoSProfile(depth=5)
    )
    ros.spin_until(lambda: ros.node.count_subscribers("right/image_rect") > 0, "the subscription")
    ros.spin_until(lambda: (fly(), len(right) > 0)[1], "the right image")
    assert set(made) == {"mono8"}  # the room is drawn with 8 bits
    assert conversions.stamp_from_msg(right[0].header.stamp) == frame.stamp_ns
    np.testing.assert_array_equal(conversions.image_from_msg(right[0]), frame.views[RIGHT].image)
    ros.node.destroy_subscription(subscription)
    ros.spin_until(
        lambda: ros.node.count_subscribers("right/image_rect") == 0, "the end of the subscription"
    )

    matches: list[Image] = []
    ros.node.create_subscription(Image, "view/matches", matches.append, QoSProfile(depth=5))
    made.clear()
    ros.spin_until(lambda: (fly(), len(matches) > 0)[1], "the picture of matches")
    assert "bgr8" in made
    picture = np.frombuffer(matches[0].data, np.uint8).reshape(240, 320, 3).astype(int)
    here = room.camera.project(ahead - T_world_rig[:3, 3])
    for x, y in np.rint(here).astype(int):
        assert np.ptp(picture[y, x]) > 60  # a coloured dot
    assert np.ptp(picture[5, 5]) == 0  # grey elsewhere

    # Lost, or an eye away: no picture of matches, and no stale one.
    count = len(made)
    views.on_result(replace(result, status=TrackingStatus.LOST, T_world_rig=None, covariance=None))
    views.on_points(result.stamp_ns, cloud)
    views.on_rig_frame(replace(frame, views={LEFT: frame.views[LEFT]}))
    views.on_result(result)
    views.on_points(result.stamp_ns, cloud)
    assert made[count:].count("bgr8") == 0


def test_figures_are_those_of_the_last_values() -> None:
    window = Window(100)
    assert window.fields("latency_ms", 50, 95, 100) == ()
    for value in range(1000):
        window.add(float(value))
    figures = dict(window.fields("latency_ms", 50, 95, 100))
    assert figures == {
        "latency_ms_median": "949.50",
        "latency_ms_p95": "994.05",
        "latency_ms_max": "999.00",
    }


def test_latency_is_measured_from_the_stamp_of_poses_only() -> None:
    now_ns = [10_000_000_000]
    meter = LatencyMeter(lambda: now_ns[0], 10)

    def result(stamp_ns, status=TrackingStatus.TRACKING):
        T = None if status is TrackingStatus.LOST else np.eye(4)
        return OdometryResult(stamp_ns, status, T, None)

    meter.on_result(result(now_ns[0] - 30_000_000))
    meter.on_result(result(now_ns[0] - 50_000_000, TrackingStatus.GAP))
    meter.on_result(result(now_ns[0] - 90_000_000, TrackingStatus.LOST))
    meter.on_result(result(now_ns[0] - round((ANOTHER_TIME_MS + 1) * 1e6)))
    meter.on_result(result(now_ns[0] + 1_000_000))
    assert dict(meter.fields()) == {
        "latency_ms_median": "40.00",
        "latency_ms_p95": "49.00",
        "latency_ms_max": "50.00",
        "stamps_of_another_time": "2",
    }


def test_load_is_that_since_the_last_look() -> None:
    load = ProcessLoad()
    end_s = time.process_time() + 0.2
    while time.process_time() < end_s:
        pass
    busy = dict(load.fields())
    time.sleep(0.3)
    idle = dict(load.fields())
    assert float(idle["cpu_percent"]) < float(busy["cpu_percent"])
    before_mb = resident_mb()
    # Fresh pages from the system; the allocator might hand out some that are resident already.
    block = np.frombuffer(mmap.mmap(-1, 40_000_000), np.uint8)
    block[:] = 1
    assert 30.0 < resident_mb() - before_mb < 60.0
    assert float(dict(load.fields())["memory_mb"]) > before_mb


def test_a_rate_that_is_not_measured_is_none() -> None:
    message = Imu()
    message.header.stamp.sec = 3
    message.angular_velocity.x, message.angular_velocity.z = 0.5, -2.0
    sample = conversions.imu_from_msg(message)
    assert sample is not None
    assert sample.stamp_ns == 3_000_000_000
    np.testing.assert_array_equal(sample.rate_rad_s, [0.5, 0.0, -2.0])
    covariance = message.angular_velocity_covariance
    covariance[0] = -1.0
    message.angular_velocity_covariance = covariance
    assert conversions.imu_from_msg(message) is None


def test_forces_come_with_the_rates() -> None:
    message = Imu()
    message.linear_acceleration.x, message.linear_acceleration.z = 0.3, 9.8
    sample = conversions.imu_from_msg(message)
    assert sample is not None
    np.testing.assert_array_equal(sample.force_m_s2, [0.3, 0.0, 9.8])
    covariance = message.linear_acceleration_covariance
    covariance[0] = -1.0
    message.linear_acceleration_covariance = covariance
    sample = conversions.imu_from_msg(message)
    assert sample is not None
    assert sample.force_m_s2 is None


def test_resets_are_counted_on_when_another_pipeline_takes_over(ros) -> None:
    """As after a calibration that changed in flight."""
    publisher = ResultPublisher(ros.node, np.eye(4), odom_frame="odom", base_frame="base")
    counted = []

    def publish(stamp_ns: int, reset_counter: int) -> None:
        tracking = TrackingStatus.TRACKING
        publisher.on_result(
            OdometryResult(
                stamp_ns, tracking, np.eye(4), np.eye(6), np.zeros(6), np.eye(6),
                reset_counter=reset_counter,
            )
        )  # fmt: skip
        assert publisher.last is not None
        counted.append(publisher.last.reset_counter)

    publisher.expect_another_pipeline()
    publish(1, 0)
    publish(2, 2)
    publisher.expect_another_pipeline()
    publish(3, 1)  # it was reset to the last pose
    publish(4, 2)
    assert counted == [0, 2, 3, 4]


@pytest.mark.parametrize("offered", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_files_in_place_of_camera_info(ros, room, tmp_path: Path, offered) -> None:
    """Given files, the node asks for images of which nobody publishes a calibration.

    It asks for what the sender offers: a reliable wish would find no best-effort sender, and of an
    unreliable image some packet is lost too often.
    """
    infos = infos_from_calibration(room.calibration())
    urls = {}
    for eye in EYES:
        path = tmp_path / f"{eye}.yaml"
        path.write_text(dump_camera_info(infos[eye]))
        urls[f"{eye}_calibration"] = f"file://{path}"
    node = ros.start("onboard_node", **urls)
    qos = QoSProfile(depth=9, reliability=offered)
    out = {eye: ros.node.create_publisher(Image, f"{eye}/image_raw", qos) for eye in EYES}
    ros.spin_until(lambda: all(p.get_subscription_count() > 0 for p in out.values()), "the node")
    for eye in EYES:
        (asked,) = ros.node.get_subscriptions_info_by_topic(f"{eye}/image_raw")
        assert asked.qos_profile.reliability == offered
    assert node.poll() is None


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["-p", "source:=topic"], "source must be one of topics, grabbers, recording, got 'topic'"),
        (["-p", "left_calibration:=LEFT"], "both left_calibration and right_calibration"),
        (["-p", "source:=recording"], "recording.recording names none"),
        (["-p", "source:=grabbers"], "left.device is not set"),
        (["-p", "source:=grabbers", *DEVICES], "the cameras are not calibrated: set left_calib"),
        (["-p", "left_calibration:=ftp://x"], "must begin with file:// or package://"),
        (["-p", "odometry.windw:=3"], "did you mean 'odometry.window'"),
    ],
)
def test_settings_that_cannot_be_end_with_one_line(
    arguments: list[str],
    complaint: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    room,
) -> None:
    left = tmp_path / "left.yaml"
    left.write_text(dump_camera_info(infos_from_calibration(room.calibration())[LEFT]))
    arguments = [argument.replace("LEFT", str(left)) for argument in arguments]
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    assert onboard_node.main(["onboard_node", "--ros-args", *arguments]) == 2
    error = capfd.readouterr().err.strip()
    assert error.startswith("onboard_node: ")
    assert complaint in error
    assert "\n" not in error
