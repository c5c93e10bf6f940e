"""Cells, their sums, and the report."""

from __future__ import annotations

import csv
import dataclasses
import io
import json

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_so3, inverse
from thermal_stereo_vo.evaluation.flight_cell import (
    METHODS,
    Cell,
    load_cells,
    make_cell,
    pose_nees,
    save_cell,
)
from thermal_stereo_vo.evaluation.metrics import evaluate
from thermal_stereo_vo.evaluation.table5 import PAPER, Table5, spread, to_csv, to_markdown
from thermal_stereo_vo.outputs.flight_figures import COLOURS, plot_flight

SEQUENCES = tuple(f"seq{i}" for i in range(1, 10))


def as_results(estimate, covariance=None, status=TrackingStatus.TRACKING):
    return [
        OdometryResult(int(stamp), status if i else TrackingStatus.INITIALISING, T, covariance)
        for i, (stamp, T) in enumerate(zip(estimate.stamps_ns, estimate.T_world_rig, strict=True))
    ]


def a_cell(flight="seq1", method="GN", seed=0, **figures):
    plain = {
        "frames": 100, "coverage_percent": 100.0, "path_length_m": 50.0, "average_percent": 2.0,
        "final_percent": 1.0, "final_m": 0.5, "ate_m": 0.2, "nees_mean": 6.0, "nees_final": 6.0,
        "statuses": {"TRACKING": 100}, "curve_distance_m": [20.0, 50.0],
        "positions_m": [[0.0, 0.0, 0.0], [0.5, 0.0, 50.0]], "curve_percent": [1.0, 2.0],
        "true_positions_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]],
    }  # fmt: skip
    return Cell(flight, method, seed, **{**plain, **figures})


# ------------------------------------------------------------------------------------------- cells


def test_a_cell_holds_what_evaluate_says(flight, odometry, rng):
    truth = flight(rng)
    estimate = odometry(truth, rng, scale=1.02)
    cell = make_cell("seq1", "GN", 3, as_results(estimate), truth)
    metrics = evaluate(estimate, truth)
    assert cell.average_percent == metrics.avg_translation_error_percent
    assert cell.final_percent == metrics.final_error_percent
    assert 1.0 < cell.average_percent < 4.0
    assert (cell.frames, cell.coverage_percent) == (400, 100.0)
    assert cell.statuses["TRACKING"] == 399
    assert cell.statuses["INITIALISING"] == 1
    assert cell.nees_mean is None
    np.testing.assert_allclose(cell.true_positions_m[0], 0.0, atol=1e-4)
    np.testing.assert_allclose(cell.positions_m[0], 0.0, atol=1e-4)
    # The last point is kept, and lies as far from the truth as the final error says.
    apart = np.subtract(cell.positions_m[-1], cell.true_positions_m[-1])
    assert np.linalg.norm(apart) == pytest.approx(cell.final_m, abs=1e-3)
    # Pictures show the way in the axes of the first frame: ahead is z.
    assert cell.true_positions_m[1][2] > 0.0


def test_a_flight_without_a_pose_is_no_cell(flight, rng):
    lost = [OdometryResult(i, TrackingStatus.LOST, None, None) for i in range(5)]
    with pytest.raises(EvaluationError, match="seq2 by LM, seed 1: no frame got a pose"):
        make_cell("seq2", "LM", 1, lost, flight(rng))


