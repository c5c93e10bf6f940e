"""Trajectories wherever they lie: text files, run folders, bags and recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.calibration_files import RIG_FILE, load_calibration
from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.errors import DatasetError, EvaluationError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.datasets.bag_messages import POSE_TYPES
from thermal_stereo_vo.datasets.bag_topics import choose_truth_topic
from thermal_stereo_vo.datasets.registry import BAG_SUFFIXES, SIMULATED, open_dataset
from thermal_stereo_vo.datasets.rosbag import open_bag_reader, read_bag_poses
from thermal_stereo_vo.outputs.run_folder import RUN_FILE, is_run_folder
from thermal_stereo_vo.outputs.trajectory_file import (
    Pose,
    TrajectoryFormat,
    kitti_trajectory,
    read_euroc,
    read_frame_stamps,
    read_kitti,
    read_tum,
    sniff_format,
)

ODOMETRY_TOPIC = "/odom"
DEFAULT_RATE_HZ = 10.0


@dataclass(frozen=True, eq=False)
class FoundTrajectory:
    """A trajectory, and in ``reason`` what it was found in.

    ``frame_stamps_ns`` (N,) are the stamps of all frames, also of those without a pose, where the
    source tells them.  ``T_rig_rectified`` turns true poses of the rig into those of the rectified
    left camera that a run estimates; None where they are the same.
    """

    trajectory: Trajectory
    reason: str
    frame_stamps_ns: NDArray[np.int64] | None = None
    T_rig_rectified: NDArray[np.float64] | None = None

    def for_frames(self, stamps_ns: NDArray[np.int64]) -> FoundTrajectory:
        """Itself: it has stamps of its own."""
        return self


@dataclass(frozen=True)
class UnstampedTrajectory:
    """A KITTI file: one pose for each frame, None where tracking was lost, but no stamps."""

    poses: Sequence[Pose | None]
    reason: str

    def for_frames(self, stamps_ns: NDArray[np.int64]) -> FoundTrajectory:
        """The poses with the stamps (N,) of their frames.

        Raises EvaluationError when the numbers of poses and frames differ.
        """
        trajectory = kitti_trajectory(self.poses, stamps_ns)
        return FoundTrajectory(trajectory, self.reason, stamps_ns)


def find_ground_truth(
    source: str | Path, *, topic: str | None = None
) -> FoundTrajectory | UnstampedTrajectory:
    """True poses of the rig in a file, a bag or a recording; ``for_frames`` gives them stamps.

    Raises DatasetError or EvaluationError for anything that holds no trajectory.
    """
    return _find(source, topic, is_truth=True)


def load_pair(
    estimate: str | Path,
    truth: str | Path,
    *,
    estimate_topic: str | None = None,
    truth_topic: str | None = None,
    rate_hz: float = DEFAULT_RATE_HZ,
) -> tuple[FoundTrajectory, FoundTrajectory]:
    """An estimate and its truth, each from a file, a run folder, a bag or a recording.

    A KITTI file takes its stamps from the other side, or counts frames at ``rate_hz`` when both are
    KITTI files.  The true poses are returned for the body that the estimate speaks of.  Raises
    DatasetError or EvaluationError for anything that holds no trajectory.
    """
    found = _find(estimate, estimate_topic, is_truth=False)
    true = find_ground_truth(truth, topic=truth_topic)
    if isinstance(found, UnstampedTrajectory) and isinstance(true, UnstampedTrajectory):
        return (
            found.for_frames(_regular_stamps(len(found.poses), rate_hz)),
            true.for_frames(_regular_stamps(len(true.poses), rate_hz)),
        )
    if isinstance(true, FoundTrajectory):
        found = found.for_frames(true.trajectory.stamps_ns)
    assert isinstance(found, FoundTrajectory)  # one of them brought stamps
    stamps_ns = found.frame_stamps_ns
    true = true.for_frames(found.trajectory.stamps_ns if stamps_ns is None else stamps_ns)
    if found.T_rig_rectified is not None:
        turned = true.trajectory.T_world_rig @ found.T_rig_rectified
        true = FoundTrajectory(Trajectory(true.trajectory.stamps_ns, turned), true.reason)
    return found, true


def _find(
    source: str | Path, topic: str | None, *, is_truth: bool
) -> FoundTrajectory | UnstampedTrajectory:
    path = Path(source)
    if str(source).startswith(SIMULATED):
        return _of_recording(source)
    if not path.exists():
        raise EvaluationError(f"there is no trajectory {path}: give a file, a bag or a folder")
    if path.suffix in BAG_SUFFIXES or (path / "metadata.yaml").is_file():
        return _of_bag(path, topic, is_truth=is_truth)
    if path.is_file():
        return _of_text(path)
    if is_run_folder(path):
        return _of_run(path)
    return _of_recording(path)


def _of_text(path: Path) -> FoundTrajectory | UnstampedTrajectory:
    kind = sniff_format(path)
    if kind is TrajectoryFormat.KITTI:
        return UnstampedTrajectory(read_kitti(path), "KITTI pose file")
    if kind is TrajectoryFormat.EUROC:
        return FoundTrajectory(read_euroc(path), "EuRoC ground truth file")
    return FoundTrajectory(read_tum(path), "TUM file")


def _of_run(path: Path) -> FoundTrajectory:
    record = json.loads((path / RUN_FILE).read_text(encoding="utf-8"))
    turn = record.get("T_rig_rectified")
    frames = path / "frames.csv"
    return FoundTrajectory(
        read_tum(path / "trajectory.tum"),
        f"run of {record.get('source', 'an unknown source')}",
        read_frame_stamps(frames) if frames.is_file() else None,
        None if turn is None else np.array(turn, dtype=np.float64),
    )


def _of_bag(path: Path, topic: str | None, *, is_truth: bool) -> FoundTrajectory:
    with open_bag_reader(path) as reader:
        topics = sorted(
            c.topic for c in reader.connections if c.msgtype in POSE_TYPES and c.msgcount > 0
        )
    chosen = _choose_topic(topics, topic, path, is_truth=is_truth)
    T_base_rig = None
    if (path / RIG_FILE).is_file():
        T_base_rig = load_calibration(path / RIG_FILE).T_base_rig
    if T_base_rig is None:
        T_base_rig = default_T_base_rig()
    return FoundTrajectory(read_bag_poses(path, chosen, T_base_rig), f"{chosen} of a bag")


def _choose_topic(topics: Sequence[str], wanted: str | None, path: Path, *, is_truth: bool) -> str:
    named = choose_truth_topic(topics, wanted)
    if named is not None and (is_truth or wanted is not None):
        return named
    others = [topic for topic in topics if topic != named]
    if not is_truth and ODOMETRY_TOPIC in others:
        return ODOMETRY_TOPIC
    if len(others) == 1:
        return others[0]
    option = "--ground-truth-topic" if is_truth else "--estimate-topic"
    raise DatasetError(
        f"the bag {path} leaves open which topic is meant (pose topics there: "
        f"{', '.join(topics) or 'none'}): name one with {option}"
    )


def _of_recording(source: str | Path) -> FoundTrajectory:
    dataset, reason = open_dataset(source)
    truth = dataset.ground_truth()
    if truth is None:
        raise DatasetError(f"the recording {source} ({reason}) brings no ground truth")
    return FoundTrajectory(truth, reason)


def _regular_stamps(n: int, rate_hz: float) -> NDArray[np.int64]:
    return np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64)
