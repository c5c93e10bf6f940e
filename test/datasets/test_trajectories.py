from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import DatasetError, EvaluationError, ThermalStereoError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.datasets.trajectories import find_ground_truth, load_pair
from thermal_stereo_vo.evaluation.metrics import evaluate
from thermal_stereo_vo.outputs.bag_writer import BagWriter, ResultBag
from thermal_stereo_vo.outputs.ros_fields import odom_pose, pose_fields
from thermal_stereo_vo.outputs.run_folder import RunFolder, run_record
from thermal_stereo_vo.outputs.trajectory_file import TrajectoryFiles, write_kitti, write_tum

EPOCH_NS = 1_700_000_000_123_456_789
N = 40


@pytest.fixture
def flown(rng) -> Trajectory:
    T = np.eye(4)
    poses = []
    for i in range(N):
        poses.append(T)
        T = T @ exp_se3([0.01, 0.0, 0.5, 0.0, 0.03 * np.sin(0.2 * i), 0.002])
    return Trajectory(EPOCH_NS + np.arange(N) * 100_000_000, np.array(poses))


def results(trajectory: Trajectory, lost: set[int] = frozenset()):
    for i in range(len(trajectory)):
        T = None if i in lost else trajectory.T_world_rig[i]
        status = TrackingStatus.LOST if T is None else TrackingStatus.TRACKING
        yield OdometryResult(int(trajectory.stamps_ns[i]), status, T, None)


def write_bag(path, topics: dict[str, Trajectory], child: str = "base_link") -> None:
    A = default_T_base_rig()
    with BagWriter(path) as bag:
        for topic, trajectory in topics.items():
            for stamp_ns, T in zip(trajectory.stamps_ns, trajectory.T_world_rig, strict=True):
                pose = odom_pose(T, A) if child == "base_link" else T
                bag.write_odometry(topic, pose_fields(int(stamp_ns), pose, child_frame_id=child))


def write_euroc(path, trajectory: Trajectory) -> None:
    write_tum(path.with_suffix(".tum"), trajectory)
    rows = [
        line.split() for line in path.with_suffix(".tum").read_text().splitlines() if line[0] != "#"
    ]
    lines = ["#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x"]
    for stamp_ns, (_, x, y, z, qx, qy, qz, qw) in zip(trajectory.stamps_ns, rows, strict=True):
        lines.append(f"{stamp_ns},{x},{y},{z},{qw},{qx},{qy},{qz},0.0")
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def sources(tmp_path, flown):
    """The same trajectory in every form a file can have."""
    write_tum(tmp_path / "t.tum", flown)
    write_kitti(tmp_path / "k.txt", list(flown.T_world_rig))
    write_euroc(tmp_path / "e.csv", flown)
    write_bag(tmp_path / "base", {"/odom": flown})
    write_bag(tmp_path / "rig", {"/vio/pose": flown}, child="rig")
    return tmp_path


@pytest.mark.parametrize("estimate", ["t.tum", "k.txt", "e.csv", "base", "rig"])
@pytest.mark.parametrize("truth", ["t.tum", "k.txt", "e.csv", "base", "rig"])
def test_every_form_holds_the_same_trajectory(sources, flown, estimate, truth):
    found, true = load_pair(sources / estimate, sources / truth)
    for trajectory in (found.trajectory, true.trajectory):
        assert len(trajectory) == N
        np.testing.assert_allclose(trajectory.T_world_rig, flown.T_world_rig, atol=1e-12)
        if (estimate, truth) != ("k.txt", "k.txt"):
            assert trajectory.stamps_ns.tolist() == flown.stamps_ns.tolist()
    metrics = evaluate(found.trajectory, true.trajectory, frame_stamps_ns=found.frame_stamps_ns)
    assert metrics.coverage_percent == 100.0
    assert metrics.max_error_m < 1e-9


def test_two_kitti_files_get_stamps_at_the_rate(sources):
    found, true = load_pair(sources / "k.txt", sources / "k.txt", rate_hz=25.0)
    assert found.trajectory.stamps_ns.tolist() == [40_000_000 * i for i in range(N)]
    assert true.trajectory.stamps_ns.tolist() == found.trajectory.stamps_ns.tolist()


def test_lost_lines_of_a_kitti_estimate_count_against_its_coverage(sources, flown):
    poses = [None if 5 <= i < 15 or i == N - 1 else T for i, T in enumerate(flown.T_world_rig)]
    write_kitti(sources / "lost.txt", poses)
    found, true = load_pair(sources / "lost.txt", sources / "t.tum")
    assert len(found.trajectory) == N - 11
    metrics = evaluate(found.trajectory, true.trajectory, frame_stamps_ns=found.frame_stamps_ns)
    assert metrics.coverage_percent == pytest.approx(100 * (N - 11) / N)


def leave_run(directory, trajectory, lost=frozenset(), **more) -> None:
    import dataclasses

    @dataclasses.dataclass(frozen=True)
    class Settings:
        window: int = setting(0, "Frames.")

    with RunFolder(directory) as folder:
        files = TrajectoryFiles(folder.path)
        for result in results(trajectory, lost):
            files.on_result(result)
        files.close()
        record = run_record(
            settings=Settings(),
            calibration=None,
            source="street",
            source_reason="",
            command_line=[],
            **more,
        )
        folder.write_json("run.json", record)


