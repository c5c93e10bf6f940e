"""Bags of every kind, written with rosbags message by message."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

KINDS = ("ros1", "sqlite3", "mcap", "mcap_zstd")


class Scribe:
    """Writes messages of ROS 1 or ROS 2 alike."""

    def __init__(self, writer: Any, ros1: bool) -> None:
        self._writer = writer
        self._ros1 = ros1
        self.types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}

    def make(self, kind: str, **values: Any) -> Any:
        return self.types.types[kind](**values)

    def header(self, stamp_ns: int, frame_id: str = "") -> Any:
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        extra = {"seq": 0} if self._ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def write(self, topic: str, log_ns: int, kind: str, **values: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self.types
            )
        message = self.make(kind, **values)
        encode = self.types.serialize_ros1 if self._ros1 else self.types.serialize_cdr
        self._writer.write(self._connections[topic], log_ns, encode(message, kind))

    def image(
        self,
        topic: str,
        stamp_ns: int,
        image: np.ndarray,
        *,
        encoding: str | None = None,
        log_ns: int | None = None,
        padding: int = 0,
        big: bool = False,
    ) -> None:
        """(H, W) or (H, W, C) image; rows are padded, byte order is turned when ``big``."""
        encoding = encoding or {"uint8": "mono8", "uint16": "mono16"}[image.dtype.name]
        wire = np.ascontiguousarray(image.astype(image.dtype.newbyteorder(">" if big else "<")))
        rows = wire.reshape(len(wire), -1).view(np.uint8).reshape(len(wire), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        self.write(
            topic,
            stamp_ns if log_ns is None else log_ns,
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns),
            height=image.shape[0],
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=rows.shape[1],
            data=np.ascontiguousarray(rows).reshape(-1),
        )

    def compressed(self, topic: str, stamp_ns: int, data: np.ndarray, name: str) -> None:
        self.write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp_ns),
            format=name,
            data=data,
        )

    def camera_info(
        self,
        topic: str,
        stamp_ns: int,
        *,
        k: Any,
        d: Any = (),
        r: Any = None,
        p: Any,
        size=(48, 32),
    ) -> None:
        arrays = {
            "k": k,
            "d": d,
            "r": np.eye(3).ravel() if r is None else r,
            "p": p,
        }
        matrices = {
            name.upper() if self._ros1 else name: np.array(values, dtype=np.float64)
            for name, values in arrays.items()
        }
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        self.write(
            topic,
            stamp_ns,
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp_ns),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **matrices,
        )

    def pose(self, position: Any, quat_xyzw: Any) -> Any:
        p = self.make("geometry_msgs/msg/Point", **dict(zip("xyz", position, strict=True)))
        q = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quat_xyzw, strict=True)))
        return self.make("geometry_msgs/msg/Pose", position=p, orientation=q)

    def pose_stamped(self, topic: str, stamp_ns: int, position: Any, quat_xyzw: Any) -> None:
        self.write(
            topic,
            stamp_ns,
            "geometry_msgs/msg/PoseStamped",
            header=self.header(stamp_ns, "map"),
            pose=self.pose(position, quat_xyzw),
        )

    def odometry(
        self, topic: str, stamp_ns: int, position: Any, quat_xyzw: Any, child: str
    ) -> None:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        self.write(
            topic,
            stamp_ns,
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, "map"),
            child_frame_id=child,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.pose(position, quat_xyzw),
                covariance=np.zeros(36),
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )

    def diagnostics(self, topic: str, stamp_ns: int, name: str, values: dict[str, str]) -> None:
        pairs = [
            self.make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in values.items()
        ]
        status = self.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=0,
            name=name,
            message="",
            hardware_id="",
            values=pairs,
        )
        self.write(
            topic,
            stamp_ns,
            "diagnostic_msgs/msg/DiagnosticArray",
            header=self.header(stamp_ns),
            status=[status],
        )


@contextmanager
def scribe(kind: str, path: Path):
    """Write a bag of one of ``KINDS``: a file ``path.bag``, else a folder ``path``."""
    if kind == "ros1":
        with Ros1Writer(path.with_suffix(".bag")) as writer:
            yield Scribe(writer, ros1=True)
        return
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    if kind == "mcap_zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        yield Scribe(writer, ros1=False)


def bag_path(kind: str, path: Path) -> Path:
    """What to open after ``scribe(kind, path)``."""
    return path.with_suffix(".bag") if kind == "ros1" else path
