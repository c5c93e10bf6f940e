"""What the table of visible + thermal runs says, from runs with known errors."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.evaluation.band_cell import load_band_cells, make_band_cell
from thermal_stereo_vo.evaluation.band_table import BandTable, to_markdown
from thermal_stereo_vo.evaluation.flight_cell import save_cell
from thermal_stereo_vo.outputs.band_figures import plot_bands

FRAMES = 300
PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    t = np.linspace(0.0, 12.0, FRAMES)
    ways = [[np.sin(a), 0.2 * a, np.cos(2 * a), 0.1 * np.sin(a), 0.2, 0.0] for a in t]
    return Trajectory(np.arange(FRAMES) * PERIOD_NS, np.array([exp_se3(xi) for xi in ways]))


def run(truth, scale=1.01, converged=40, jump_m=0.0, lost=range(0)):
    for i, (stamp_ns, T) in enumerate(zip(truth.stamps_ns, truth.T_world_rig, strict=True)):
        known = None if converged is None else i >= converged
        pose = T.copy()
        pose[:3, 3] *= scale
        pose[0, 3] += jump_m if i > 200 else 0.0
        if i in lost:
            yield OdometryResult(int(stamp_ns), TrackingStatus.LOST, None, None)
        else:
            yield OdometryResult(
                int(stamp_ns), TrackingStatus.TRACKING, pose, np.eye(6), scale_converged=known
            )


def cell(truth, flight="ms-01", contender="both", seed=0, **how):
    return make_band_cell(flight, contender, seed, list(run(truth, **how)), truth, 20.0)


def test_a_cell_holds_the_figures_of_its_run(truth):
    found = cell(truth, scale=1.02, lost=range(100, 110))
    assert found.converged_after_s == pytest.approx(2.0)
    assert found.scale_error_percent == pytest.approx(2.0, abs=1e-6)
    assert found.sim3_ate_m == pytest.approx(0.0, abs=1e-9)
    assert 0.005 < found.se3_ate_m < 0.05
    assert found.path_length_m == pytest.approx(truth.path_lengths_m[-1])
    assert found.statuses["LOST"] == 10
    assert found.coverage_percent == pytest.approx(100.0 * (FRAMES - 50) / FRAMES)
    assert len(found.times_s) == len(found.positions_m) == len(found.errors_m)
    assert found.times_s[0] == pytest.approx(2.0)
    assert None in found.errors_m  # where it was lost


def test_drift_without_a_scale_is_that_of_the_shape(truth):
    known, unknown = cell(truth, scale=1.02), cell(truth, scale=0.3, converged=FRAMES + 1)
    assert 0.5 < known.average_percent < 2.0
    assert unknown.average_percent == pytest.approx(0.0, abs=1e-6)
    assert unknown.final_percent == pytest.approx(0.0, abs=1e-6)
    bent = cell(truth, scale=0.3, converged=FRAMES + 1, jump_m=0.1)
    jump_percent = 100.0 * 0.1 / 0.3 / truth.path_lengths_m[-1]
    assert 0.5 * jump_percent < bent.final_percent < 1.5 * jump_percent


def test_covariances_are_held_against_the_errors_of_metric_poses(truth):
    found = cell(truth, scale=1.0, converged=100, jump_m=0.3)
    # 99 of 200 poses are off by 0.3 where 1 is claimed.
    assert found.nees_mean == pytest.approx(0.3**2 * 99 / 200, rel=1e-6)
    assert cell(truth, converged=FRAMES + 1).nees_mean is None


def test_all_runs_are_drawn_in_one_world(truth):
    """Whenever they found their scale: a run without error lies on the truth."""
    for converged in (0, 100, FRAMES + 1):
        found = cell(truth, converged=converged)
        np.testing.assert_allclose(found.positions_m, found.true_positions_m, atol=1e-3)
        from_start = truth.T_world_rig[0][:3, :3].T @ (truth.positions_m[-1] - truth.positions_m[0])
        np.testing.assert_allclose(found.true_positions_m[-1], from_start, atol=1e-3)


def test_a_method_in_metres_is_known_from_the_start(truth):
    found = cell(truth, converged=None, scale=0.97)
    assert found.converged_after_s == 0.0
    assert found.scale_error_percent == pytest.approx(-3.0, abs=1e-6)


def test_cells_survive_the_disk(truth, tmp_path):
    cells = [cell(truth, seed=seed, lost=range(150, 160)) for seed in (1, 0)]
    for one in cells:
        save_cell(tmp_path, one)
    again = load_band_cells(tmp_path)
    assert [one.seed for one in again] == [0, 1]
    assert asdict(again[1])["errors_m"] == cells[0].errors_m
    (tmp_path / "ms-01_both_7.json").write_text("{}")
    with pytest.raises(EvaluationError, match=r"ms-01_both_7.json is no cell of a sweep"):
        load_band_cells(tmp_path)


def test_a_run_without_poses_is_a_cell_of_nothing(truth):
    found = cell(truth, lost=range(FRAMES))
    assert found.coverage_percent == 0.0
    assert found.sim3_ate_m is found.converged_after_s is None
    row = BandTable([found]).rows()[0]
    assert row[BandTable([]).header().index("converged")] == "never"


def column(table, name, row=0):
    return table.rows()[row][table.header().index(name)]


def test_the_table_gives_means_and_worst_of_the_seeds(truth):
    cells = [cell(truth, seed=0, scale=1.01), cell(truth, seed=1, scale=0.97)]
    table = BandTable(cells)
    assert len(table.rows()) == 1
    assert column(table, "seeds") == "2"
    assert column(table, "scale error") == "2.00 %"
    assert column(table, "converged") == "2.0 s"
    said = " ".join(table.findings())
    assert "2 runs: the scale converged in 2." in said
    assert "the scale error 2.00 and 3.00 %" in said


def test_runs_that_never_converge_are_counted(truth):
    cells = [cell(truth), cell(truth, seed=1, converged=FRAMES + 1)]
    table = BandTable(cells)
    assert column(table, "converged") == "2.0 s (1 of 2)"
    assert "converged in 1 and never in 1." in " ".join(table.findings())


def test_a_case_is_compared_with_the_calm_run(truth):
    table = BandTable(
        [
            cell(truth, "ms-01+calm", scale=1.01),
            cell(truth, "ms-01+nuc", scale=1.02, jump_m=0.3),
        ]
    )
    (said,) = table.findings()
    assert said.startswith("ms-01+nuc by both: the SE(3) ATE is ")
    ratio = float(said.split("ATE is ")[1].split()[0])
    assert ratio > 2.0
    assert "the worst step is 0.3" in said


@pytest.mark.parametrize(
    ("converged", "said"), [(FRAMES + 1, "never taken for known"), (40, "TAKEN FOR KNOWN")]
)
def test_a_scale_that_cannot_be_known_must_not_be(truth, converged, said):
    (sentence,) = BandTable([cell(truth, "ms-still", converged=converged)]).findings()
    assert said in sentence


def test_one_camera_on_a_recording_is_told_by_its_distance(truth):
    alone = cell(truth, "street-left", "visible", converged=FRAMES + 1, jump_m=0.4)
    (sentence,) = BandTable([alone]).findings()
    percent = 100.0 * alone.sim3_ate_m / truth.path_lengths_m[-1]
    assert f"{percent:.2f} % of" in sentence


def test_the_report_and_its_pictures(truth, tmp_path):
    cells = [
        cell(truth),
        cell(truth, seed=1, lost=range(90, 99)),
        cell(truth, contender="visible", converged=FRAMES + 1, scale=3.0),
        replace(cell(truth, contender="thermal", lost=range(FRAMES))),
    ]
    plot_bands(tmp_path / "ms-01.png", "ms-01", cells)
    assert (tmp_path / "ms-01.png").stat().st_size > 20_000
    text = to_markdown(BandTable(cells), ["4 runs."], ["ms-01.png"])
    assert text.count("\n| ms-01 |") == 3
    assert "![ms-01.png](ms-01.png)" in text
