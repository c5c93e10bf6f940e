from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.association import associate, compare, expected_frames

stamps = st.lists(st.integers(0, 60), unique=True, max_size=15).map(
    lambda values: np.array(sorted(values), dtype=np.int64)
)


@given(stamps, stamps, st.integers(0, 20))
def test_pairs_are_mutually_nearest_one_to_one_and_in_order(a, b, tolerance):
    in_a, in_b = associate(a, b, tolerance)
    pairs = list(zip(in_a.tolist(), in_b.tolist(), strict=True))
    assert all(i < j and k < m for (i, k), (j, m) in pairwise(pairs))
    reference = []
    for i in range(len(a)):
        for k in range(len(b)):
            distance = abs(a[i] - b[k])
            nearest_b = min(range(len(b)), key=lambda m, i=i: (abs(a[i] - b[m]), m))
            nearest_a = min(range(len(a)), key=lambda m, k=k: (abs(a[m] - b[k]), m))
            if nearest_b == k and nearest_a == i and distance <= tolerance:
                reference.append((i, k))
    assert pairs == reference


def test_neighbouring_nanoseconds_are_told_apart_at_epoch_scale():
    epoch = 1_700_000_000_000_000_000  # a float64 resolves 256 ns here
    a = epoch + np.array([0, 3, 6], dtype=np.int64)
    in_a, in_b = associate(a, a[[0, 2]], tolerance_ns=2)
    assert in_a.tolist() == [0, 2]
    assert in_b.tolist() == [0, 1]


def test_frames_lost_at_every_place_are_expected():
    frames = 1_700_000_000_000_000_000 + np.arange(30) * 33_333_333
    kept = np.ones(30, bool)
    kept[[0, 1, 9, 10, 11, 20, 29]] = False
    found = expected_frames(frames[kept], frames)
    assert len(found) == 30
    assert np.max(np.abs(found - frames)) < 100


def trajectory(stamps_ns, x_m=None) -> Trajectory:
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    poses[:, 0, 3] = np.arange(len(stamps_ns)) if x_m is None else x_m
    return Trajectory(np.asarray(stamps_ns, dtype=np.int64), poses)


def test_lost_frames_count_against_the_coverage_and_for_the_way():
    stamps_ns = np.arange(10) * 100_000_000
    estimate = trajectory(stamps_ns[[1, 2, 3, 7, 8]])
    comparison = compare(estimate, trajectory(stamps_ns), frame_stamps_ns=stamps_ns)
    assert comparison.frames == 10
    assert comparison.poses == 5
    assert comparison.coverage_percent == 50.0
    assert comparison.has_pose.tolist() == [True, True, True, False, False, False, True, True]
    assert np.all(np.isnan(comparison.estimated_positions_m[3:6]))
    # Seven frames of truth from the first to the last pose, a metre each.
    assert comparison.distances_m.tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    # The list of frames is found from the steps of the estimate when nobody gives it.
    again = compare(estimate, trajectory(stamps_ns))
    assert again.coverage_percent == 50.0
    assert again.stamps_ns.tolist() == comparison.stamps_ns.tolist()


def test_jitter_of_a_denser_truth_does_not_lengthen_the_way(rng):
    dense_ns = np.arange(2001) * 5_000_000  # 200 Hz for 10 s
    x_m = dense_ns / 1e9 + rng.normal(0, 0.01, 2001)
    truth = trajectory(dense_ns, x_m)
    assert truth.path_lengths_m[-1] > 20
    frames_ns = dense_ns[::100] + 1_000_000
    comparison = compare(trajectory(frames_ns[:20]), truth)
    assert comparison.coverage_percent == pytest.approx(100 * 20 / 21)
    assert len(comparison) == 20
    assert 9.4 < comparison.distances_m[-1] < 9.7


def test_truth_that_is_rarer_than_frames_is_compared_where_it_is():
    frames_ns = np.arange(101) * 100_000_000
    truth = trajectory(frames_ns[::10], np.arange(11) * 10.0)
    comparison = compare(trajectory(frames_ns), truth)
    assert len(comparison) == 11
    assert comparison.coverage_percent == 100.0
    assert comparison.estimated_positions_m[:, 0].tolist() == list(range(0, 101, 10))


def test_what_cannot_be_compared_is_refused():
    a = trajectory([0, 10**9])
    with pytest.raises(
        EvaluationError,
        match=r"no stamp of the estimate \(2 poses, 0.000 to 1.000 s\) lies within 10 ms of one of "
        r"the ground truth \(2 poses, 7.000 to 8.000 s\): take both from the same recording",
    ):
        compare(a, trajectory([7 * 10**9, 8 * 10**9]))
    # A truth that runs on for days, or a single wild stamp, must not fill the memory.
    far = trajectory([0, 10**9, 10**18])
    with pytest.raises(
        EvaluationError,
        match=r"frames 100 ms apart cannot fill the 1000000000 s .* different clocks",
    ):
        compare(trajectory([0, 10**8, 2 * 10**8]), far)
    with pytest.raises(EvaluationError, match="a stamp is wrong"):
        compare(trajectory([0, 10**8, 2 * 10**8, 10**18]), far)
    with pytest.raises(EvaluationError, match="no stamp of the estimate"):
        compare(trajectory([0, 10**8]), trajectory([10**18, 10**18 + 10**8]))
    with pytest.raises(EvaluationError, match="the estimate holds no pose"):
        compare(trajectory([]), a)
    with pytest.raises(EvaluationError, match="the ground truth holds no pose"):
        compare(a, trajectory([]))


def test_truth_known_only_where_tracking_was_lost_cannot_be_compared():
    estimate = trajectory([0, 8_000_000, 40_000_000, 48_000_000])
    truth = trajectory([15_000_000])
    with pytest.raises(EvaluationError, match="no stamp of the estimate"):
        compare(estimate, truth, frame_stamps_ns=np.arange(7) * 8_000_000)


def test_inputs_are_left_alone():
    a, b = trajectory([0, 100, 300]), trajectory([0, 100, 200, 300])
    before = a.T_world_rig.copy()
    comparison = compare(a, b)
    comparison.T_world_est[:] = 7.0
    np.testing.assert_array_equal(a.T_world_rig, before)
