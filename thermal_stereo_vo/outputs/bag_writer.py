"""ROS 2 bags (mcap storage) written without ROS, readable by ``ros2 bag`` of Jazzy."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import DatasetError, FrameError
from thermal_stereo_vo.core.frames import Image
from thermal_stereo_vo.core.results import OdometryResult, PointCloud
from thermal_stereo_vo.core.transforms import Matrix
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.outputs.ros_fields import (
    DiagnosticFields,
    OdometryFields,
    PointCloudFields,
    odometry_fields,
    point_cloud_fields,
    stamp_fields,
    status_fields,
)

_FOREVER = QosTime(9223372036, 854775807)
_RELIABLE = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)
_ENCODINGS = {np.dtype(np.uint8): "mono8", np.dtype(np.uint16): "mono16"}
UNKNOWN_COVARIANCE = 0
"""``sensor_msgs/NavSatFix.COVARIANCE_TYPE_UNKNOWN``."""


class BagWriter:
    """A bag folder in the making; it appears under its name only when all went well.

    Use as a context manager.  Each message is logged at its own stamp.  Connections are made at the
    first message of a topic.

    Raises DatasetError when ``path`` exists already or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        if path.exists():
            raise DatasetError(
                f"{path} exists already: remove it or choose another name for the bag"
            )
        self.path = path
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}
        # The files inside a bag carry the bag's name, so only the folder around it is temporary.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        except OSError as error:
            raise DatasetError(
                f"the bag {path} cannot be written ({error.strerror}): choose another place"
            ) from None
        self._writer = Writer(
            self._scratch / path.name, version=9, storage_plugin=StoragePlugin.MCAP
        )
        self._writer.open()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def close(self) -> None:
        """Finish the bag and give it its name."""
        try:
            self._writer.close()
            (self._scratch / self.path.name).rename(self.path)
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def abort(self) -> None:
        """Leave nothing behind."""
        self._writer.abort()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def write_calibration(self, calibration: RigCalibration) -> None:
        """Lay ``rig.yaml``, ``left.yaml`` and ``right.yaml`` beside the messages."""
        save_calibration(calibration, self._scratch / self.path.name)

    def write_image(self, topic: str, stamp_ns: int, image: Image, frame_id: str) -> None:
        """``sensor_msgs/Image``: (H, W) uint8 as mono8, uint16 as mono16.

        Raises FrameError for another type or shape.
        """
        encoding = _ENCODINGS.get(image.dtype)
        if encoding is None or image.ndim != 2:
            raise FrameError(
                f"an image of shape {image.shape} and type {image.dtype} cannot go into a bag: "
                "give a single channel of 8 or 16 bits"
            )
        height, width = image.shape
        self._write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/Image",
            header=self._header(stamp_ns, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=int(sys.byteorder == "big"),
            step=width * image.itemsize,
            data=np.ascontiguousarray(image).view(np.uint8).reshape(-1),
        )

    def write_camera_info(
        self, topic: str, stamp_ns: int, info: CameraInfoFields, frame_id: str
    ) -> None:
        """``sensor_msgs/CameraInfo``."""
        region = self._message(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        self._write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/CameraInfo",
            header=self._header(stamp_ns, frame_id),
            height=info.height,
            width=info.width,
            distortion_model=info.distortion_model,
            d=np.array(info.d, dtype=np.float64),
            k=np.array(info.k, dtype=np.float64),
            r=np.array(info.r, dtype=np.float64),
            p=np.array(info.p, dtype=np.float64),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def write_odometry(self, topic: str, fields: OdometryFields) -> None:
        """``nav_msgs/Odometry``."""
        pose = self._message(
            "geometry_msgs/msg/Pose",
            position=self._xyz("Point", fields.position_m),
            orientation=self._quaternion(fields.quat_xyzw),
        )
        twist = self._message(
            "geometry_msgs/msg/Twist",
            linear=self._xyz("Vector3", fields.linear_m_s),
            angular=self._xyz("Vector3", fields.angular_rad_s),
        )
        self._write(
            topic,
            fields.stamp_ns,
            "nav_msgs/msg/Odometry",
            header=self._header(fields.stamp_ns, fields.frame_id),
            child_frame_id=fields.child_frame_id,
            pose=self._message(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=pose,
                covariance=_row_major(fields.pose_covariance),
            ),
            twist=self._message(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=twist,
                covariance=_row_major(fields.twist_covariance),
            ),
        )

    def write_points(self, topic: str, fields: PointCloudFields) -> None:
        """``sensor_msgs/PointCloud2``."""
        spec = [
            self._message(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=fields.FLOAT32,
                count=1,
            )
            for name, offset in zip(fields.names, fields.offsets, strict=True)
        ]
        self._write(
            topic,
            fields.stamp_ns,
            "sensor_msgs/msg/PointCloud2",
            header=self._header(fields.stamp_ns, fields.frame_id),
            height=1,
            width=fields.width,
            fields=spec,
            is_bigendian=False,
            point_step=fields.point_step,
            row_step=fields.point_step * fields.width,
            data=fields.data,
            is_dense=True,
        )

    def write_diagnostics(self, topic: str, *statuses: DiagnosticFields) -> None:
        """``diagnostic_msgs/DiagnosticArray`` with the stamp of the first status."""
        stamp_ns = statuses[0].stamp_ns
        entries = [
            self._message(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=fields.level,
                name=fields.name,
                message=fields.message,
                hardware_id=fields.hardware_id,
                values=[
                    self._message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                    for key, value in fields.values
                ],
            )
            for fields in statuses
        ]
        self._write(
            topic,
            stamp_ns,
            "diagnostic_msgs/msg/DiagnosticArray",
            header=self._header(stamp_ns, ""),
            status=entries,
        )

    def write_imu(
        self,
        topic: str,
        stamp_ns: int,
        angular_rad_s: NDArray[np.float64],
        acceleration_m_s2: NDArray[np.float64],
        frame_id: str,
        *,
        angular_variance: float = 0.0,
        acceleration_variance: float = 0.0,
    ) -> None:
        """``sensor_msgs/Imu`` without orientation (its first covariance is -1, as ROS asks)."""
        no_orientation = np.zeros(9)
        no_orientation[0] = -1.0
        self._write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/Imu",
            header=self._header(stamp_ns, frame_id),
            orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=no_orientation,
            angular_velocity=self._xyz("Vector3", angular_rad_s),
            angular_velocity_covariance=_row_major(angular_variance * np.eye(3)),
            linear_acceleration=self._xyz("Vector3", acceleration_m_s2),
            linear_acceleration_covariance=_row_major(acceleration_variance * np.eye(3)),
        )

    def write_nav_sat_fix(
        self,
        topic: str,
        stamp_ns: int,
        latitude_deg: float,
        longitude_deg: float,
        altitude_m: float,
        frame_id: str,
    ) -> None:
        """``sensor_msgs/NavSatFix`` with a GPS fix of unknown covariance."""
        self._write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/NavSatFix",
            header=self._header(stamp_ns, frame_id),
            status=self._message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=float(latitude_deg),
            longitude=float(longitude_deg),
            altitude=float(altitude_m),
            position_covariance=np.zeros(9),
            position_covariance_type=UNKNOWN_COVARIANCE,
        )

    def write_point(
        self, topic: str, stamp_ns: int, position_m: NDArray[np.float64], frame_id: str
    ) -> None:
        """``geometry_msgs/PointStamped``."""
        self._write(
            topic,
            stamp_ns,
            "geometry_msgs/msg/PointStamped",
            header=self._header(stamp_ns, frame_id),
            point=self._xyz("Point", position_m),
        )

    def _write(self, topic: str, stamp_ns: int, kind: str, **values: Any) -> None:
        connection = self._connections.get(topic)
        if connection is None:
            connection = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=[_RELIABLE]
            )
            self._connections[topic] = connection
        message = self._message(kind, **values)
        self._writer.write(connection, stamp_ns, self._types.serialize_cdr(message, kind))

    def _message(self, kind: str, **values: Any) -> Any:
        return self._types.types[kind](**values)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = stamp_fields(stamp_ns)
        stamp = self._message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._message("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _xyz(self, kind: str, values: NDArray[np.float64]) -> Any:
        x, y, z = (float(value) for value in values)
        return self._message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, quat_xyzw: NDArray[np.float64]) -> Any:
        x, y, z, w = (float(value) for value in quat_xyzw)
        return self._message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


class ResultBag(Observer):
    """What the odometry node would publish, as a bag: ``/odom``, ``/points`` and ``/status``.

    While LOST or in an arbitrary unit only ``/status`` is written.  ``T_base_rig`` (4, 4) maps the
    rig of the results to ``base_link``.
    """

    wants_points = True

    def __init__(self, path: Path, T_base_rig: Matrix) -> None:
        self._bag = BagWriter(path)
        self._T_base_rig = T_base_rig
        self._is_metric = True

    def on_result(self, result: OdometryResult) -> None:
        self._is_metric = result.is_metric
        odometry = odometry_fields(result, self._T_base_rig) if result.is_metric else None
        if odometry is not None:
            self._bag.write_odometry("/odom", odometry)
        self._bag.write_diagnostics("/status", status_fields(result))

    def on_points(self, stamp_ns: int, cloud: PointCloud) -> None:
        if not self._is_metric:
            return
        self._bag.write_points("/points", point_cloud_fields(stamp_ns, cloud, self._T_base_rig))

    def close(self) -> None:
        self._bag.close()


def _row_major(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.ascontiguousarray(matrix, dtype=np.float64).reshape(-1)
