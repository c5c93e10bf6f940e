"""Trajectories refuse what no evaluation could use."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory


def poses(positions):
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, 3] = positions
    return T


def test_lengths_and_positions():
    trajectory = Trajectory(
        np.array([10, 20, 40]), poses([[0, 0, 0], [3.0, 4.0, 0], [3.0, 4.0, 2.0]])
    )
    assert len(trajectory) == 3
    np.testing.assert_allclose(trajectory.path_lengths_m, [0.0, 5.0, 7.0])
    np.testing.assert_allclose(trajectory.positions_m[1], [3.0, 4.0, 0.0])


def test_an_empty_trajectory_and_one_pose_are_allowed():
    assert len(Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))) == 0
    np.testing.assert_array_equal(Trajectory(np.array([5]), poses([[1, 1, 1]])).path_lengths_m, [0])


@pytest.mark.parametrize(
    ("stamps", "T"),
    [
        (np.array([1, 2]), poses([[0, 0, 0]])),
        (np.array([1]), np.zeros((1, 3, 4))),
        (np.array([[1, 2]]), poses([[0, 0, 0]])),
    ],
    ids=["count", "3x4", "stamps 2-D"],
)
def test_shapes_must_fit(stamps, T):
    with pytest.raises(EvaluationError, match=r"stamps cannot have poses of shape"):
        Trajectory(stamps, T)


@pytest.mark.parametrize("stamps", [[1, 5, 5], [1, 5, 4]], ids=["repeated", "backwards"])
def test_stamps_must_increase_and_the_message_names_the_pose(stamps):
    with pytest.raises(
        EvaluationError,
        match=rf"stamps must increase strictly, but pose 2 at {stamps[2]} ns does not come after "
        "5 ns",
    ):
        Trajectory(np.array(stamps), poses(np.zeros((3, 3))))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_must_be_finite(value):
    T = poses([[0, 0, 0], [value, 0, 0]])
    with pytest.raises(EvaluationError, match="must not hold NaN or infinite numbers"):
        Trajectory(np.array([1, 2]), T)


def results_of(letters):
    """A pose at x = i for each status that has one."""
    statuses = {status.value[0]: status for status in TrackingStatus}
    found = []
    for i, letter in enumerate(letters):
        T = None if letter == "L" else poses([[i, 0, 0]])[0]
        found.append(OdometryResult(10 * i, statuses[letter], T, None))
    return found


@pytest.mark.parametrize(
    ("letters", "kept"),
    [
        ("ITTGT", [0, 1, 2, 3, 4]),
        ("IIITT", [2, 3, 4]),  # the world starts with the last frame of the start
        ("ITLLTG", [0, 1, 4, 5]),
        ("IILL", [1]),
        ("IIII", [3]),
        ("TGT", [0, 1, 2]),
        ("", []),
    ],
)
def test_only_estimated_poses_make_a_trajectory(letters, kept):
    trajectory = estimated_trajectory(results_of(letters))
    np.testing.assert_array_equal(trajectory.stamps_ns, [10 * i for i in kept])
    np.testing.assert_array_equal(trajectory.positions_m[:, 0], kept)


def scaled_results(converged):
    pose = np.eye(4)
    return [
        OdometryResult(i, TrackingStatus.TRACKING, pose, np.eye(6), scale_converged=known)
        for i, known in enumerate(converged)
    ]


def test_only_metric_poses_count_once_the_scale_is_known():
    found = estimated_trajectory(scaled_results([False, False, True, True, False, True]))
    assert found.stamps_ns.tolist() == [2, 3, 5]


def test_a_run_that_never_finds_its_scale_keeps_its_poses():
    results = scaled_results([False, False, False])
    assert estimated_trajectory(results).stamps_ns.tolist() == [0, 1, 2]
    assert not any(result.is_metric for result in results)
    assert OdometryResult(0, TrackingStatus.TRACKING, np.eye(4), np.eye(6)).is_metric
