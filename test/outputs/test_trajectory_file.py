from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus, TrackStats
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.outputs.trajectory_file import (
    TrajectoryFiles,
    format_stamp,
    kitti_trajectory,
    parse_stamp,
    read_euroc,
    read_frame_stamps,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)

EPOCH_NS = 1403636579763555527  # the last digits are lost in a float64 of seconds


def random_trajectory(rng: np.random.Generator, n: int = 20) -> Trajectory:
    stamps_ns = EPOCH_NS + np.cumsum(rng.integers(1, 10**8, n))
    poses = np.array([exp_se3(rng.normal(size=6) * (10, 10, 10, 1, 1, 1)) for _ in range(n)])
    return Trajectory(stamps_ns, poses)


@given(st.integers(-(2**62), 2**62))
def test_stamp_comes_back_to_the_nanosecond(stamp_ns):
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


def test_stamp_of_other_programs_is_read_exactly():
    assert parse_stamp("1.403636579763555527e+09") == EPOCH_NS
    assert parse_stamp("0.1") == 100_000_000
    assert parse_stamp("12") == 12_000_000_000


def test_tum_round_trip(tmp_path, rng):
    written = random_trajectory(rng)
    write_tum(tmp_path / "t.tum", written)
    read = read_tum(tmp_path / "t.tum")
    assert read.stamps_ns.dtype == np.int64
    assert read.stamps_ns.tolist() == written.stamps_ns.tolist()
    assert np.array_equal(read.positions_m, written.positions_m)
    np.testing.assert_allclose(read.T_world_rig, written.T_world_rig, rtol=0, atol=1e-14)


def test_tum_line_has_the_fields_in_their_order(tmp_path):
    quarter_turn_about_z = exp_se3([0, 0, 0, 0, 0, np.pi / 2])
    quarter_turn_about_z[:3, 3] = (1.0, 2.0, 3.0)
    write_tum(tmp_path / "t.tum", Trajectory(np.array([1_500_000_001]), quarter_turn_about_z[None]))
    line = (tmp_path / "t.tum").read_text().splitlines()[-1].split()
    assert line[0] == "1.500000001"
    np.testing.assert_allclose([float(x) for x in line[1:4]], [1, 2, 3])
    np.testing.assert_allclose(
        [float(x) for x in line[4:]], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.0 0 0 0 0 0 0\n", r"t\.tum, line 1: a TUM line has 8 numbers .* this one 7"),
        ("# c\nx 0 0 0 0 0 0 1\n", r"t\.tum, line 2: 'x' is not a stamp in seconds"),
        ("nan 0 0 0 0 0 0 1\n", r"line 1: 'nan' is not a stamp in seconds"),
        ("1.0 0 0 a 0 0 0 1\n", r"line 1: could not convert string to float: 'a'"),
        ("1.0 0 0 0 0 0 0 0\n", r"line 1: a quaternion of length zero"),
        ("2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", r"t\.tum: stamps must increase strictly"),
        ("1.0 nan 0 0 0 0 0 1\n", r"t\.tum: a trajectory must not hold NaN"),
        ("# nothing\n", r"t\.tum holds no pose"),
    ],
)
def test_bad_tum_is_refused_with_file_and_line(tmp_path, text, message):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(EvaluationError, match=message):
        read_tum(tmp_path / "t.tum")


def test_missing_and_binary_files_are_named(tmp_path):
    with pytest.raises(EvaluationError, match=r"there is no file .*gone\.tum"):
        read_tum(tmp_path / "gone.tum")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(EvaluationError, match=r"binary cannot be read as text"):
        read_tum(tmp_path / "binary")


def test_kitti_round_trip_keeps_lost_frames_in_their_place(tmp_path, rng):
    poses = list(random_trajectory(rng, 5).T_world_rig)
    poses[2] = None
    write_kitti(tmp_path / "k.txt", poses)
    lines = (tmp_path / "k.txt").read_text().splitlines()
    assert len(lines) == 5
    assert lines[2].split() == ["nan"] * 12
    read = read_kitti(tmp_path / "k.txt")
    assert read[2] is None
    for i in (0, 1, 3, 4):
        np.testing.assert_allclose(read[i], poses[i], rtol=0, atol=1e-14)
        np.testing.assert_array_equal(np.array(lines[i].split(), dtype=float), poses[i][:3].ravel())
    trajectory = kitti_trajectory(read, np.arange(5) * 10)
    assert trajectory.stamps_ns.tolist() == [0, 10, 30, 40]
    np.testing.assert_array_equal(trajectory.T_world_rig[2], read[3])


