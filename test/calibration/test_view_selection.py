import numpy as np
import pytest

from thermal_stereo_vo.calibration.bundle import Rig, solve
from thermal_stereo_vo.calibration.lenses import Lens, from_camera
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.calibration.view_selection import (
    coverage,
    jackknife_covariance,
    select_views,
)

from .made_up_views import LEFT, made_up_shots, observations_of

TARGET = parse_target("chessboard:7x5:0.05")


@pytest.fixture
def solved(rng):
    shots, poses = made_up_shots(TARGET, 18, rng, noise_px=0.2)
    observations = [o for o in observations_of(TARGET, shots) if o.camera == 0]
    seen = {o.view: o for o in observations}
    rig = Rig((Lens.RADTAN4,), (from_camera(Lens.RADTAN4, LEFT),), (np.eye(4),), tuple(poses))
    cells = {v: coverage(o.pixels, LEFT.size).ravel() for v, o in seen.items()}
    return solve(rig, observations), observations, cells


def test_predicted_error_on_views_left_out_is_the_real_one(solved):
    """The linear prediction against calibrating again with the chosen views only."""
    solution, observations, cells = solved
    selection = select_views(solution.information, solution.known, cells, 9)
    chosen = set(selection.chosen)
    again = solve(solution.rig, [o for o in observations if o.view in chosen])
    rest = [o for o in observations if o.view not in chosen]
    # The boards of the rest take their best poses under the new, fixed lens.
    posed = solve(again.rig, rest, fixed_lenses=True)
    real = np.sqrt(np.mean(np.concatenate([np.sum(r**2, axis=1) for r in posed.residuals])))
    assert selection.held_out_rms_px[-1] == pytest.approx(real, rel=0.05)


def test_choice_is_greedy_and_bounded(solved):
    solution, _, cells = solved
    few = select_views(solution.information, solution.known, cells, 5)
    more = select_views(solution.information, solution.known, cells, 10)
    assert len(set(more.chosen)) == 10
    assert more.chosen[:5] == few.chosen
    everything = select_views(solution.information, solution.known, cells, 1000)
    assert len(everything.chosen) == len(solution.information) - 1


def test_first_views_beat_arbitrary_ones(solved, rng):
    """Five chosen views know the focal length better than five taken blindly."""
    solution, _, cells = solved
    information = solution.information

    def sigma(views):
        hessian = sum(information[v].hessian for v in views)
        return float(np.sqrt(np.linalg.inv(hessian)[0, 0]))

    chosen = sigma(select_views(information, solution.known, cells, 6).chosen)
    blind = [sigma(rng.choice(list(information), 6, replace=False)) for _ in range(40)]
    assert chosen < np.median(blind)


def test_jackknife_agrees_where_points_are_independent(solved):
    solution, _, _ = solved
    jackknife = jackknife_covariance(solution.information, solution.known)
    ratio = np.sqrt(np.diag(jackknife) / np.diag(solution.covariance))
    assert (ratio > 0.4).all()
    assert (ratio < 2.5).all()


def test_jackknife_sees_errors_common_to_a_view(rng):
    """Each board bent in its own way: independent points would be far too sure."""
    shots, poses = made_up_shots(TARGET, 18, rng, noise_px=0.02)
    observations = [o for o in observations_of(TARGET, shots) if o.camera == 0]
    bent = []
    for o in observations:
        x = o.points_m[:, 0] - o.points_m[:, 0].mean()
        bend = rng.normal(0.0, 0.3) * (x / x.max()) ** 2
        bent.append(type(o)(o.view, 0, o.points_m, o.pixels + bend[:, None] * (0.3, 1.0), o.weight))
    rig = Rig((Lens.RADTAN4,), (from_camera(Lens.RADTAN4, LEFT),), (np.eye(4),), tuple(poses))
    solution = solve(rig, bent)
    jackknife = jackknife_covariance(solution.information, solution.known)
    # Bent up and down, they move the image centre up and down.
    assert np.sqrt(jackknife[3, 3] / solution.covariance[3, 3]) > 2.0


def test_coverage_cells():
    cells = coverage(np.array([[0.0, 0.0], [639.0, 479.0], [320.0, 10.0]]), (640, 480))
    assert cells.shape == (6, 8)
    assert cells.sum() == 3
    assert cells[0, 0]
    assert cells[5, 7]
    assert cells[0, 4]
