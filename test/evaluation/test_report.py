from __future__ import annotations

import re

import numpy as np

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.metrics import evaluate
from thermal_stereo_vo.evaluation.report import (
    format_table,
    metrics_report,
    timing_report,
    trajectory_report,
)
from thermal_stereo_vo.evaluation.timing import FrameTimer


def line_of(text: str, name: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(name))


def test_every_figure_stands_with_its_unit(flight, odometry, rng):
    truth = flight(rng, n=1000)
    metrics = evaluate(odometry(truth, rng), truth)
    text = metrics_report(metrics)
    assert "100.0 %      of 1000 frames" in line_of(text, "coverage")
    average = line_of(text, "average error")
    assert f"{metrics.avg_translation_error_percent:.3f} %" in average
    segments = sum(error.segments for error in metrics.per_length)
    assert f"{segments} segments of 50 to 300 m" in average
    assert f"{metrics.ate_rmse_m:.4f} m" in line_of(text, "ATE rmse")
    assert f"{metrics.avg_rotation_error_deg_per_m:.5f} deg/m" in text
    for error in metrics.per_length:
        row = line_of(text, f"{error.length_m:g} m").split()
        assert row[2] == str(error.segments)
        assert row[3] == f"{error.translation_percent:.3f}"
    assert max(map(len, text.splitlines())) <= 90


def test_numbers_end_in_one_column(flight, odometry, rng):
    truth = flight(rng)
    figures = metrics_report(evaluate(odometry(truth, rng), truth)).split("\n\n")[0].splitlines()
    matches = [re.match(r"(\S+(?: \S+)*) {2,}([\d.]+)(?= |$)", line) for line in figures]
    assert len(figures) == 15
    assert len({match.end(2) for match in matches}) == 1


def test_missing_figures_are_dashes():
    still = Trajectory(np.arange(20) * 10**8, np.tile(np.eye(4), (20, 1, 1)))
    text = metrics_report(evaluate(still, still))
    assert line_of(text, "average error").split() == ["average", "error", "-", "%"]
    assert "the rig stood still" in text
    assert "nan" not in text
    assert "None" not in text


def test_a_run_without_truth_tells_how_far_it_went():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 3.0, 5.0, 1.0]
    text = trajectory_report(Trajectory(np.arange(4), poses), frames=5)
    assert line_of(text, "coverage").split()[1:] == ["80.0", "%", "of", "5", "frames"]
    assert line_of(text, "path length").split()[2] == "9.000"
    assert line_of(text, "end from start").split()[3] == "1.0000"
    assert line_of(text, "farthest from start").split()[3] == "5.0000"
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert trajectory_report(nothing, frames=0).split() == [
        "coverage",
        "-",
        "%",
        "of",
        "0",
        "frames",
    ]


def test_timing_lists_the_stages():
    timer = FrameTimer()
    timer.add(20.0, 30.0, {"detect": 5.25})
    text = timing_report(timer.summary())
    assert line_of(text, "frame, wall: median").split()[-1] == "20.00"
    assert line_of(text, "stage detect").split()[-1] == "5.25"
    assert line_of(timing_report(FrameTimer().summary()), "frame, CPU").split()[-1] == "-"


def test_table_columns_are_as_wide_as_their_widest_cell():
    lines = format_table(["a", "bb"], [["long name", "1"], ["x", "12345"]]).splitlines()
    assert lines == [
        "a             bb",
        "---------  -----",
        "long name      1",
        "x          12345",
    ]
