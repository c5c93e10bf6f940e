from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.calibration.geometric import calibrate
from thermal_stereo_vo.calibration.initial import half_turn
from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.calibration.problem import KnownLens, Settings
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.calibration.views import BoardShot, BoardView
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import exp_so3, log_so3, make_transform

from .made_up_views import LEFT, RIGHT, T_RIGHT_LEFT, made_up_shots

TARGET = parse_target("chessboard:9x6:0.04")
SIZES = {"left": (640, 480), "right": (640, 480)}


@pytest.fixture
def shots(rng):
    return made_up_shots(TARGET, 22, rng, noise_px=0.1)[0]


def test_the_rig_of_the_paper(shots):
    """22 views as in P1, 0.1 px of noise: better than the best column of its Tables II and III."""
    result = calibrate(shots, TARGET, SIZES)
    for role, true in (("left", LEFT), ("right", RIGHT)):
        camera = result.cameras[role]
        assert abs(camera.camera.fx / true.fx - 1) < 2e-3
        assert abs(camera.camera.cx - true.cx) < 1.0
        assert abs(camera.camera.cy - true.cy) < 1.0
        assert abs(camera.camera.fx - true.fx) < 4 * camera.sigma[0]
        # Mean of a Rayleigh distribution: 1.25 standard deviations.
        assert 0.11 < camera.training.mean_px < 0.135
        assert camera.held_out is not None
        assert camera.held_out.mean_px > 0.9 * camera.training.mean_px
    pair = result.pair
    assert abs(pair.baseline_m - 0.2678445) < 3e-4
    turn = log_so3(pair.T_second_first[:3, :3] @ T_RIGHT_LEFT[:3, :3].T)
    assert np.linalg.norm(turn) < 2e-3
    assert 0.05 < pair.held_out.epipolar_12_px < 0.2
    assert pair.held_out.in_front == 1.0
    assert abs(pair.held_out.spacing_error_percent) < 0.1
    assert not result.warnings


def test_same_views_same_result(shots):
    a, b = calibrate(shots, TARGET, SIZES), calibrate(shots, TARGET, SIZES)
    # OpenCV's first guess differs in the last digits from run to run.
    assert a.views[0].rms_px == pytest.approx(b.views[0].rms_px, rel=1e-9)
    for role in SIZES:
        assert a.cameras[role].parameters == pytest.approx(b.cameras[role].parameters, rel=1e-9)
    np.testing.assert_allclose(a.pair.T_second_first, b.pair.T_second_first, atol=1e-10)


def test_single_camera(shots):
    only_left = [BoardShot(s.name, {"left": s.views["left"]}) for s in shots if "left" in s.views]
    result = calibrate(only_left, TARGET, {"left": (640, 480)})
    assert result.pair is None
    assert abs(result.cameras["left"].camera.fx - LEFT.fx) < 4 * result.cameras["left"].sigma[0]


def test_tangential_coefficients_are_fitted_only_where_they_exist(rng):
    straight = replace(LEFT, distortion=(-0.2851, 0.0864, 0.0, 0.0))
    lenses = []
    for camera in (straight, replace(LEFT, distortion=(-0.2851, 0.0864, -0.01, 0.004))):
        shots, _ = made_up_shots(TARGET, 15, rng, left=camera)
        left = [BoardShot(s.name, {"left": s.views["left"]}) for s in shots if "left" in s.views]
        lenses.append(calibrate(left, TARGET, {"left": (640, 480)}).cameras["left"].lens)
    assert lenses == [Lens.RADTAN2, Lens.RADTAN4]


def test_boards_numbered_from_the_other_end_are_set_right(shots):
    mixed = [
        BoardShot(s.name, {**s.views, "right": half_turn(s.views["right"], TARGET)})
        if "right" in s.views and k % 3 == 0
        else s
        for k, s in enumerate(shots)
    ]
    plain, turned = calibrate(shots, TARGET, SIZES), calibrate(mixed, TARGET, SIZES)
    np.testing.assert_allclose(turned.pair.T_second_first, plain.pair.T_second_first, atol=1e-9)


def test_upside_down_camera(rng):
    """A camera mounted on its head numbers every board from the other end."""
    T = make_transform(exp_so3([0.0, 0.0, np.pi]) @ T_RIGHT_LEFT[:3, :3], [-0.268, 0.002, 0.001])
    shots, _ = made_up_shots(TARGET, 15, rng, T_right_left=T)
    seen = [
        BoardShot(s.name, {**s.views, "right": half_turn(s.views["right"], TARGET)})
        if "right" in s.views
        else s
        for s in shots
    ]
    pair = calibrate(seen, TARGET, SIZES).pair
    np.testing.assert_allclose(pair.T_second_first, T, atol=2e-3)


def bent(view: BoardView, rng) -> BoardView:
    return BoardView(view.ids, view.pixels + rng.normal(0, 3.0, view.pixels.shape), view.sigma_px)


