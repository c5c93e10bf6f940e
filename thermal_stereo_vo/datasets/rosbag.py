"""Rosbags, without ROS: ROS 1 ``.bag``, ROS 2 sqlite3 and mcap, as folders or single files."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from thermal_stereo_vo.core.calibration_files import RIG_FILE, load_calibration
from thermal_stereo_vo.core.camera_info import CameraInfoFields, calibration_from_pair
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration, default_T_base_rig
from thermal_stereo_vo.core.errors import DatasetError, ThermalStereoError
from thermal_stereo_vo.core.frames import RawFrame, Telemetry
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import Matrix
from thermal_stereo_vo.datasets.bag_messages import (
    CAMERA_INFO,
    DIAGNOSTICS,
    IMAGE_TYPES,
    IMU,
    POSE_TYPES,
    angular_rate_of,
    camera_info_of,
    image_of,
    pose_of,
    specific_force_of,
    stamp_of,
    telemetry_of,
)
from thermal_stereo_vo.datasets.bag_topics import (
    camera_info_topic,
    choose_image_topics,
    choose_imu_topic,
    choose_truth_topic,
    is_rectified_name,
)
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.truth import true_poses
from thermal_stereo_vo.outputs.ros_fields import world_pose

TELEMETRY_AGE_NS = 2_000_000_000
"""Temperatures this old still describe a camera."""


class RosbagDataset:
    """The eyes of a bag, streamed: memory does not grow with its length.

    ``topics`` maps role to image topic.  True poses of ``base_link`` become poses of the rig by the
    calibration's ``T_base_rig`` (default: forward-looking); poses of a frame called ``rig`` or
    ending in ``_optical`` are the rig's own.

    Raises DatasetError for a bag that is damaged or lacks what is needed.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self.name = path.resolve().stem
        self._path = path
        with open_bag_reader(path) as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount > 0}
            images = [topic for topic, kind in kinds.items() if kind in IMAGE_TYPES]
            self.topics, self.reason = choose_image_topics(
                images,
                options.left_topic,
                options.right_topic,
                options.visible_topic,
                options.thermal_topic,
            )
            self.cameras = tuple(self.topics)
            self._count = reader.topics[self.topics[self.cameras[0]]].msgcount
            self._diagnostics = [topic for topic, kind in kinds.items() if kind == DIAGNOSTICS]
            self._imu_topic = choose_imu_topic(
                [topic for topic, kind in kinds.items() if kind == IMU], options.imu_topic
            )
            self._truth_topic = choose_truth_topic(
                [topic for topic, kind in kinds.items() if kind in POSE_TYPES],
                options.ground_truth_topic,
            )
            self.image_sizes = self._check_sizes(reader)
            self._calibration = self._find_calibration(reader, kinds, options)

    def calibration(self) -> RigCalibration | None:
        """The given calibration, or ``rig.yaml`` in the bag's folder, or that of camera_info."""
        return self._calibration

    def instants(self) -> int | None:
        """Number of images of the first camera."""
        return int(self._count)

    def frames(self) -> Iterator[RawFrame]:
        """All frames in order of stamp, the first camera before the second at equal stamps."""
        # One reader for each eye: they advance independently, however the recorder interleaved.
        streams = [self._frames_of(role) for role in self.cameras]
        yield from heapq.merge(*streams, key=lambda frame: frame.stamp_ns)

    def ground_truth(self) -> Trajectory | None:
        """True poses of the rig, or None."""
        topic = self._truth_topic
        if topic is None:
            return None
        T_base_rig = None if self._calibration is None else self._calibration.T_base_rig
        if T_base_rig is None:
            T_base_rig = default_T_base_rig()
        return read_bag_poses(self._path, topic, T_base_rig)

    def imu(self) -> Iterator[ImuSample]:
        """What the inertial topic says; nothing without one."""
        if self._imu_topic is None:
            return
        last_ns = -1
        with open_bag_reader(self._path) as reader:
            for _, log_ns, message in read_messages(reader, [self._imu_topic], self._path):
                stamp_ns, rate_rad_s = stamp_of(message, log_ns), angular_rate_of(message)
                if rate_rad_s is not None and stamp_ns > last_ns:
                    last_ns = stamp_ns
                    yield ImuSample(stamp_ns, rate_rad_s, specific_force_of(message))

    def _frames_of(self, role: str) -> Iterator[RawFrame]:
        topic = self.topics[role]
        telemetry = _TelemetryFeed(self._path, self._diagnostics, role)
        last_ns = None
        with open_bag_reader(self._path) as reader:
            for sequence, (kind, log_ns, message) in enumerate(
                read_messages(reader, [topic], self._path)
            ):
                stamp_ns = stamp_of(message, log_ns)
                if last_ns is not None and stamp_ns <= last_ns:
                    raise DatasetError(
                        f"stamps of {topic} do not increase: image {sequence} at {stamp_ns} ns "
                        f"comes after {last_ns} ns; cut the bag there, or correct the driver"
                    )
                last_ns = stamp_ns
                image = image_of(message, kind, topic)
                size = (image.shape[1], image.shape[0])
                if size != self.image_sizes[role]:
                    before = "x".join(str(side) for side in self.image_sizes[role])
                    raise DatasetError(
                        f"image {sequence} of {topic} is {size[0]}x{size[1]} pixels, but the bag "
                        f"began with {before}: cut the bag there"
                    )
                yield RawFrame(image, stamp_ns, role, sequence, telemetry.at(stamp_ns))

    def _check_sizes(self, reader: AnyReader) -> dict[str, tuple[int, int]]:
        """(width, height) of each camera; the eyes of a stereo pair must be alike."""
        sizes = {}
        for role, topic in self.topics.items():
            kind, _, message = next(read_messages(reader, [topic], self._path))
            height, width = image_of(message, kind, topic).shape
            sizes[role] = (width, height)
        if set(sizes) == {LEFT, RIGHT} and sizes[LEFT] != sizes[RIGHT]:
            told = " and ".join(f"{self.topics[eye]} is {w}x{h}" for eye, (w, h) in sizes.items())
            raise DatasetError(
                f"the images of {self._path} differ in size: {told} pixels; both eyes must be "
                "alike (choose others with --left-topic and --right-topic)"
            )
        return sizes

    def _find_calibration(
        self, reader: AnyReader, kinds: Mapping[str, str], options: SourceOptions
    ) -> RigCalibration | None:
        if options.calibration is not None:
            return load_calibration(options.calibration, self.image_sizes[self.cameras[0]])
        if (self._path / RIG_FILE).is_file():
            return load_calibration(self._path / RIG_FILE)
        infos: dict[str, CameraInfoFields] = {}
        for role, image_topic in self.topics.items():
            topic = camera_info_topic(image_topic)
            if kinds.get(topic) != CAMERA_INFO:
                return None
            _, _, message = next(read_messages(reader, [topic], self._path))
            info = camera_info_of(message, topic)
            if info is None:
                return None
            infos[role] = info
        if set(infos) != {LEFT, RIGHT}:
            return None
        named_rectified = all(is_rectified_name(topic) for topic in self.topics.values())
        calibration = calibration_from_pair(
            infos[LEFT],
            infos[RIGHT],
            rectified=True if named_rectified else None,
            origin=f"camera_info of {self._path}",
        )
        calibration.check_stereo()
        return calibration