def test_nees_of_errors_as_large_as_the_covariance_says(flight, rng):
    """Errors drawn from the covariance itself: six on average; half the sigmas, four times that."""
    truth = flight(rng)
    A = rng.normal(size=(6, 6)) * 0.01
    covariance = A @ A.T + 1e-6 * np.eye(6)
    poses = inverse(truth.T_world_rig[0]) @ truth.T_world_rig
    for T, error in zip(
        poses[1:], rng.multivariate_normal(np.zeros(6), covariance, len(poses) - 1), strict=True
    ):
        T[:3, 3] -= error[:3]
        T[:3, :3] = exp_so3(-error[3:]) @ T[:3, :3]
    results = as_results(Trajectory(truth.stamps_ns, poses), covariance)
    results[0] = dataclasses.replace(results[0], covariance=np.zeros((6, 6)))
    values = pose_nees(results, truth)
    assert np.isnan(values[0])
    assert 5.0 < np.mean(values[1:]) < 7.0
    cell = make_cell("seq1", "GN", 0, results, truth)
    assert cell.nees_mean == pytest.approx(np.mean(values[1:]))
    assert cell.nees_final == pytest.approx(values[-1])
    halved = [dataclasses.replace(r, covariance=r.covariance / 4) for r in results]
    np.testing.assert_allclose(pose_nees(halved, truth)[1:], 4 * values[1:], rtol=1e-6)


def test_worlds_are_made_equal_where_the_estimate_starts(flight, rng):
    """While INITIALISING the pose stays the start's, however the rig moves."""
    truth = flight(rng, n=50)
    start = 7
    poses = inverse(truth.T_world_rig[start]) @ truth.T_world_rig
    poses[:start] = np.eye(4)
    results = as_results(Trajectory(truth.stamps_ns, poses), np.eye(6))
    for i in range(start + 1):
        results[i] = dataclasses.replace(results[i], status=TrackingStatus.INITIALISING)
    values = pose_nees(results, truth)
    assert len(values) == 50 - start
    np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_cells_come_back_from_disk_in_order(tmp_path):
    cells = [a_cell(seed=1), a_cell(method="windowed"), a_cell(nees_mean=None), a_cell("seq0")]
    for cell in cells:
        save_cell(tmp_path, cell)
    found = load_cells(tmp_path)
    assert [cell.name for cell in found] == [
        "seq0_GN_0", "seq1_GN_0", "seq1_GN_1", "seq1_windowed_0",
    ]  # fmt: skip
    assert found[1] == cells[2]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f"{c.name}.json" for c in found)


@pytest.mark.parametrize("text", ["{", "[]", '{"flight": "seq1"}', '{"more": 1}'])
def test_a_file_that_is_no_cell_is_named(tmp_path, text):
    (tmp_path / "seq1_GN_0.json").write_text(text)
    with pytest.raises(EvaluationError, match=r"seq1_GN_0\.json is no cell of a sweep: remove it"):
        load_cells(tmp_path)


# --------------------------------------------------------------------------------------------- sums


def test_mean_and_spread_over_seeds():
    assert spread([]) is None
    assert spread([None, None]) is None
    assert str(spread([1.5])) == "1.50"
    found = spread([1.0, 2.0, None, 6.0])
    assert (found.mean, found.count) == (3.0, 3)
    assert found.deviation == pytest.approx(np.std([1, 2, 6], ddof=1))


def test_rows_and_their_mean():
    cells = [
        a_cell("seq1", "DDL", 0, average_percent=1.0, final_percent=3.0),
        a_cell("seq1", "DDL", 1, average_percent=3.0, final_percent=5.0),
        a_cell("seq1", "windowed", 0, average_percent=0.5, final_percent=None),
        a_cell("seq2", "DDL", 0, average_percent=4.0, final_percent=0.5, path_length_m=70.0),
        a_cell("seq2", "windowed", 0, average_percent=0.1, final_percent=0.2),
    ]
    table = Table5(cells)
    assert table.header() == [
        "flight", "distance", "DDL avg", "DDL final", "windowed avg", "windowed final",
    ]  # fmt: skip
    assert table.rows() == [
        ["seq1", "50 m", "2.00 ± 1.41", "4.00 ± 1.41", "0.50", "-"],
        ["seq2", "70 m", "4.00", "0.50", "0.10", "0.20"],
        ["mean", "", "3.00", "2.25", "0.30", "-"],
    ]
    findings = "\n".join(table.findings())
    assert "average error: the windowed method's mean is 10.0 times below" in findings
    assert "final error: the windowed" not in findings  # a figure is missing


