from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.evaluation.alignment import Alignment
from thermal_stereo_vo.evaluation.association import compare
from thermal_stereo_vo.evaluation.metrics import ate_rmse, error_curve, evaluate, measure
from thermal_stereo_vo.evaluation.relative import (
    relative_pose_rmse,
    rotation_angles_rad,
    segment_errors,
    segment_lengths,
    start_stride,
)
from thermal_stereo_vo.outputs.run_folder import to_json
from thermal_stereo_vo.outputs.trajectory_file import kitti_trajectory, read_kitti

CONTRACT_KEYS = {
    "frames",
    "coverage_percent",
    "path_length_m",
    "avg_translation_error_percent",
    "avg_rotation_error_deg_per_m",
    "final_error_m",
    "final_error_percent",
    "ate_rmse_m",
    "segment_lengths_m",
}


def devkit(truth, estimate, lengths, step):
    """The KITTI benchmark's definition with loops, inverses and the arc cosine of the trace."""
    items = []
    dist = [0.0]
    for i in range(1, len(truth)):
        dist.append(dist[-1] + math.dist(truth[i - 1][:3, 3], truth[i][:3, 3]))
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i in range(first, len(truth)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            angle = math.acos(max(min(0.5 * (np.trace(error[:3, :3]) - 1.0), 1.0), -1.0))
            items.append(
                (first, last, length, np.linalg.norm(error[:3, 3]) / length, angle / length)
            )
    return items


def test_average_error_is_that_of_the_kitti_devkit(flight, odometry, rng):
    truth = flight(rng, n=1200, step_m=1.0)
    estimate = odometry(truth, rng, scale=1.01)
    metrics = evaluate(estimate, truth)
    assert metrics.segment_lengths_m == (100, 200, 300, 400, 500, 600, 700, 800)
    # 20 Hz: a start each second is every 20th frame.
    items = devkit(truth.T_world_rig, estimate.T_world_rig, metrics.segment_lengths_m, 20)
    translation, rotation = np.array([item[3:] for item in items]).mean(axis=0)
    assert metrics.avg_translation_error_percent == pytest.approx(100 * translation, rel=1e-9)
    # The arc cosine of the reference is good to 1e-8 rad only.
    assert metrics.avg_rotation_error_deg_per_m == pytest.approx(math.degrees(rotation), rel=1e-5)
    for error in metrics.per_length:
        of_length = [item for item in items if item[2] == error.length_m]
        assert error.segments == len(of_length) > 0
        assert error.translation_percent == pytest.approx(
            100 * np.mean([item[3] for item in of_length]), rel=1e-9
        )


def test_segments_of_a_recorded_drive_are_those_of_the_devkit(recording, odometry, rng):
    poses = read_kitti(recording("kitti_residential") / "poses.txt")
    truth = kitti_trajectory(poses, np.arange(len(poses)) * 100_000_000)
    estimate = odometry(truth, rng)
    metrics = evaluate(estimate, truth)
    assert metrics.segment_lengths_m == (5, 10, 15, 20, 25, 30, 35, 40, 45)
    assert all(error.segments >= 5 for error in metrics.per_length)
    comparison = compare(estimate, truth)
    segments = segment_errors(comparison, metrics.segment_lengths_m, start_stride(comparison))
    items = devkit(truth.T_world_rig, estimate.T_world_rig, metrics.segment_lengths_m, 2)
    found = sorted(zip(segments.first, segments.length_m, segments.last, strict=True))
    assert found == sorted((first, length, last) for first, last, length, _, _ in items)
    np.testing.assert_allclose(
        metrics.avg_translation_error_percent, 100 * np.mean([item[3] for item in items]), rtol=1e-9
    )


def test_a_segment_ends_at_the_first_frame_beyond_its_length():
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 2, 3] = np.arange(40)  # exactly a metre each: a length is reached, then exceeded
    truth = Trajectory(np.arange(40) * 100_000_000, poses)
    segments = segment_errors(compare(truth, truth), (5.0, 20.0), stride=10)
    assert segments.first.tolist() == [0, 10, 20, 30, 0, 10]
    assert segments.last.tolist() == [6, 16, 26, 36, 21, 31]
    items = devkit(poses, poses, (5.0, 20.0), 10)
    assert sorted(item[:3] for item in items) == sorted(
        zip(segments.first, segments.last, segments.length_m, strict=True)
    )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_relative_errors_do_not_depend_on_either_world(seed):
    rng = np.random.default_rng(seed)
    from_identity = np.array([exp_se3([0, 0, 0.3 * i, 0, 0.02 * i, 0]) for i in range(80)])
    noisy = from_identity @ np.array([exp_se3(rng.normal(size=6) * 0.02) for _ in range(80)])
    stamps_ns = np.arange(80) * 50_000_000
    world_a, world_b = (exp_se3(rng.normal(size=6) * (99, 99, 99, 2, 2, 2)) for _ in range(2))
    here = evaluate(Trajectory(stamps_ns, noisy), Trajectory(stamps_ns, from_identity))
    there = evaluate(
        Trajectory(stamps_ns, world_a @ noisy), Trajectory(stamps_ns, world_b @ from_identity)
    )
    for name, value in here.as_dict().items():
        if isinstance(value, float) and not name.endswith("deg"):
            assert there.as_dict()[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name


@pytest.mark.parametrize("scale", [0.97, 1.0 + 1e-4, 1.05])
def test_scale_error_put_in_is_found_again(scale, flight, odometry, rng):
    truth = flight(rng, n=3000, step_m=0.4)
    metrics = evaluate(odometry(truth, rng, scale=scale, noise=0.0), truth)
    wrong = 100 * abs(scale - 1)
    # Relative motion over a winding segment: the chord is shorter than the way.
    assert 0.5 * wrong < metrics.avg_translation_error_percent < 1.01 * wrong
    assert metrics.scale == pytest.approx(1 / scale, rel=1e-9)
    assert metrics.avg_rotation_error_deg_per_m < 1e-9
    assert metrics.ate_sim3_rmse_m < 1e-6 < metrics.ate_rmse_m
    straight = truth.T_world_rig.copy()
    straight[:, :3, :3] = np.eye(3)
    straight[:, :3, 3] = np.outer(np.arange(3000) * 0.4, (0, 0.6, 0.8))
    truth = Trajectory(truth.stamps_ns, straight)
    metrics = evaluate(odometry(truth, rng, scale=scale, noise=0.0), truth)
    assert metrics.avg_translation_error_percent == pytest.approx(wrong, rel=5e-3)
    assert metrics.final_error_percent == pytest.approx(wrong, rel=1e-6)
    assert metrics.avg_position_error_percent == pytest.approx(wrong, rel=1e-6)
    np.testing.assert_allclose(metrics.curve.error_percent, wrong, rtol=1e-6)


def test_position_noise_put_in_is_found_again(flight, rng):
    truth = flight(rng, n=2000)
    noisy = truth.T_world_rig.copy()
    noisy[:, :3, 3] += rng.normal(0, 0.1, (2000, 3))
    metrics = evaluate(Trajectory(truth.stamps_ns, noisy), truth)
    expected = 0.1 * math.sqrt(3)
    assert 0.96 * expected < metrics.ate_rmse_m < 1.04 * expected
    # Successive frames have independent errors: the difference has twice the variance.
    assert 0.96 * expected < metrics.rpe_translation_rmse_m / math.sqrt(2) < 1.04 * expected
    assert metrics.scale == pytest.approx(1.0, abs=1e-3)
    assert metrics.scale != 1.0


def test_rotation_noise_put_in_is_found_again(flight, rng):
    truth = flight(rng, n=2000)
    twisted = truth.T_world_rig @ np.array(
        [exp_se3([0, 0, 0, *rng.normal(0, 0.01, 3)]) for _ in range(2000)]
    )
    metrics = evaluate(Trajectory(truth.stamps_ns, twisted), truth)
    expected_deg = math.degrees(0.01 * math.sqrt(3) * math.sqrt(2))
    assert 0.96 * expected_deg < metrics.rpe_rotation_rmse_deg < 1.04 * expected_deg


def test_ate_and_rpe_agree_with_evo(flight, odometry, rng):
    pytest.importorskip("evo")
    from evo.core import metrics as evo_metrics
    from evo.core.trajectory import PoseTrajectory3D

    truth = flight(rng)
    estimate = odometry(truth, rng, scale=1.02, noise=3.0)

    def as_evo(trajectory):
        stamps_s = (trajectory.stamps_ns - truth.stamps_ns[0]) / 1e9
        return PoseTrajectory3D(poses_se3=list(trajectory.T_world_rig), timestamps=stamps_s)

    def evo_rmse(metric, reference, other):
        metric.process_data((reference, other))
        return metric.get_statistic(evo_metrics.StatisticsType.rmse)

    relation = evo_metrics.PoseRelation
    metrics = evaluate(estimate, truth)

    other = as_evo(estimate)
    other.align(as_evo(truth))
    rmse = evo_rmse(evo_metrics.APE(relation.translation_part), as_evo(truth), other)
    assert metrics.ate_rmse_m == pytest.approx(rmse, rel=1e-9)

    other = as_evo(estimate)
    _, _, scale = other.align(as_evo(truth), correct_scale=True)
    rmse = evo_rmse(evo_metrics.APE(relation.translation_part), as_evo(truth), other)
    assert metrics.ate_sim3_rmse_m == pytest.approx(rmse, rel=1e-9)
    assert metrics.scale == pytest.approx(scale, rel=1e-9)

    other = as_evo(estimate)
    other.align_origin(as_evo(truth))
    rmse = evo_rmse(evo_metrics.APE(relation.translation_part), as_evo(truth), other)
    assert metrics.ate_origin_rmse_m == pytest.approx(rmse, rel=1e-9)

    comparison = compare(estimate, truth)
    for delta in (1, 20):
        translation_m, rotation_deg = relative_pose_rmse(comparison, delta)
        frames = {"delta": delta, "delta_unit": evo_metrics.Unit.frames, "all_pairs": True}
        rpe = evo_metrics.RPE(relation.translation_part, **frames)
        assert translation_m == pytest.approx(
            evo_rmse(rpe, as_evo(truth), as_evo(estimate)), rel=1e-9
        )
        rpe = evo_metrics.RPE(relation.rotation_angle_deg, **frames)
        assert rotation_deg == pytest.approx(
            evo_rmse(rpe, as_evo(truth), as_evo(estimate)), rel=1e-6
        )


def test_drift_over_distance_agrees_with_evo(flight, odometry, rng):
    """Evo's pairs a fixed way apart on the truth: other ends than KITTI's, nearly the same mean."""
    pytest.importorskip("evo")
    from evo.core import metrics as evo_metrics
    from evo.core.trajectory import PosePath3D

    truth = flight(rng, n=1500)
    estimate = odometry(truth, rng, scale=1.02)
    rpe = evo_metrics.RPE(
        evo_metrics.PoseRelation.translation_part,
        delta=100.0,
        delta_unit=evo_metrics.Unit.meters,
        rel_delta_tol=0.01,
        all_pairs=True,
        pairs_from_reference=True,
    )
    rpe.process_data(
        (
            PosePath3D(poses_se3=list(truth.T_world_rig)),
            PosePath3D(poses_se3=list(estimate.T_world_rig)),
        )
    )
    segments = segment_errors(compare(estimate, truth), (100.0,), stride=1)
    mean_evo = rpe.get_statistic(evo_metrics.StatisticsType.mean)
    assert np.mean(segments.translation_percent) == pytest.approx(mean_evo, rel=0.01)


def test_travelled_error_divides_by_the_way_so_far():
    distances_m = np.array([0.0, 10.0, 20.0, 50.0, 100.0])
    errors_m = np.array([0.0, 1.0, 1.0, np.nan, 3.0])
    curve = error_curve(distances_m, errors_m)
    assert curve.start_m == 20.0
    assert curve.distance_m.tolist() == [20.0, 100.0]
    assert curve.error_percent.tolist() == [5.0, 3.0]
    short = error_curve(distances_m[:2] * 3, errors_m[:2])
    assert short.start_m == 10.0
    assert short.error_percent.tolist() == [pytest.approx(100 / 30)]


def test_final_error_is_the_end_of_the_curve(flight, odometry, rng):
    truth = flight(rng)
    metrics = evaluate(odometry(truth, rng, noise=3.0), truth)
    assert metrics.final_error_percent == pytest.approx(metrics.curve.error_percent[-1])
    assert metrics.final_error_m == pytest.approx(
        metrics.final_error_percent / 100 * metrics.path_length_m
    )
    assert metrics.max_error_m >= metrics.final_error_m > 0


def test_small_angles_survive():
    angles = np.array([0.0, 1e-12, 1e-9, 1e-4, 1.0, 3.0, np.pi])
    motions = np.array([exp_se3([0, 0, 0, *(angle * np.array([0.6, 0, 0.8]))]) for angle in angles])
    np.testing.assert_allclose(rotation_angles_rad(motions), angles, rtol=1e-6)


@given(st.floats(0.01, 5000.0))
def test_lengths_are_round_and_fit_the_path(path_m):
    lengths = segment_lengths(path_m)
    assert 4 <= len(lengths) <= 10
    assert lengths[-1] <= min(0.8 * path_m, 800.0) * (1 + 1e-9)
    assert lengths[-1] > 0.5 * min(0.8 * path_m, 800.0)
    np.testing.assert_allclose(np.diff(lengths), lengths[0], rtol=1e-5)


def test_lengths_of_known_paths():
    assert segment_lengths(0.0) == ()
    assert segment_lengths(1000.0) == (100, 200, 300, 400, 500, 600, 700, 800)
    assert segment_lengths(900.0) == (100, 200, 300, 400, 500, 600, 700)
    assert segment_lengths(2.0) == (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6)
    # Twelve metres a frame: a segment of 5 m would be 12 m long in truth.
    assert segment_lengths(60.0, frame_step_m=12.0) == (40.0, 45.0)


def test_starts_are_a_second_apart_and_closer_in_short_recordings(flight, rng):
    for n, rate_hz, stride in (
        (2000, 30.0, 30),
        (1000, 10.0, 10),
        (100, 10.0, 4),
        (51, 10.0, 2),
        (5, 10.0, 1),
    ):
        truth = flight(rng, n=n, rate_hz=rate_hz)
        assert start_stride(compare(truth, truth)) == stride


def still(n: int, rng: np.random.Generator, noise_m: float) -> Trajectory:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = rng.normal(0, noise_m, (n, 3))
    return Trajectory(np.arange(n) * 50_000_000, poses)


@pytest.mark.parametrize("jitter_m", [0.0, 0.005])
def test_a_rig_that_stands_still_has_drift_but_no_percentages(jitter_m, rng):
    truth = still(400, rng, jitter_m)
    estimate = still(400, rng, 0.0)
    estimate.T_world_rig[:, 0, 3] = np.linspace(0, 0.02, 400)
    with np.errstate(all="raise"):
        metrics = evaluate(estimate, truth)
    assert metrics.avg_translation_error_percent is None
    assert metrics.avg_rotation_error_deg_per_m is None
    assert metrics.final_error_percent is None
    assert metrics.scale is None
    assert metrics.segment_lengths_m == ()
    assert metrics.final_error_m == pytest.approx(0.02, abs=6 * jitter_m + 1e-12)
    assert metrics.max_error_m == pytest.approx(0.02, abs=6 * jitter_m + 1e-12)
    assert len(metrics.curve.distance_m) == 0
    assert json.loads(to_json(metrics.as_dict()))["final_error_percent"] is None


def test_a_single_pose_is_measured_without_a_fall():
    one = Trajectory(np.array([5]), np.eye(4)[None])
    metrics = evaluate(one, one)
    assert metrics.frames == 1
    assert metrics.coverage_percent == 100.0
    assert metrics.final_error_m == 0.0
    assert metrics.rpe_translation_rmse_m is None


def test_a_lost_stretch_leaves_the_segments_around_it_whole(flight, odometry, rng):
    truth = flight(rng, n=1000)
    estimate = odometry(truth, rng)
    kept = np.r_[0:400, 430:1000]
    sparse = Trajectory(estimate.stamps_ns[kept], estimate.T_world_rig[kept])
    whole = evaluate(estimate, truth)
    for frame_stamps_ns in (truth.stamps_ns, None):
        metrics = evaluate(sparse, truth, frame_stamps_ns=frame_stamps_ns)
        assert metrics.coverage_percent == pytest.approx(97.0)
        assert metrics.frames == 1000
        assert metrics.frames_compared == 970
        assert metrics.path_length_m == pytest.approx(whole.path_length_m)
        assert metrics.segment_lengths_m == whole.segment_lengths_m
    comparison = compare(sparse, truth)
    with_gap = segment_errors(comparison, whole.segment_lengths_m, 20)
    without = segment_errors(compare(estimate, truth), whole.segment_lengths_m, 20)
    lost = set(range(400, 430))
    expected = [
        (first, last, error)
        for first, last, error in zip(
            without.first, without.last, without.translation_percent, strict=True
        )
        if not lost & {int(first), int(last)}
    ]
    assert 0 < len(expected) < len(without.first)
    assert with_gap.first.tolist() == [first for first, _, _ in expected]
    assert with_gap.last.tolist() == [last for _, last, _ in expected]
    np.testing.assert_allclose(with_gap.translation_percent, [error for _, _, error in expected])
    # Some of them lead across the stretch.
    assert any(first < 400 and last > 430 for first, last, _ in expected)


def test_a_jump_at_a_recovery_shows(flight, odometry, rng):
    truth = flight(rng, n=1000)
    estimate = odometry(truth, rng)
    poses = estimate.T_world_rig.copy()
    poses[500:] = exp_se3([10, 0, 0, 0, 0, 0]) @ poses[500:]
    jumped = evaluate(Trajectory(truth.stamps_ns, poses), truth)
    assert jumped.avg_translation_error_percent > 3 * (
        evaluate(estimate, truth).avg_translation_error_percent
    )


def test_scaled_alignment_scales_every_figure(flight, odometry, rng):
    truth = flight(rng)
    estimate = odometry(truth, rng, scale=0.5)
    metric = evaluate(estimate, truth)
    scaled = evaluate(estimate, truth, alignment=Alignment.SIM3)
    assert metric.avg_translation_error_percent > 20
    assert scaled.avg_translation_error_percent < 3
    assert scaled.alignment is Alignment.SIM3
    fitted = evaluate(estimate, truth, alignment=Alignment.SE3)
    assert fitted.avg_translation_error_percent == metric.avg_translation_error_percent
    assert fitted.max_error_m < metric.max_error_m
    assert fitted.ate_rmse_m == metric.ate_rmse_m


def test_measuring_twice_gives_the_same_and_changes_nothing(flight, odometry, rng):
    truth = flight(rng)
    comparison = compare(odometry(truth, rng), truth)
    before = comparison.T_world_est.copy()
    first = measure(comparison, Alignment.SIM3).as_dict()
    assert measure(comparison, Alignment.SIM3).as_dict() == first
    np.testing.assert_array_equal(comparison.T_world_est, before)
    assert ate_rmse(comparison, Alignment.SE3) == ate_rmse(comparison, Alignment.SE3)


def test_json_holds_the_agreed_keys(flight, odometry, rng):
    truth = flight(rng, n=1000)
    content = json.loads(to_json(evaluate(odometry(truth, rng), truth).as_dict()))
    assert set(content) >= CONTRACT_KEYS
    assert all(
        isinstance(content[key], (int, float)) for key in CONTRACT_KEYS - {"segment_lengths_m"}
    )
    assert content["segment_lengths_m"] == [50, 100, 150, 200, 250, 300]
    assert content["frames"] == 1000
    assert 150 <= len(content["error_curve"]["distance_m"]) <= 200
