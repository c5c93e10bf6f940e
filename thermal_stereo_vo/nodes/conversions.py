"""ROS messages to and from the vocabulary of ``core``; the only file that knows message fields.

Nothing is computed here: frames, covariances and packing come from ``outputs.ros_fields``.
"""

from __future__ import annotations

import sys
from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2, PointField
from stereo_msgs.msg import DisparityImage

from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.image_encoding import decode_pixels
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.outputs.ros_fields import (
    DiagnosticFields,
    DisparityFields,
    OdometryFields,
    PointCloudFields,
    stamp_fields,
)

_ENCODINGS = {np.dtype(np.uint8): "mono8", np.dtype(np.uint16): "mono16"}


def stamp_from_msg(stamp: Time) -> int:
    """``builtin_interfaces/Time`` to nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_to_msg(stamp_ns: int) -> Time:
    """Nanoseconds to ``builtin_interfaces/Time``."""
    sec, nanosec = stamp_fields(stamp_ns)
    return Time(sec=sec, nanosec=nanosec)


def clock_to_msg(stamp_ns: int) -> Clock:
    """Nanoseconds to ``rosgraph_msgs/Clock``."""
    return Clock(clock=stamp_to_msg(stamp_ns))


def image_from_msg(message: Image) -> NDArray[Any]:
    """(H, W) uint8 or uint16 in the byte order of this machine; 8-bit colour becomes grey.

    Raises FrameError for an encoding without linear grey value and for data that does not fit.
    """
    return decode_pixels(
        str(message.encoding),
        int(message.height),
        int(message.width),
        int(message.step),
        bool(message.is_bigendian),
        np.frombuffer(message.data, dtype=np.uint8),
        f"'{message.header.frame_id}'",
    )


def image_to_msg(image: NDArray[Any], stamp_ns: int, frame_id: str) -> Image:
    """(H, W) uint8 or uint16 to ``mono8`` or ``mono16``.

    Raises FrameError for another type or shape.
    """
    encoding = _ENCODINGS.get(image.dtype)
    if encoding is None or image.ndim != 2:
        raise FrameError(
            f"an image of shape {image.shape} and type {image.dtype} cannot be published: give a "
            "single channel of 8 or 16 bits"
        )
    return _image(image, encoding, stamp_ns, frame_id)


def picture_to_msg(picture: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """(H, W, 3) uint8, blue first, to ``bgr8``."""
    return _image(picture, "bgr8", stamp_ns, frame_id)


def mask_from_msg(message: Image) -> NDArray[np.bool_]:
    """(H, W) bool of a ``mono8`` image, True where it is not 0."""
    return np.asarray(image_from_msg(message), dtype=np.bool_)


def mask_to_msg(mask: NDArray[np.bool_], stamp_ns: int, frame_id: str) -> Image:
    """(H, W) bool to ``mono8``, 255 where a pixel may be used."""
    return image_to_msg(mask.astype(np.uint8) * np.uint8(255), stamp_ns, frame_id)


def camera_info_from_msg(message: CameraInfo) -> CameraInfoFields:
    """The calibration in a ``sensor_msgs/CameraInfo``.

    Raises CalibrationError when it says that the camera is not calibrated.
    """
    return CameraInfoFields(
        width=int(message.width),
        height=int(message.height),
        distortion_model=str(message.distortion_model),
        d=tuple(map(float, message.d)),
        k=tuple(map(float, message.k)),
        r=tuple(map(float, message.r)),
        p=tuple(map(float, message.p)),
        name=str(message.header.frame_id),
    )


def camera_info_to_msg(info: CameraInfoFields, stamp_ns: int, frame_id: str) -> CameraInfo:
    """A calibration as ``sensor_msgs/CameraInfo``."""
    message = CameraInfo()
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    message.width, message.height = info.width, info.height
    message.distortion_model = info.distortion_model
    message.d, message.k, message.r, message.p = list(info.d), info.k, info.r, info.p
    return message


def imu_from_msg(message: Imu) -> ImuSample | None:
    """What a ``sensor_msgs/Imu`` measures; None when it measures no angular rate."""
    if message.angular_velocity_covariance[0] == -1.0:
        return None
    rate, force = message.angular_velocity, message.linear_acceleration
    measures_force = message.linear_acceleration_covariance[0] != -1.0
    return ImuSample(
        stamp_from_msg(message.header.stamp),
        np.array([rate.x, rate.y, rate.z]),
        np.array([force.x, force.y, force.z]) if measures_force else None,
    )


def odometry_to_msg(fields: OdometryFields) -> Odometry:
    """``nav_msgs/Odometry``; covariances row by row."""
    message = Odometry()
    message.header.stamp = stamp_to_msg(fields.stamp_ns)
    message.header.frame_id = fields.frame_id
    message.child_frame_id = fields.child_frame_id
    _fill(message.pose.pose.position, fields.position_m)
    _fill(message.pose.pose.orientation, fields.quat_xyzw)
    _fill(message.twist.twist.linear, fields.linear_m_s)
    _fill(message.twist.twist.angular, fields.angular_rad_s)
    message.pose.covariance = fields.pose_covariance.ravel()
    message.twist.covariance = fields.twist_covariance.ravel()
    return message


def transform_to_msg(fields: OdometryFields) -> TransformStamped:
    """The pose of an odometry message as a transform between the same frames."""
    message = TransformStamped()
    message.header.stamp = stamp_to_msg(fields.stamp_ns)
    message.header.frame_id = fields.frame_id
    message.child_frame_id = fields.child_frame_id
    _fill(message.transform.translation, fields.position_m)
    _fill(message.transform.rotation, fields.quat_xyzw)
    return message


def point_cloud_to_msg(fields: PointCloudFields) -> PointCloud2:
    """``sensor_msgs/PointCloud2`` of one row."""
    message = PointCloud2()
    message.header.stamp = stamp_to_msg(fields.stamp_ns)
    message.header.frame_id = fields.frame_id
    message.height, message.width = 1, fields.width
    message.fields = [
        PointField(name=name, offset=offset, datatype=fields.FLOAT32, count=1)
        for name, offset in zip(fields.names, fields.offsets, strict=True)
    ]
    message.is_bigendian = False
    message.point_step = fields.point_step
    message.row_step = fields.point_step * fields.width
    message.data = _bytes(fields.data)
    message.is_dense = True
    return message


def disparity_to_msg(fields: DisparityFields) -> DisparityImage:
    """``stereo_msgs/DisparityImage``; the whole image is its valid window."""
    message = DisparityImage()
    message.header.stamp = stamp_to_msg(fields.stamp_ns)
    message.header.frame_id = fields.frame_id
    message.image = _image(fields.image, "32FC1", fields.stamp_ns, fields.frame_id)
    message.f, message.t = fields.focal_px, fields.baseline_m
    height, width = fields.image.shape
    message.valid_window.height, message.valid_window.width = height, width
    message.min_disparity = fields.min_disparity_px
    message.max_disparity = fields.max_disparity_px
    message.delta_d = fields.delta_px
    return message


def diagnostics_to_msg(*statuses: DiagnosticFields) -> DiagnosticArray:
    """``diagnostic_msgs/DiagnosticArray`` with the stamp of the first status."""
    message = DiagnosticArray()
    message.header.stamp = stamp_to_msg(statuses[0].stamp_ns)
    message.status = [
        DiagnosticStatus(
            level=bytes([fields.level]),
            name=fields.name,
            message=fields.message,
            hardware_id=fields.hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in fields.values],
        )
        for fields in statuses
    ]
    return message


def diagnostics_from_msg(message: DiagnosticArray) -> list[DiagnosticFields]:
    """The statuses of an array, each with the stamp of its header."""
    stamp_ns = stamp_from_msg(message.header.stamp)
    return [
        DiagnosticFields(
            stamp_ns,
            status.level[0],
            status.name,
            status.message,
            tuple((pair.key, pair.value) for pair in status.values),
            status.hardware_id,
        )
        for status in message.status
    ]


def _image(image: NDArray[Any], encoding: str, stamp_ns: int, frame_id: str) -> Image:
    message = Image()
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    message.height, message.width = image.shape[:2]
    message.encoding = encoding
    message.is_bigendian = int(sys.byteorder == "big")
    message.step = image.nbytes // image.shape[0]
    message.data = _bytes(image)
    return message


def _bytes(values: NDArray[Any]) -> array[int]:
    # rclpy copies an array.array in one go, but checks bytes and lists element by element.
    data = array("B")
    data.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return data


def _fill(message: Any, numbers: NDArray[np.float64]) -> None:
    for name, number in zip("xyzw", numbers, strict=False):
        setattr(message, name, float(number))
