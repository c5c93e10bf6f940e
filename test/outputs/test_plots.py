from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.evaluation.alignment import Alignment
from thermal_stereo_vo.evaluation.metrics import evaluate
from thermal_stereo_vo.outputs.plots import plot_run, run_figure, view_from_above

N = 300


@pytest.fixture
def truth() -> Trajectory:
    T = exp_se3([5, -3, 2, 0.0, 0.3, 0.0])
    poses = []
    for i in range(N):
        poses.append(T)
        T = T @ exp_se3([0, -0.02, 0.3, 0, 0.05 * np.sin(0.05 * i), 0])
    return Trajectory(np.arange(N) * 50_000_000, np.array(poses))


@pytest.fixture
def estimate(truth, rng) -> Trajectory:
    T = np.eye(4)
    poses = [T]
    for a, b in zip(truth.T_world_rig[:-1], truth.T_world_rig[1:], strict=True):
        T = T @ np.linalg.inv(a) @ b @ exp_se3(rng.normal(size=6) * 0.002)
        poses.append(T)
    return Trajectory(truth.stamps_ns, np.array(poses))


def axes_titled(figure, title):
    panels = [*figure.axes, *(axes for part in figure.subfigs for axes in part.axes)]
    return next(axes for axes in panels if axes.get_title() == title)


def test_way_is_drawn_from_above_in_the_world_of_the_truth(truth, estimate):
    figure = run_figure(estimate, truth)
    axes = axes_titled(figure, "from above")
    assert axes.get_aspect() == 1.0
    lines = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    # The rig's y points down in this world: x to the right, z ahead.
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    np.testing.assert_allclose(lines["ground truth"], truth.positions_m[:, [0, 2]])
    np.testing.assert_allclose(lines["start"], truth.positions_m[:1, [0, 2]])
    np.testing.assert_allclose(lines["end"], truth.positions_m[-1:, [0, 2]])
    np.testing.assert_allclose(lines["estimate"][0], lines["ground truth"][0], atol=1e-9)
    assert 0.01 < np.max(np.abs(lines["estimate"] - lines["ground truth"])) < 5.0


def test_height_grows_upwards(truth, estimate):
    axes = axes_titled(run_figure(estimate, truth), "height over the start")
    height = axes.get_lines()[0].get_ydata()
    np.testing.assert_allclose(height, -(truth.positions_m[:, 1] - truth.positions_m[0, 1]))
    assert height[-1] > 1.0
    np.testing.assert_allclose(axes.get_lines()[0].get_xdata(), truth.path_lengths_m)


def test_errors_drawn_are_the_ones_measured(truth, estimate):
    metrics = evaluate(estimate, truth)
    figure = run_figure(estimate, truth, metrics, "a title")
    curve = axes_titled(figure, "travelled error, from 20 m on").get_lines()[0].get_xydata()
    np.testing.assert_allclose(curve[:, 1], metrics.curve.error_percent)
    points = axes_titled(figure, "translation error over segments").get_lines()[-1].get_xydata()
    expected = [[error.length_m, error.translation_percent] for error in metrics.per_length]
    np.testing.assert_allclose(points, expected)
    points = axes_titled(figure, "rotation error over segments").get_lines()[-1].get_xydata()
    expected = [[error.length_m, error.rotation_deg_per_m] for error in metrics.per_length]
    np.testing.assert_allclose(points, expected)
    title = figure.get_suptitle()
    assert title.startswith("a title\n")
    assert f"average error {metrics.avg_translation_error_percent:.2f} %" in title


def test_estimate_is_drawn_in_the_alignment_of_the_metrics(truth, estimate):
    metrics = evaluate(estimate, truth, alignment=Alignment.SE3)
    axes = axes_titled(run_figure(estimate, truth, metrics), "from above")
    lines = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    offset = lines["estimate"] - lines["ground truth"]
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=1e-9)


