"""Messages and arrays are the same thing in two shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

pytest.importorskip("rclpy", reason="rclpy is not installed")

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image

from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import CalibrationError, FrameError
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.outputs.ros_fields import (
    disparity_fields,
    odometry_fields,
    point_cloud_fields,
    status_fields,
)
from thermal_stereo_vo.stereo.dense import DisparityMap

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9))
IMAGES = st.one_of(arrays.arrays(np.uint8, SHAPES), arrays.arrays(np.uint16, SHAPES))
STAMPS = st.integers(0, 2**31 * 10**9 - 1)


@given(stamp_ns=STAMPS)
def test_stamps_survive_exactly(stamp_ns: int) -> None:
    assert conversions.stamp_from_msg(conversions.stamp_to_msg(stamp_ns)) == stamp_ns
    assert conversions.stamp_from_msg(conversions.clock_to_msg(stamp_ns).clock) == stamp_ns


@settings(max_examples=50, deadline=None)
@given(image=IMAGES, stamp_ns=STAMPS)
def test_images_survive_the_wire(image: np.ndarray, stamp_ns: int) -> None:
    message = conversions.image_to_msg(image, stamp_ns, "left_optical")
    received = deserialize_message(serialize_message(message), Image)
    assert conversions.stamp_from_msg(received.header.stamp) == stamp_ns
    assert received.header.frame_id == "left_optical"
    back = conversions.image_from_msg(received)
    assert back.dtype == image.dtype
    np.testing.assert_array_equal(back, image)


@settings(max_examples=50, deadline=None)
@given(image=IMAGES, padding=st.integers(0, 5), big=st.booleans())
def test_row_padding_and_byte_order_are_honoured(
    image: np.ndarray, padding: int, big: bool
) -> None:
    height, width = image.shape
    row = width * image.itemsize
    body = np.full((height, row + padding), 0xAB, np.uint8)
    body[:, :row] = image.astype(image.dtype.newbyteorder(">" if big else "<")).view(np.uint8)
    message = Image(
        height=height,
        width=width,
        encoding="16UC1" if image.itemsize == 2 else "8UC1",
        is_bigendian=int(big),
        step=row + padding,
        data=body.tobytes(),
    )
    back = conversions.image_from_msg(message)
    assert back.dtype.isnative
    assert back.flags.c_contiguous
    np.testing.assert_array_equal(back, image)


def test_a_slice_is_published_as_it_looks(rng: np.random.Generator) -> None:
    """An array that is not contiguous in memory, such as a crop, must not come out sheared."""
    whole = rng.integers(0, 16384, (20, 30), dtype=np.uint16)
    message = conversions.image_to_msg(whole[2:12:2, 3:20], 1, "left_optical")
    np.testing.assert_array_equal(conversions.image_from_msg(message), whole[2:12:2, 3:20])


def test_a_received_image_owns_its_memory(rng: np.random.Generator) -> None:
    image = rng.integers(0, 255, (4, 5), dtype=np.uint8)
    message = conversions.image_to_msg(image, 1, "left_optical")
    received = conversions.image_from_msg(message)
    message.data[0] = (message.data[0] + 1) % 256
    np.testing.assert_array_equal(received, image)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"encoding": "bgr16"}, r"'left_optical' have the encoding 'bgr16'"),
        ({"height": 5}, r"says 3x5 pixels of mono16 with 6 bytes a row, but brings 24 bytes"),
        ({"step": 5}, r"with 5 bytes a row"),
        ({"width": 0}, r"says 0x4 pixels"),
    ],
)
def test_an_image_that_lies_is_refused(changes: dict[str, object], complaint: str) -> None:
    message = conversions.image_to_msg(np.zeros((4, 3), np.uint16), 1, "left_optical")
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(FrameError, match=complaint):
        conversions.image_from_msg(message)


@pytest.mark.parametrize("image", [np.zeros((4, 3), np.float32), np.zeros((4, 3, 3), np.uint8)])
def test_only_single_channels_are_published(image: np.ndarray) -> None:
    with pytest.raises(FrameError, match="give a single channel of 8 or 16 bits"):
        conversions.image_to_msg(image, 1, "left_optical")


def test_masks_survive(rng: np.random.Generator) -> None:
    mask = rng.random((7, 5)) > 0.5
    back = conversions.mask_from_msg(conversions.mask_to_msg(mask, 3, "left_optical"))
    assert back.dtype == np.bool_
    np.testing.assert_array_equal(back, mask)


def test_camera_info_survives_the_wire() -> None:
    info = CameraInfoFields(
        width=640,
        height=512,
        distortion_model="plumb_bob",
        d=(-0.3, 0.1, 1e-4, -2e-4, 0.0),
        k=(510.1, 0.0, 320.3, 0.0, 511.2, 255.4, 0.0, 0.0, 1.0),
        r=(1.0, 0.0, 0.0, 0.0, 0.8, -0.6, 0.0, 0.6, 0.8),
        p=(500.0, 0.0, 318.0, -100.5, 0.0, 500.0, 250.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        name="right_optical",
    )
    message = conversions.camera_info_to_msg(info, 17, "right_optical")
    received = deserialize_message(serialize_message(message), CameraInfo)
    assert conversions.camera_info_from_msg(received) == info


def test_an_uncalibrated_camera_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"not calibrated \(K\[0\] = 0\)"):
        conversions.camera_info_from_msg(CameraInfo(width=640, height=512))


def result_at(stamp_ns: int, rng: np.random.Generator) -> OdometryResult:
    root = rng.normal(size=(6, 6))
    return OdometryResult(
        stamp_ns=stamp_ns,
        status=TrackingStatus.TRACKING,
        T_world_rig=exp_se3(rng.normal(size=6)),
        covariance=root @ root.T,
        twist=rng.normal(size=6),
        twist_covariance=np.diag(rng.random(6)),
    )


def test_odometry_carries_every_number(rng: np.random.Generator) -> None:
    fields = odometry_fields(result_at(1_500_000_000_123_456_789, rng), exp_se3(rng.normal(size=6)))
    message = conversions.odometry_to_msg(fields)
    pose, twist = message.pose.pose, message.twist.twist
    assert conversions.stamp_from_msg(message.header.stamp) == 1_500_000_000_123_456_789
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    assert [pose.position.x, pose.position.y, pose.position.z] == list(fields.position_m)
    q = pose.orientation
    assert [q.x, q.y, q.z, q.w] == list(fields.quat_xyzw)
    assert [twist.linear.x, twist.linear.y, twist.linear.z] == list(fields.linear_m_s)
    assert [twist.angular.x, twist.angular.y, twist.angular.z] == list(fields.angular_rad_s)
    np.testing.assert_array_equal(message.pose.covariance, fields.pose_covariance.ravel())
    np.testing.assert_array_equal(message.twist.covariance, fields.twist_covariance.ravel())


def test_the_transform_is_the_pose(rng: np.random.Generator) -> None:
    fields = odometry_fields(result_at(7, rng), np.eye(4))
    message = conversions.transform_to_msg(fields)
    t, q = message.transform.translation, message.transform.rotation
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    assert [t.x, t.y, t.z] == list(fields.position_m)
    assert [q.x, q.y, q.z, q.w] == list(fields.quat_xyzw)


def test_points_are_read_back_by_their_own_description(rng: np.random.Generator) -> None:
    cloud = PointCloud(
        rng.normal(size=(11, 3)).astype(np.float32), rng.random(11).astype(np.float32)
    )
    message = conversions.point_cloud_to_msg(point_cloud_fields(5, cloud, np.eye(4)))
    layout = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": ["<f4"] * len(message.fields),
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(message.data, dtype=layout)
    assert (message.height, message.width) == (1, 11)
    assert message.row_step == len(message.data)
    np.testing.assert_array_equal(np.column_stack([points[c] for c in "xyz"]), cloud.xyz)
    np.testing.assert_array_equal(points["intensity"], cloud.intensity)


def test_temperatures_are_one_more_column(rng: np.random.Generator) -> None:
    xyz, intensity, kelvin = (rng.random(shape).astype(np.float32) for shape in ((7, 3), 7, 7))
    cloud = PointCloud(xyz, intensity, kelvin)
    message = conversions.point_cloud_to_msg(point_cloud_fields(5, cloud, np.eye(4)))
    assert [(f.name, f.offset) for f in message.fields][4] == ("temperature", 16)
    assert (message.point_step, message.row_step) == (20, 140)
    table = np.frombuffer(message.data, "<f4").reshape(7, 5)
    np.testing.assert_array_equal(table[:, 4], kelvin)


def test_disparities_are_told_without_the_offset_of_the_principal_points() -> None:
    camera = Camera(3, 2, 500.0, 500.0, 10.0, 1.0)
    disparity = np.array([[20.0, np.nan, 9.0], [8.5, 30.0, np.nan]], np.float32)
    made = DisparityMap(7, disparity, disparity, (0.0, 31.0), camera, 8.0, 0.25, disparity)
    message = conversions.disparity_to_msg(disparity_fields(made, frame_id="left_optical"))
    assert conversions.stamp_from_msg(message.header.stamp) == 7
    assert (message.f, message.t) == (500.0, 0.25)
    assert (message.min_disparity, message.max_disparity) == (-2.0, 29.0)
    assert (message.valid_window.width, message.valid_window.height) == (3, 2)
    image = np.frombuffer(message.image.data, "<f4").reshape(2, 3)
    np.testing.assert_array_equal(image, [[18.0, -3.0, 7.0], [6.5, 28.0, -3.0]])
    np.testing.assert_allclose(message.f * message.t / image[0, 0], made.depth_m[0, 0])


def test_status_has_the_stamp_of_the_image(rng: np.random.Generator) -> None:
    lost = OdometryResult(42, TrackingStatus.LOST, None, None, reason="too few matches (3)")
    message = conversions.diagnostics_to_msg(status_fields(lost))
    (status,) = message.status
    values = {item.key: item.value for item in status.values}
    assert conversions.stamp_from_msg(message.header.stamp) == 42
    assert status.level == b"\x02"
    assert status.message == "too few matches (3)"
    assert values["status"] == "LOST"
    assert values["reset_counter"] == "0"