def test_a_bad_view_is_refused_with_the_reason(shots, rng):
    k = next(i for i, s in enumerate(shots) if len(s.views) == 2)
    views = {role: bent(view, rng) for role, view in shots[k].views.items()}
    shots[k] = BoardShot(shots[k].name, views)
    result = calibrate(shots, TARGET, SIZES)
    record = next(v for v in result.views if v.name == shots[k].name)
    assert record.state == "refused"
    assert "px off in the" in record.reason
    assert abs(result.cameras["left"].camera.fx / LEFT.fx - 1) < 2e-3


def test_a_board_that_moved_between_exposures_is_split(shots):
    k = next(i for i, s in enumerate(shots) if len(s.views) == 2)
    right = shots[k].views["right"]
    moved = BoardView(right.ids, right.pixels + np.array([0.0, 6.0]), right.sigma_px)
    shots[k] = BoardShot(shots[k].name, {**shots[k].views, "right": moved})
    result = calibrate(shots, TARGET, SIZES)
    record = next(v for v in result.views if v.name == shots[k].name)
    assert record.state == "split"
    assert "moved between the two exposures" in record.reason
    assert abs(result.pair.baseline_m - 0.2678445) < 3e-4


def test_views_beyond_the_limit_test_the_others(shots):
    result = calibrate(shots, TARGET, SIZES, Settings(view_limit=12))
    states = [view.state for view in result.views]
    assert states.count("used") == 12
    assert states.count("held out") == len(shots) - 12
    assert result.pair.held_out_how == f"{len(shots) - 12} views that took no part"
    assert result.pair.held_out.views <= len(shots) - 12


def test_limit_below_what_a_calibration_needs():
    with pytest.raises(CalibrationError, match=r"2 views are too few.*at least 5"):
        Settings(view_limit=2)


def test_known_lens_stays_within_its_uncertainty(rng):
    """Few, flat views cannot move a lens that was calibrated well before."""
    shots, _ = made_up_shots(TARGET, 6, rng, tilt_deg=3.0, noise_px=0.1)
    covariance = np.diag(np.array([0.4, 0.4, 0.4, 0.4, 2e-3, 4e-3, 2e-4, 2e-4]) ** 2)
    known = {
        role: KnownLens(
            Lens.RADTAN4,
            np.array([c.fx, c.fy, c.cx, c.cy, *c.distortion]),
            covariance,
        )
        for role, c in (("left", LEFT), ("right", RIGHT))
    }
    result = calibrate(shots, TARGET, SIZES, Settings(known=known))
    assert abs(result.cameras["left"].camera.fx - LEFT.fx) < 1.6
    assert result.cameras["left"].sigma[0] < 0.5
    assert abs(result.pair.baseline_m - 0.2678445) < 2e-3


def test_three_views_are_too_few(shots):
    with pytest.raises(CalibrationError, match=r"only 3 views of the board usable for left.*5 are"):
        calibrate(shots[:3], TARGET, SIZES)


def test_views_all_alike(shots, rng):
    one = next(s for s in shots if len(s.views) == 2)
    same = [
        BoardShot(
            f"{k}",
            {
                role: BoardView(v.ids, v.pixels + rng.normal(0, 0.1, v.pixels.shape), v.sigma_px)
                for role, v in one.views.items()
            },
        )
        for k in range(12)
    ]
    with pytest.raises(CalibrationError, match="12 views of the left camera are all alike"):
        calibrate(same, TARGET, SIZES)


def test_boards_never_tilted(rng):
    shots, _ = made_up_shots(TARGET, 15, rng, tilt_deg=0.3)
    flat = [BoardShot(s.name, {"left": s.views["left"]}) for s in shots if "left" in s.views]
    with pytest.raises(CalibrationError, match=r"tilt the board by 20 to 45 deg"):
        calibrate(flat, TARGET, {"left": (640, 480)})


def test_cameras_that_never_saw_the_board_together(shots):
    apart = [
        BoardShot(f"{s.name}{role}", {role: view}) for s in shots for role, view in s.views.items()
    ]
    with pytest.raises(CalibrationError, match="no shot shows the board to both cameras"):
        calibrate(apart, TARGET, SIZES)


def test_one_camera_without_views(shots):
    left = [BoardShot(s.name, {"left": s.views["left"]}) for s in shots if "left" in s.views]
    with pytest.raises(CalibrationError, match="no view of the board usable for right"):
        calibrate(left, TARGET, SIZES)


def test_poor_views_are_warned_of(rng):
    shots, _ = made_up_shots(TARGET, 8, rng, tilt_deg=9.0)
    warnings = " / ".join(calibrate(shots, TARGET, SIZES).warnings)
    assert "left: only 8 views" in warnings
    assert "tilted by" in warnings


def test_result_as_a_rig(shots):
    rig = calibrate(shots, TARGET, SIZES).rig_calibration("a test")
    rig.check_stereo()
    assert rig.baseline_m == pytest.approx(0.2678, abs=1e-3)
    assert rig["left"].rectification is not None
    assert rig["right"].projection[0, 3] == pytest.approx(
        -rig["right"].projection[0, 0] * 0.26785, rel=2e-3
    )
