"""The nodes as processes, over DDS, give what the replay gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.datasets.registry import open_dataset, require_calibration
from thermal_stereo_vo.nodes.conversions import stamp_from_msg
from thermal_stereo_vo.outputs.ros_fields import odometry_fields
from thermal_stereo_vo.pipeline import Config, Pipeline


def offline(bag: Path) -> list[OdometryResult]:
    """The results of a replay without ROS."""
    dataset, _ = open_dataset(bag)
    pipeline = Pipeline(Config(), require_calibration(dataset))
    results = [result for frame in dataset.frames() for result in pipeline.push(frame)]
    results += pipeline.flush()
    pipeline.close()
    return results


def pose_of(message: Odometry) -> np.ndarray:
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


@pytest.mark.parametrize("rate", [1.0, 0.0], ids=["at rate 1", "as fast as answered"])
def test_chain_of_nodes_equals_replay(ros, ramp_bag: Path, rate: float) -> None:
    expected = offline(ramp_bag)
    tracked = [r for r in expected if r.status is TrackingStatus.TRACKING]
    assert len(tracked) >= 20, [r.status.value for r in expected]

    odometry: list[Odometry] = []
    statuses: list[DiagnosticArray] = []
    clouds: list[PointCloud2] = []
    clock_ns: list[int] = []
    qos = QoSProfile(depth=200)
    ros.node.create_subscription(Odometry, "odom", odometry.append, qos)
    ros.node.create_subscription(DiagnosticArray, "status", statuses.append, qos)
    ros.node.create_subscription(PointCloud2, "points", clouds.append, qos)
    ros.node.create_subscription(
        Clock, "/clock", lambda message: clock_ns.append(stamp_from_msg(message.clock)), qos
    )
    ros.start("rectification_node", process_all=True, use_sim_time=True)
    ros.start("stereo_odometry_node", process_all=True, use_sim_time=True)
    ros.spin_until(lambda: ros.node.count_publishers("status") > 0, "the odometry node")
    replay = ros.start("replay_node", source=ramp_bag, rate=rate)
    ros.spin_until(lambda: replay.poll() is not None, "the end of the recording")
    ros.spin_until(lambda: len(statuses) >= len(expected), "a status for every pair")
    ros.spin_until(lambda: len(odometry) >= len(expected), "a pose for every pair")
    assert replay.returncode == 0, ros.logs()

    assert "starts again" not in ros.logs()

    # No frame lost, none twice, none out of order.
    stamps_ns = [result.stamp_ns for result in expected]
    assert [stamp_from_msg(m.header.stamp) for m in odometry] == stamps_ns
    assert [stamp_from_msg(m.header.stamp) for m in statuses] == stamps_ns
    assert [stamp_from_msg(m.header.stamp) for m in clouds] == stamps_ns
    assert [_value(m, "status") for m in statuses] == [r.status.value for r in expected]
    assert [int(_value(m, "inliers")) for m in statuses] == [r.stats.inliers for r in expected]

    # The same numbers; only the baseline is divided once more on its way through camera_info.
    fields = [odometry_fields(result, default_T_base_rig()) for result in expected]
    wanted = np.array([np.concatenate([f.position_m, f.quat_xyzw]) for f in fields if f])
    got = np.array([pose_of(message) for message in odometry])
    np.testing.assert_allclose(got, wanted, rtol=0.0, atol=1e-9)
    for message, field in zip(odometry, fields, strict=True):
        assert field is not None
        np.testing.assert_allclose(
            message.pose.covariance, field.pose_covariance.ravel(), rtol=1e-6, atol=1e-12
        )
        np.testing.assert_allclose(
            message.twist.twist.linear.x, field.linear_m_s[0], rtol=1e-6, atol=1e-9
        )
    # base_link looks along the optical axis: the rig flew ahead by 8 cm a frame.
    assert 1.4 < wanted[-1, 0] < 2.2
    assert clouds[-1].width > 20

    assert clock_ns == sorted(clock_ns)
    assert stamps_ns[0] <= clock_ns[0] <= clock_ns[-1] == stamps_ns[-1]


def _value(message: DiagnosticArray, key: str) -> str:
    return next(item.value for item in message.status[0].values if item.key == key)
