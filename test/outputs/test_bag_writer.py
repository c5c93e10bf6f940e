"""Bags as we write them, read back by rosbags itself."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera, default_T_base_rig
from thermal_stereo_vo.core.errors import DatasetError, FrameError
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.outputs.bag_writer import BagWriter, ResultBag
from thermal_stereo_vo.outputs.ros_fields import (
    DiagnosticFields,
    odometry_fields,
    point_cloud_fields,
    status_fields,
)

STAMP = 1_700_000_000_123_456_789


def read(path):
    """[(topic, type, log time, message)] in order."""
    with AnyReader([path]) as reader:
        return [
            (c.topic, c.msgtype, stamp, reader.deserialize(data, c.msgtype))
            for c, stamp, data in reader.messages()
        ]


@pytest.mark.parametrize(("dtype", "encoding"), [(np.uint8, "mono8"), (np.uint16, "mono16")])
def test_images_keep_every_byte(tmp_path, rng, dtype, encoding):
    image = rng.integers(0, np.iinfo(dtype).max, (7, 9), dtype=dtype)
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image("/left/image_raw", STAMP, image, "left_optical")
        bag.write_image("/left/image_raw", STAMP + 1, image[::2, ::3], "left_optical")
    (topic, kind, log_ns, message), (_, _, _, strided) = read(tmp_path / "bag")
    assert (topic, kind, log_ns) == ("/left/image_raw", "sensor_msgs/msg/Image", STAMP)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert message.header.frame_id == "left_optical"
    assert (message.height, message.width, message.encoding) == (7, 9, encoding)
    assert message.step == 9 * image.itemsize
    assert message.data.tobytes() == image.astype(image.dtype.newbyteorder("<")).tobytes()
    assert strided.data.tobytes() == image[::2, ::3].tobytes()


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.float32), np.zeros((4, 4, 3), np.uint8)])
def test_other_images_are_refused_and_leave_nothing(tmp_path, image):
    with (
        pytest.raises(FrameError, match="cannot go into a bag: give a single channel"),
        BagWriter(tmp_path / "bag") as bag,
    ):
        bag.write_image("/left/image_raw", STAMP, image, "left_optical")
    assert list(tmp_path.iterdir()) == []


def test_camera_info_has_every_number(tmp_path):
    info = CameraInfoFields(
        width=640,
        height=512,
        distortion_model="plumb_bob",
        d=(-0.3, 0.1, 0.001, 0.002, 0.01),
        k=tuple(float(i) for i in range(1, 10)),
        r=tuple(float(i) for i in range(11, 20)),
        p=tuple(float(i) for i in range(21, 33)),
    )
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_camera_info("/left/camera_info", STAMP, info, "left_optical")
    [(_, kind, _, message)] = read(tmp_path / "bag")
    assert kind == "sensor_msgs/msg/CameraInfo"
    assert (message.width, message.height) == (640, 512)
    assert message.distortion_model == "plumb_bob"
    for name in "dkrp":
        assert tuple(getattr(message, name)) == getattr(info, name)


def test_odometry_points_and_status_of_a_result(tmp_path, rng):
    A = rng.normal(size=(6, 6))
    result = OdometryResult(
        stamp_ns=STAMP,
        status=TrackingStatus.TRACKING,
        T_world_rig=exp_se3(rng.normal(size=6)),
        covariance=A @ A.T,
        twist=rng.normal(size=6),
        twist_covariance=A @ A.T,
    )
    cloud = PointCloud(rng.normal(size=(5, 3)).astype(np.float32), np.arange(5, dtype=np.float32))
    odometry = odometry_fields(result, default_T_base_rig())
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_odometry("/odom", odometry)
        bag.write_points("/points", point_cloud_fields(STAMP, cloud, default_T_base_rig()))
        bag.write_diagnostics("/status", status_fields(result))
    messages = {topic: message for topic, _, _, message in read(tmp_path / "bag")}

    odom = messages["/odom"]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    position = odom.pose.pose.position
    assert [position.x, position.y, position.z] == odometry.position_m.tolist()
    q = odom.pose.pose.orientation
    assert [q.x, q.y, q.z, q.w] == odometry.quat_xyzw.tolist()
    assert np.array_equal(odom.pose.covariance.reshape(6, 6), odometry.pose_covariance)
    linear, angular = odom.twist.twist.linear, odom.twist.twist.angular
    assert [linear.x, linear.y, linear.z] == odometry.linear_m_s.tolist()
    assert [angular.x, angular.y, angular.z] == odometry.angular_rad_s.tolist()
    assert np.array_equal(odom.twist.covariance.reshape(6, 6), odometry.twist_covariance)

    points = messages["/points"]
    assert (points.height, points.width, points.point_step, points.row_step) == (1, 5, 16, 80)
    assert [(f.name, f.offset, f.datatype, f.count) for f in points.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
    ]
    values = points.data.view("<f4").reshape(5, 4)
    assert values[:, 3].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert np.allclose(values[:, 0], cloud.xyz[:, 2])  # forward is the camera's depth
    assert not points.is_bigendian
    assert points.is_dense

    [status] = messages["/status"].status
    assert (status.level, status.name) == (0, "odometry")
    assert {pair.key: pair.value for pair in status.values}["status"] == "TRACKING"


def test_imu_gps_and_position(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_imu(
            "/imu",
            STAMP,
            np.array([0.1, 0.2, 0.3]),
            np.array([1.0, 2.0, 9.81]),
            "imu",
            angular_variance=1e-6,
            acceleration_variance=1e-4,
        )
        bag.write_nav_sat_fix("/fix", STAMP, 47.1, 8.2, 512.0, "gps")
        bag.write_point("/position", STAMP, np.array([1.0, 2.0, 3.0]), "odom")
    messages = {topic: message for topic, _, _, message in read(tmp_path / "bag")}
    imu = messages["/imu"]
    assert imu.angular_velocity.z == 0.3
    assert imu.linear_acceleration.z == 9.81
    assert imu.orientation_covariance[0] == -1.0
    assert imu.angular_velocity_covariance.tolist() == (1e-6 * np.eye(3)).ravel().tolist()
    assert imu.linear_acceleration_covariance[8] == 1e-4
    fix = messages["/fix"]
    assert (fix.latitude, fix.longitude, fix.altitude) == (47.1, 8.2, 512.0)
    assert messages["/position"].point.y == 2.0


def test_metadata_is_what_jazzy_reads(tmp_path):
    with BagWriter(tmp_path / "result.mcap") as bag:
        for i in range(3):
            bag.write_diagnostics("/status", DiagnosticFields(STAMP + i, 0, "n", "m", ()))
    folder = tmp_path / "result.mcap"
    document = yaml.safe_load((folder / "metadata.yaml").read_text())
    information = document["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["message_count"] == 3
    assert information["duration"]["nanoseconds"] == 2
    [file] = information["relative_file_paths"]
    assert (folder / file).is_file()
    assert file == "result.mcap.mcap"
    [topic] = information["topics_with_message_count"]
    [qos] = topic["topic_metadata"]["offered_qos_profiles"]
    assert qos["reliability"] == "reliable"
    assert topic["topic_metadata"]["type_description_hash"].startswith("RIHS01_")


def test_nothing_is_seen_before_the_end(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path) as bag:
        bag.write_point("/position", STAMP, np.zeros(3), "odom")
        assert not path.exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_nothing_is_left_after_an_error(tmp_path):
    def fail_half_way() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            bag.write_point("/position", STAMP, np.zeros(3), "odom")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail_half_way()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_bag_is_never_overwritten(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(DatasetError, match="bag exists already: remove it or choose another name"):
        BagWriter(tmp_path / "bag")
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match=r"bag .*/bag cannot be written \(.+\): choose another"):
        BagWriter(tmp_path / "file" / "bag")


def test_calibration_lies_beside_the_messages(tmp_path):
    camera = Camera(64, 48, 70.0, 70.0, 32.0, 24.0)
    rig = RigCalibration(
        {
            "left": RigCamera(camera),
            "right": RigCamera(camera, make_transform(np.eye(3), [0.3, 0.0, 0.0])),
        },
        rectified=True,
    )
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_calibration(rig)
        bag.write_point("/position", STAMP, np.zeros(3), "odom")
    assert {"rig.yaml", "left.yaml", "right.yaml", "metadata.yaml"} <= {
        entry.name for entry in (tmp_path / "bag").iterdir()
    }


def test_result_bag_is_silent_about_the_pose_while_lost(tmp_path):
    bag = ResultBag(tmp_path / "result.mcap", default_T_base_rig())
    assert bag.wants_points
    statuses = (
        TrackingStatus.INITIALISING,
        TrackingStatus.TRACKING,
        TrackingStatus.LOST,
        TrackingStatus.DEGRADED,
    )
    for i, status in enumerate(statuses):
        lost = status is TrackingStatus.LOST
        bag.on_result(
            OdometryResult(
                stamp_ns=STAMP + i,
                status=status,
                T_world_rig=None if lost else np.eye(4),
                covariance=None if lost else np.eye(6),
            )
        )
        if not lost:
            bag.on_points(STAMP + i, PointCloud.empty())
    bag.close()
    messages = read(tmp_path / "result.mcap")
    stamps = {
        name: [stamp - STAMP for topic, _, stamp, _ in messages if topic == name]
        for name in ("/odom", "/points", "/status")
    }
    assert stamps == {"/odom": [0, 1, 3], "/points": [0, 1, 3], "/status": [0, 1, 2, 3]}
    levels = [m.status[0].level for topic, _, _, m in messages if topic == "/status"]
    assert levels == [0, 0, 2, 1]