def test_lost_stretch_is_a_hole_in_the_line(truth, estimate):
    kept = np.r_[0:100, 150:N]
    sparse = Trajectory(estimate.stamps_ns[kept], estimate.T_world_rig[kept])
    axes = axes_titled(run_figure(sparse, truth), "from above")
    line = next(line for line in axes.get_lines() if line.get_label() == "estimate")
    assert np.isnan(line.get_xdata()[100:150]).all()
    assert np.isfinite(line.get_xdata()[150:]).all()


def test_page_shows_the_world_unmirrored():
    for up in (*np.eye(3), *-np.eye(3)):
        right, ahead = view_from_above(up)
        np.testing.assert_allclose(np.cross(right, ahead), up)


def test_picture_is_written_whole(tmp_path, truth, estimate):
    plot_run(tmp_path / "run.png", estimate, truth, title="a flight")
    picture = cv2.imread(str(tmp_path / "run.png"))
    assert min(picture.shape[:2]) > 900
    blue = np.all(picture == (0xB2, 0x72, 0x00), axis=2)  # the estimate's colour in BGR
    assert 1000 < np.count_nonzero(blue) < 100_000
    assert [path.name for path in tmp_path.iterdir()] == ["run.png"]


def test_images_are_shown_above(truth, estimate):
    left = np.full((48, 64), 90, np.uint8)
    matches = np.zeros((48, 128, 3), np.uint8)
    matches[..., 0] = 255  # blue in BGR
    figure = run_figure(estimate, truth, left_image=left, matches_image=matches)
    shown = [axes.get_images()[0] for axes in figure.subfigs[0].axes]
    np.testing.assert_array_equal(shown[0].get_array(), left)
    assert shown[0].get_clim() == (0, 255)  # not stretched
    assert shown[1].get_array()[0, 0].tolist() == [0, 0, 255]  # RGB
    assert axes_titled(figure, "from above")


def test_run_without_truth_shows_the_way_alone(tmp_path, estimate):
    plot_run(tmp_path / "run.png", estimate, title="a flight")
    assert (tmp_path / "run.png").stat().st_size > 10_000
    figure = run_figure(estimate)
    lines = {
        line.get_label(): line.get_xydata()
        for line in axes_titled(figure, "from above").get_lines()
    }
    np.testing.assert_allclose(lines["estimate"], estimate.positions_m[:, [0, 2]])
    assert f"{N} poses, {estimate.path_lengths_m[-1]:.1f} m" in figure.get_suptitle()


def test_rig_that_stands_still_has_a_drift_panel_in_millimetres(rng):
    stamps_ns = np.arange(50) * 50_000_000
    still = Trajectory(stamps_ns, np.tile(np.eye(4), (50, 1, 1)))
    poses = still.T_world_rig.copy()
    poses[:, 0, 3] = np.linspace(0, 0.007, 50)
    figure = run_figure(Trajectory(stamps_ns, poses), still)
    drift = axes_titled(figure, "drift")
    assert drift.get_lines()[0].get_ydata()[-1] == pytest.approx(7.0)
    assert drift.get_ylabel() == "mm"
    assert "final error 7.0 mm" in figure.get_suptitle()


def test_run_that_never_tracked_still_has_a_picture(tmp_path):
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    plot_run(tmp_path / "run.png", nothing)
    assert (tmp_path / "run.png").exists()


def test_nothing_is_written_when_nothing_can_be_compared(tmp_path, truth, estimate):
    later = Trajectory(truth.stamps_ns + 10**12, truth.T_world_rig)
    with pytest.raises(EvaluationError, match="no stamp of the estimate"):
        plot_run(tmp_path / "run.png", estimate, later)
    assert list(tmp_path.iterdir()) == []


def test_global_state_of_pyplot_is_left_alone(tmp_path, estimate):
    before = "matplotlib.pyplot" in sys.modules
    plot_run(tmp_path / "run.png", estimate)
    assert ("matplotlib.pyplot" in sys.modules) == before