def test_run_folder_knows_its_lost_frames(sources, flown):
    leave_run(sources / "run", flown, lost={0, 7, 8, N - 2, N - 1})
    found, true = load_pair(sources / "run", sources / "k.txt")
    assert found.reason == "run of street"
    assert found.frame_stamps_ns.tolist() == flown.stamps_ns.tolist()
    metrics = evaluate(found.trajectory, true.trajectory, frame_stamps_ns=found.frame_stamps_ns)
    assert metrics.coverage_percent == pytest.approx(100 * (N - 5) / N)
    assert metrics.max_error_m < 1e-9


def test_truth_is_turned_to_the_rectified_camera_that_the_run_speaks_of(sources, flown):
    turn = exp_se3([0, 0, 0, 0.02, -0.01, 0.03])
    rectified = Trajectory(flown.stamps_ns, flown.T_world_rig @ turn)
    leave_run(sources / "run", rectified, T_rig_rectified=turn)
    found, true = load_pair(sources / "run", sources / "t.tum")
    metrics = evaluate(found.trajectory, true.trajectory)
    assert metrics.max_error_m < 1e-9
    assert metrics.avg_translation_error_percent < 1e-9
    # Without the turn the same run looks wrong.
    wrong = evaluate(found.trajectory, flown)
    assert wrong.avg_translation_error_percent > 0.1


def test_result_bag_is_read_as_it_was_estimated(tmp_path, flown):
    bag = ResultBag(tmp_path / "result.mcap", default_T_base_rig())
    for result in results(flown, lost={3}):
        bag.on_result(result)
    bag.close()
    write_tum(tmp_path / "t.tum", flown)
    found, _ = load_pair(tmp_path / "result.mcap", tmp_path / "t.tum")
    assert len(found.trajectory) == N - 1
    kept = np.delete(np.arange(N), 3)
    np.testing.assert_allclose(found.trajectory.T_world_rig, flown.T_world_rig[kept], atol=1e-12)


def test_topics_of_a_bag_are_told_apart(tmp_path, flown):
    shifted = Trajectory(flown.stamps_ns, exp_se3([7, 0, 0, 0, 0, 0]) @ flown.T_world_rig)
    write_bag(tmp_path / "both", {"/odom": shifted, "/ground_truth/pose": flown})
    found, true = load_pair(tmp_path / "both", tmp_path / "both")
    assert found.trajectory.positions_m[0, 0] == pytest.approx(7.0)
    assert true.trajectory.positions_m[0, 0] == pytest.approx(0.0)
    swapped, _ = load_pair(
        tmp_path / "both", tmp_path / "both", estimate_topic="/ground_truth/pose"
    )
    assert swapped.trajectory.positions_m[0, 0] == pytest.approx(0.0)

    write_bag(tmp_path / "only_truth", {"/ground_truth/pose": flown})
    with pytest.raises(DatasetError, match="name one with --estimate-topic"):
        load_pair(tmp_path / "only_truth", tmp_path / "both")

    write_bag(tmp_path / "unnamed", {"/a": flown, "/b": flown})
    with pytest.raises(
        DatasetError, match=r"which topic is meant .*: /a, /b\): name one with --ground-truth-topic"
    ):
        find_ground_truth(tmp_path / "unnamed")
    with pytest.raises(DatasetError, match=r"/a, /b\): name one with --estimate-topic"):
        load_pair(tmp_path / "unnamed", tmp_path / "both")
    with pytest.raises(DatasetError, match=r"no pose topic '/c' \(pose topics there: /a, /b\)"):
        find_ground_truth(tmp_path / "unnamed", topic="/c")


def test_recording_brings_its_own_truth(recording):
    found = find_ground_truth(recording("kitti_residential"))
    assert len(found.for_frames(np.zeros(0, np.int64)).trajectory) == 51
    assert "KITTI odometry" in found.reason
    with pytest.raises(DatasetError, match="brings no ground truth"):
        find_ground_truth(recording("kitti_raw_0001"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("gone.tum", None, r"there is no trajectory .*gone\.tum"),
        ("notes.txt", "hello world\n", r"notes.txt, line 1, is no pose: .* this line has 2"),
        ("empty.txt", "# only words\n", r"empty.txt holds no pose"),
        ("short.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", r"1 KITTI poses do not fit 40 frames"),
        ("cut.mcap", "\x89MCAP", r"cut.mcap cannot be read .*damaged or was cut short"),
    ],
)
def test_what_holds_no_trajectory_is_refused(sources, name, content, message):
    if content is not None:
        (sources / name).write_text(content, encoding="latin-1")
    with pytest.raises(ThermalStereoError, match=message) as caught:
        load_pair(sources / "t.tum", sources / name)
    assert isinstance(caught.value, (EvaluationError, DatasetError))
    with pytest.raises(ThermalStereoError, match=message):
        load_pair(sources / name, sources / "t.tum")


def test_empty_folder_is_refused(tmp_path, sources):
    (tmp_path / "nothing").mkdir()
    with pytest.raises(DatasetError, match=r"nothing is empty"):
        load_pair(tmp_path / "nothing", sources / "t.tum")