@pytest.mark.parametrize(("nees", "word"), [(6.0, "inside"), (2.0, "outside"), (14.0, "outside")])
def test_finding_about_the_covariance(nees, word):
    cells = [a_cell(seed=seed, nees_final=nees) for seed in range(9)]
    (finding,) = Table5(cells).findings()
    assert f"NEES of the last pose {nees:.2f} over 9 flights, {word} the 95 % band" in finding


def test_frames_without_a_pose_are_told():
    assert Table5([a_cell(coverage_percent=93.75)]).findings()[-1] == (
        "seq1_GN_0: only 93.8 % of the frames got a pose"
    )


def test_the_paper_s_figures_have_the_paper_s_means():
    """3.04, 2.88 and 2.23 % on average; 1.43, 1.82 and 1.02 % at the end."""
    assert tuple(PAPER) == SEQUENCES
    means = np.mean([np.array(row[1:]) for row in PAPER.values()], axis=0)
    np.testing.assert_allclose(means, [(3.04, 1.43), (2.88, 1.82), (2.23, 1.02)], atol=5e-3)
    assert sum(row[0] for row in PAPER.values()) == 5084


# --------------------------------------------------------------------------------------- the report


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    return Table5(
        [
            a_cell(flight, method, seed, average_percent=float(rng.uniform(1, 3)))
            for flight in SEQUENCES
            for method in METHODS
            for seed in range(3)
        ]
    )


def test_csv_has_a_line_for_each_cell(table):
    rows = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(rows) == 9 * len(METHODS) * 3
    assert {row["method"] for row in rows} == set(METHODS)
    assert float(rows[5]["average_percent"]) == table.cells[5].average_percent
    assert rows[5]["TRACKING"] == "100"
    assert "positions_m" not in rows[0]


def test_markdown_holds_the_tables_and_the_pictures(table):
    text = to_markdown(table, ["Flown at noon."], ["seq1.png"])
    lines = text.splitlines()
    assert "Flown at noon." in lines
    assert "![seq1](seq1.png)" in lines
    assert "| mean |  | 3.04 | 1.43 | 2.88 | 1.82 | 2.23 | 1.02 |" in lines
    ours = f"| {' | '.join(table.rows()[-1])} |"
    assert lines.count(ours) == 1
    for header in (table.header(), table.consistency_header()):
        at = lines.index(f"| {' | '.join(header)} |")
        assert {line.count("|") for line in lines[at : at + 11]} == {len(header) + 1}
        assert lines[at + 1].startswith("| --- | ---: |")


def test_json_holds_no_curves(table):
    figures = json.loads(json.dumps(table.as_dict()))
    assert len(figures["cells"]) == 9 * len(METHODS) * 3
    assert figures["mean"]["GN"]["final_percent"] == 1.0
    assert "curve_percent" not in figures["cells"][0]


def test_picture_shows_every_method(tmp_path):
    """Cells of distinct ways: each colour is seen, and so is the truth."""
    cells = [
        a_cell(
            method=method,
            positions_m=[[0.0, 0.0, 0.0], [None, None, None], [5.0 * i, 0.0, 30.0], [9.0, 0.0, 50]],
            curve_percent=[1.0 + i, 2.0],
        )
        for i, method in enumerate(METHODS, start=1)
    ]
    plot_flight(tmp_path / "seq1.png", "seq1", [*cells, a_cell("seq2")])
    picture = cv2.imread(str(tmp_path / "seq1.png"))
    assert min(picture.shape[:2]) > 500
    for colour in (*COLOURS.values(), "#222222"):
        bgr = [int(colour[i : i + 2], 16) for i in (5, 3, 1)]
        near = np.all(np.abs(picture.astype(int) - bgr) < 16, axis=2)
        assert np.sum(near) > 100, colour
    assert [path.name for path in tmp_path.iterdir()] == ["seq1.png"]