def test_kitti_refuses_what_is_no_motion(tmp_path):
    path = tmp_path / "k.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(EvaluationError, match=r"line 1: a KITTI pose has 12 numbers .* line 11"):
        read_kitti(path)
    path.write_text("1 0 0 0 0 1 0 0 0 0 -1 0\n")
    with pytest.raises(EvaluationError, match=r"k\.txt, line 1: the left 3x3 is not a rotation"):
        read_kitti(path)
    path.write_text("1 0 0 0 0 2 0 0 0 0 1 0\n")
    with pytest.raises(EvaluationError, match="not a rotation"):
        read_kitti(path)
    path.write_text("nan 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(EvaluationError, match="not a rotation"):
        read_kitti(path)
    with pytest.raises(EvaluationError, match="1 KITTI poses do not fit 2 frames"):
        kitti_trajectory([None], np.array([1, 2]))


def test_kitti_poses_of_a_recording_are_read_as_rotations(recording):
    poses = read_kitti(recording("kitti_residential") / "poses.txt")
    assert len(poses) == 51
    for T in poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    # The street is 60 m long and driven forwards, along z of the left camera.
    assert 55 < np.linalg.norm(poses[-1][:3, 3]) < 65
    assert poses[-1][2, 3] > 50


def test_euroc_ground_truth(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(
        "#timestamp, p_x [m], p_y, p_z, q_w [], q_x, q_y, q_z, v_x\n"
        f"{EPOCH_NS},1.0,2.0,3.0,{np.sqrt(0.5)},0.0,0.0,{np.sqrt(0.5)},9.0\n"
        f"{EPOCH_NS + 1},1.5,2.0,3.0,1.0,0.0,0.0,0.0,9.0\n"
    )
    read = read_euroc(path)
    assert read.stamps_ns.tolist() == [EPOCH_NS, EPOCH_NS + 1]
    np.testing.assert_array_equal(read.positions_m, [[1, 2, 3], [1.5, 2, 3]])
    np.testing.assert_allclose(
        read.T_world_rig[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12
    )
    path.write_text("1.5,1,2,3,1,0,0,0\n")
    with pytest.raises(EvaluationError, match=r"line 1: '1.5' is not a whole number"):
        read_euroc(path)
    path.write_text("1,2,3\n")
    with pytest.raises(EvaluationError, match=r"line 1: a EuRoC line begins with 8 numbers"):
        read_euroc(path)


def result(stamp_ns: int, T: np.ndarray | None, reason: str = "") -> OdometryResult:
    status = TrackingStatus.LOST if T is None else TrackingStatus.TRACKING
    stats = TrackStats(features=7, matches=5, inliers=3)
    return OdometryResult(stamp_ns, status, T, None, stats=stats, reason=reason)


def test_observer_writes_all_files_on_close_and_nothing_before(tmp_path, rng):
    poses = random_trajectory(rng, 4)
    files = TrajectoryFiles(tmp_path)
    for i in range(4):
        T = None if i == 1 else poses.T_world_rig[i]
        files.on_result(result(int(poses.stamps_ns[i]), T, 'too few points, "3"\nof 8'))
    assert list(tmp_path.iterdir()) == []
    files.close()
    names = {"trajectory.tum", "trajectory_kitti.txt", "frames.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names

    read = read_tum(tmp_path / "trajectory.tum")
    assert read.stamps_ns.tolist() == poses.stamps_ns[[0, 2, 3]].tolist()
    assert [T is None for T in read_kitti(tmp_path / "trajectory_kitti.txt")] == [
        False,
        True,
        False,
        False,
    ]
    stamps_ns = read_frame_stamps(tmp_path / "frames.csv")
    assert stamps_ns.tolist() == poses.stamps_ns.tolist() == files.frame_stamps_ns.tolist()
    lines = (tmp_path / "frames.csv").read_text().splitlines()
    assert len(lines) == 5
    assert lines[2].startswith(f'{poses.stamps_ns[1]},LOST,0,7,5,3,0.0000,,"too few points')
    assert files.status_counts[TrackingStatus.LOST] == 1
    assert files.status_counts[TrackingStatus.TRACKING] == 3
    assert len(files.trajectory) == 3


def test_observer_of_a_run_without_frames_leaves_empty_files(tmp_path):
    files = TrajectoryFiles(tmp_path)
    files.close()
    assert (tmp_path / "trajectory_kitti.txt").read_text() == ""
    assert len(files.trajectory) == 0
