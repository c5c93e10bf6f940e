"""Messages of bags (ROS 1 or ROS 2, as rosbags deserialises them) in the vocabulary of ``core``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.errors import CalibrationError, DatasetError, FrameError
from thermal_stereo_vo.core.frames import Image, Telemetry
from thermal_stereo_vo.core.image_encoding import decode_pixels
from thermal_stereo_vo.core.transforms import Matrix, make_transform, rotation_from_quat_xyzw
from thermal_stereo_vo.datasets.image_files import decode_grey
from thermal_stereo_vo.outputs.ros_fields import BASE_FRAME, telemetry_from_values

RAW_IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (RAW_IMAGE, COMPRESSED_IMAGE)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_TYPES = (ODOMETRY, POSE_STAMPED)


def stamp_of(message: Any, log_ns: int) -> int:
    """The stamp in the header, or the time of recording for a driver that leaves it at zero."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or log_ns


def image_of(message: Any, kind: str, topic: str) -> Image:
    """(H, W) uint8 or uint16 of an ``Image`` or ``CompressedImage``.

    Raises DatasetError for encodings without a grey value and for damaged images.
    """
    if kind == COMPRESSED_IMAGE:
        return decode_grey(np.asarray(message.data, dtype=np.uint8), f"an image of {topic}")
    try:
        return decode_pixels(
            message.encoding,
            message.height,
            message.width,
            message.step,
            bool(message.is_bigendian),
            np.asarray(message.data, dtype=np.uint8),
            topic,
        )
    except FrameError as error:
        raise DatasetError(str(error)) from None


def camera_info_of(message: Any, topic: str) -> CameraInfoFields | None:
    """The calibration of a ``CameraInfo``; None when it is that of an uncalibrated camera.

    Raises CalibrationError for matrices of the wrong size.
    """

    def numbers(letter: str) -> tuple[float, ...]:  # upper case in ROS 1, lower case in ROS 2
        values = getattr(message, letter, None)
        return tuple(map(float, getattr(message, letter.upper()) if values is None else values))

    k = numbers("k")
    if k[0] == 0.0:
        return None
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width > 0:
        raise CalibrationError(
            f"{topic} speaks of a binned or cropped image, which is not supported: calibrate in "
            "the video mode that was recorded, and give it with --calibration"
        )
    return CameraInfoFields(
        width=int(message.width),
        height=int(message.height),
        distortion_model=str(message.distortion_model),
        d=numbers("d"),
        k=k,
        r=numbers("r"),
        p=numbers("p"),
        name=topic,
    )


def pose_of(message: Any, kind: str, topic: str) -> tuple[Matrix, str]:
    """(4, 4) T_frame_child and the child's frame id (``base_link`` where there is none).

    Raises DatasetError for a pose that is none.
    """
    pose, child = message.pose, BASE_FRAME
    if kind == ODOMETRY:
        pose, child = pose.pose, str(message.child_frame_id) or BASE_FRAME
    p, q = pose.position, pose.orientation
    position_m = np.array([p.x, p.y, p.z])
    try:
        rotation = rotation_from_quat_xyzw([q.x, q.y, q.z, q.w])
    except ValueError:
        rotation = np.full((3, 3), np.nan)
    if not np.all(np.isfinite(rotation)) or not np.all(np.isfinite(position_m)):
        raise DatasetError(f"a pose of {topic} has no rotation or is not finite: leave it out")
    return make_transform(rotation, position_m), child


def angular_rate_of(message: Any) -> NDArray[np.float64] | None:
    """(3,) rad/s of an ``Imu``, or None for one that measures none (first covariance -1)."""
    if message.angular_velocity_covariance[0] == -1.0:
        return None
    w = message.angular_velocity
    return np.array([w.x, w.y, w.z])


def specific_force_of(message: Any) -> NDArray[np.float64] | None:
    """(3,) m/s^2 of an ``Imu``, or None for one that measures none (first covariance -1)."""
    if message.linear_acceleration_covariance[0] == -1.0:
        return None
    a = message.linear_acceleration
    return np.array([a.x, a.y, a.z])


def telemetry_of(message: Any, camera: str) -> Telemetry | None:
    """What a ``DiagnosticArray`` tells of ``camera``, or None."""
    for status in message.status:
        if camera in (status.hardware_id, status.name.rpartition("/")[2]):
            return telemetry_from_values({pair.key: pair.value for pair in status.values})
    return None
