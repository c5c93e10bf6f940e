"""Any recording, read or simulated, as a ROS 2 bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration, default_T_base_rig
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import Matrix, identity
from thermal_stereo_vo.datasets.base import Dataset
from thermal_stereo_vo.outputs.bag_writer import BagWriter
from thermal_stereo_vo.outputs.ros_fields import odom_pose, pose_fields, telemetry_fields
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

TRUTH_TOPIC = "/ground_truth"


class BagFeed(Protocol):
    """Further messages that go into the bag between the images."""

    def write(self, bag: BagWriter, up_to_ns: int | None) -> None:
        """Write those up to a stamp, or all that are left."""


def write_dataset(
    dataset: Dataset,
    path: Path,
    on_image: Callable[[], object] = lambda: None,
    feeds: Sequence[BagFeed] = (),
) -> int:
    """Write images, ``camera_info``, telemetry and truth; returns the number of images.

    Images go to ``/<role>/image_raw``, true poses to ``/ground_truth`` (``base_link`` in ``odom``
    axes).  The calibration gets the R and P that the rectifier would use, so that ``camera_info``
    says all of a stereo pair; it also lies as ``rig.yaml`` in the bag's folder.  ``on_image`` is
    called after each image; ``feeds`` add what else there is.  Nothing is left behind after an
    error.

    Raises DatasetError when ``path`` exists, and what the dataset raises.
    """
    calibration, T_rig_rectified = _completed(dataset.calibration())
    infos = {} if calibration is None else infos_from_calibration(calibration)
    T_base_rig = default_T_base_rig()
    if calibration is not None and calibration.T_base_rig is not None:
        T_base_rig = calibration.T_base_rig
    truth = _Truth(dataset.ground_truth(), T_rig_rectified, T_base_rig)
    count = 0
    with BagWriter(path) as bag:
        if calibration is not None:
            bag.write_calibration(calibration)
        for frame in dataset.frames():
            for feed in (truth, *feeds):
                feed.write(bag, frame.stamp_ns)
            camera, frame_id = f"/{frame.camera}", f"{frame.camera}_optical"
            bag.write_image(f"{camera}/image_raw", frame.stamp_ns, frame.image, frame_id)
            if frame.camera in infos:
                bag.write_camera_info(
                    f"{camera}/camera_info", frame.stamp_ns, infos[frame.camera], frame_id
                )
            if frame.telemetry is not None:
                status = telemetry_fields(frame.stamp_ns, frame.camera, frame.telemetry)
                bag.write_diagnostics(f"{camera}/status", status)
            count += 1
            on_image()
        for feed in (truth, *feeds):
            feed.write(bag, None)
    return count


class _Truth:
    """True poses that go into the bag between the images, in order of stamps."""

    def __init__(
        self, trajectory: Trajectory | None, T_rig_rectified: Matrix, T_base_rig: Matrix
    ) -> None:
        self._poses = (
            []
            if trajectory is None
            else list(zip(trajectory.stamps_ns, trajectory.T_world_rig, strict=True))
        )
        self._T_rig_rectified = T_rig_rectified
        self._T_base_rig = T_base_rig
        self._written = 0

    def write(self, bag: BagWriter, up_to_ns: int | None) -> None:
        """Write the poses up to a stamp, or all that are left."""
        while self._written < len(self._poses):
            stamp_ns, T_world_rig = self._poses[self._written]
            if up_to_ns is not None and stamp_ns > up_to_ns:
                return
            pose = odom_pose(T_world_rig @ self._T_rig_rectified, self._T_base_rig)
            bag.write_odometry(TRUTH_TOPIC, pose_fields(int(stamp_ns), pose))
            self._written += 1


def _completed(calibration: RigCalibration | None) -> tuple[RigCalibration | None, Matrix]:
    """The calibration with R and P of its stereo pair, and T_rig_rectified."""
    if calibration is None or not {LEFT, RIGHT} <= set(calibration.cameras):
        return calibration, identity()
    return with_rectification(calibration, RectificationConfig())
