"""What is written while the unit of length is arbitrary, and after."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import make_transform
from thermal_stereo_vo.datasets.rosbag import open_bag_reader, read_messages
from thermal_stereo_vo.outputs.bag_writer import ResultBag
from thermal_stereo_vo.outputs.trajectory_file import TrajectoryFiles, read_tum

CONVERGED = [False, False, True, True]


def results():
    for i, known in enumerate(CONVERGED):
        pose = make_transform(np.eye(3), [float(i), 0.0, 0.0])
        yield OdometryResult(
            i + 1, TrackingStatus.TRACKING, pose, np.eye(6), scale_converged=known,
            twist=np.zeros(6), twist_covariance=np.eye(6),
        )  # fmt: skip


def test_the_bag_has_no_odom_and_no_points_before_metres(tmp_path):
    bag = ResultBag(tmp_path / "result.mcap", default_T_base_rig())
    cloud = PointCloud(np.ones((2, 3), np.float32), np.ones(2, np.float32))
    for result in results():
        bag.on_result(result)
        bag.on_points(result.stamp_ns, cloud)
    bag.close()
    with open_bag_reader(tmp_path / "result.mcap") as reader:
        stamps = {
            topic: [ns for _, ns, _ in read_messages(reader, [topic], tmp_path)]
            for topic in ("/odom", "/points", "/status")
        }
    assert stamps == {"/odom": [3, 4], "/points": [3, 4], "/status": [1, 2, 3, 4]}


def test_trajectory_files_hold_metric_poses_only(tmp_path):
    files = TrajectoryFiles(tmp_path)
    for result in results():
        files.on_result(result)
    files.close()
    assert read_tum(tmp_path / "trajectory.tum").stamps_ns.tolist() == [3, 4]
    rows = np.loadtxt(tmp_path / "trajectory_kitti.txt")
    assert np.isnan(rows[:2]).all()
    assert rows[2:, 3].tolist() == [2.0, 3.0]
    column = [line.split(",")[7] for line in (tmp_path / "frames.csv").read_text().splitlines()]
    assert column == ["scale_converged", "false", "false", "true", "true"]