def open_bag(path: Path, options: SourceOptions) -> tuple[RosbagDataset, str]:
    """Open a bag file or folder, and say what it is and which topics were taken."""
    dataset = RosbagDataset(path, options)
    kind = "ROS 1 bag" if bag_files(path)[0].suffix == ".bag" else "ROS 2 bag"
    return dataset, f"{kind}: {dataset.reason}"


def bag_files(path: Path) -> list[Path]:
    """What to hand to the reader: the folder itself, or the storage files of one without metadata.

    The reader takes whatever is called ``.bag`` for a file of ROS 1: of such a folder too it gets
    the files.  Raises DatasetError for a folder without any.
    """
    if path.is_file() or ((path / "metadata.yaml").is_file() and path.suffix != ".bag"):
        return [path]
    for suffix in (".mcap", ".db3", ".bag"):
        files = sorted(path.glob(f"*{suffix}"))
        if files:
            return files
    raise DatasetError(f"{path} is no bag: it has neither metadata.yaml nor .mcap, .db3 or .bag")


@contextmanager
def open_bag_reader(path: Path) -> Iterator[AnyReader]:
    """A reader on a bag.  Raises DatasetError when the bag is damaged, also while reading it."""
    with _readable(path):
        # Bags of older distributions carry no message definitions.
        reader = AnyReader(bag_files(path), default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    try:
        yield reader
    finally:
        reader.close()


def read_messages(
    reader: AnyReader, topics: list[str], path: Path
) -> Iterator[tuple[str, int, Any]]:
    """(type, time of recording in ns, message) of the topics, in order of recording."""
    connections = [c for c in reader.connections if c.topic in topics]
    if not connections:  # rosbags takes none for all
        return
    messages = reader.messages(connections)
    while True:
        with _readable(path):
            try:
                connection, log_ns, data = next(messages)
            except StopIteration:
                return
            message = reader.deserialize(data, connection.msgtype)
        yield connection.msgtype, log_ns, message


def read_bag_poses(path: Path, topic: str, T_base_rig: Matrix) -> Trajectory:
    """The poses of a topic of odometry or stamped poses, as poses of the rig.

    Poses of a frame called ``rig`` or ending in ``_optical`` are the rig's own; all others are
    taken for ``base_link``.  Raises DatasetError for poses that are none.
    """
    stamps, poses = [], []
    with open_bag_reader(path) as reader:
        for kind, log_ns, message in read_messages(reader, [topic], path):
            T, child = pose_of(message, kind, topic)
            is_rig = child == "rig" or child.endswith("_optical")
            stamps.append(stamp_of(message, log_ns))
            poses.append(T if is_rig else world_pose(T, T_base_rig))
    return true_poses(stamps, poses, f"{topic} in {path}")


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever a damaged file does to the reader becomes one sentence."""
    try:
        yield
    except ThermalStereoError:
        raise
    except Exception as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(
            f"the bag {path} cannot be read ({cause.rstrip('.')}): it is damaged or was cut "
            "short; copy it again, or repair it ('mcap recover', 'ros2 bag reindex', ROS 1: "
            "'rosbag reindex')"
        ) from error


class _TelemetryFeed:
    """Telemetry of one camera, read alongside its images."""

    def __init__(self, path: Path, topics: list[str], camera: str) -> None:
        self._stream = self._read(path, topics, camera) if topics else iter(())
        self._next = next(self._stream, None)
        self._last: tuple[int, Telemetry] | None = None

    def at(self, stamp_ns: int) -> Telemetry | None:
        """Telemetry with this stamp, else temperatures of a moment ago; ask in order of stamps."""
        while self._next is not None and self._next[0] <= stamp_ns:
            self._last, self._next = self._next, next(self._stream, None)
        if self._last is None or stamp_ns - self._last[0] > TELEMETRY_AGE_NS:
            return None
        last_ns, telemetry = self._last
        if last_ns == stamp_ns:
            return telemetry
        return Telemetry(telemetry.fpa_temperature_kelvin, telemetry.housing_temperature_kelvin)

    @staticmethod
    def _read(path: Path, topics: list[str], camera: str) -> Iterator[tuple[int, Telemetry]]:
        with open_bag_reader(path) as reader:
            for _, log_ns, message in read_messages(reader, topics, path):
                telemetry = telemetry_of(message, camera)
                if telemetry is not None:
                    yield stamp_of(message, log_ns), telemetry
