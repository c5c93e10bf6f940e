import numpy as np
import pytest

from thermal_stereo_vo.calibration.checks import check_eyes, check_known_baseline, verify
from thermal_stereo_vo.calibration.figures import (
    epipolar_errors,
    fundamental,
    pair_views,
    triangulated,
)
from thermal_stereo_vo.calibration.geometric import calibrate
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.calibration.views import BoardShot
from thermal_stereo_vo.core.cameras import RigCalibration, RigCamera
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform

from .made_up_views import LEFT, RIGHT, T_RIGHT_LEFT, made_up_shots

TARGET = parse_target("chessboard:9x6:0.04")
ROLES = ("left", "right")


@pytest.fixture
def seen(rng):
    shots, poses = made_up_shots(TARGET, 15, rng, noise_px=0.1)
    return pair_views(shots, ROLES), shots, poses


def rig(T_right_left, left=LEFT, right=RIGHT):
    return RigCalibration(
        {"left": RigCamera(left), "right": RigCamera(right, inverse(T_right_left))}, origin="a test"
    )


def test_the_truth_has_nothing_to_object_to(seen):
    verdict = verify(rig(T_RIGHT_LEFT), ROLES, TARGET, seen[0])
    assert verdict.findings == ()
    assert 0.05 < verdict.errors.epipolar_12_px < 0.2
    assert abs(verdict.errors.spacing_error_percent) < 0.05
    assert abs(verdict.errors.distance_error_percent) < 0.2
    assert abs(verdict.errors.yaw_error_rad) < 5e-4


def test_transposed_rotation(seen):
    """The calibrator row of P1 Tables I to III: good reprojection, several px of epipolar error."""
    wrong = make_transform(T_RIGHT_LEFT[:3, :3].T, T_RIGHT_LEFT[:3, 3])
    verdict = verify(rig(wrong), ROLES, TARGET, seen[0])
    assert any("rotation transposed" in finding for finding in verdict.findings)
    assert verdict.errors.epipolar_12_px > 5.0
    assert verdict.alternatives["rotation transposed"].epipolar_12_px < 0.2


def test_swapped_eyes(seen):
    pairs, _, _ = seen
    swapped = [type(p)(p.name, p.ids, p.second, p.first) for p in pairs]
    verdict = verify(rig(T_RIGHT_LEFT), ROLES, TARGET, swapped)
    assert any(finding.startswith("eyes swapped") for finding in verdict.findings)


def test_motion_the_wrong_way_round(seen):
    verdict = verify(rig(inverse(T_RIGHT_LEFT)), ROLES, TARGET, seen[0])
    assert any("motion inverted" in finding for finding in verdict.findings)


def test_wrong_scale(seen):
    stretched = make_transform(T_RIGHT_LEFT[:3, :3], 1.05 * T_RIGHT_LEFT[:3, 3])
    verdict = verify(rig(stretched), ROLES, TARGET, seen[0])
    assert verdict.errors.spacing_error_percent == pytest.approx(5.0, abs=0.3)
    assert any("wrong scale" in finding and "42.0" in finding for finding in verdict.findings)


def test_yaw_that_no_epipolar_error_shows(seen):
    """0.3 degrees of relative yaw: rows still match, distances do not."""
    turned = make_transform(
        exp_so3([0.0, np.radians(0.3), 0.0]) @ T_RIGHT_LEFT[:3, :3], T_RIGHT_LEFT[:3, 3]
    )
    verdict = verify(rig(turned), ROLES, TARGET, seen[0])
    assert verdict.errors.epipolar_12_px < 0.6
    assert abs(verdict.errors.distance_error_percent) > 1.0
    assert any("yaw" in f or "scale" in f for f in verdict.findings)


def test_nothing_to_verify_with():
    with pytest.raises(CalibrationError, match="nothing to verify with"):
        verify(rig(T_RIGHT_LEFT), ROLES, TARGET, [])


def test_board_of_another_size_contradicts_a_known_baseline(seen):
    _, shots, _ = seen
    sizes = {"left": (640, 480), "right": (640, 480)}
    wrong = parse_target("chessboard:9x6:0.05")
    pair = calibrate(shots, wrong, sizes).pair
    with pytest.raises(
        CalibrationError, match=r"squares of (39\.9|40\.0)\d mm instead of 50\.00 mm"
    ):
        check_known_baseline(pair, wrong, 0.2678)
    right = calibrate(shots, TARGET, sizes).pair
    check_known_baseline(right, TARGET, 0.2678)


def test_exchanged_sources_are_noticed(seen):
    _, shots, _ = seen
    exchanged = [
        BoardShot(s.name, {{"left": "right", "right": "left"}[r]: v for r, v in s.views.items()})
        for s in shots
    ]
    pair = calibrate(exchanged, TARGET, {"left": (640, 480), "right": (640, 480)}).pair
    with pytest.raises(CalibrationError, match=r"the eyes are swapped.*to the LEFT"):
        check_eyes(pair, ROLES)
    check_eyes(pair, ("visible", "thermal"))  # two bands have no left and right


def test_epipolar_lines_pass_through_their_points(seen):
    """F of the undistorted pixels, against projecting a point at two depths."""
    F = fundamental(LEFT, RIGHT, T_RIGHT_LEFT)
    left, right = LEFT.without_distortion(), RIGHT.without_distortion()
    for point in ([0.1, 0.05, 1.0], [-0.4, 0.2, 3.0], [0.3, -0.3, 20.0]):
        x1 = np.append(left.project(np.array([point])), 1.0)
        in_right = T_RIGHT_LEFT[:3, :3] @ point + T_RIGHT_LEFT[:3, 3]
        x2 = np.append(right.project(in_right[None]), 1.0)
        line = F @ x1
        assert abs(x2 @ line) / np.linalg.norm(line[:2]) < 1e-9


def test_triangulation_and_epipolar_error_without_noise(rng):
    shots, poses = made_up_shots(TARGET, 3, rng, noise_px=0.0)
    for pair in pair_views(shots, ROLES):
        T = poses[int(pair.name)]
        truth = TARGET.points_m[pair.ids] @ T[:3, :3].T + T[:3, 3]
        found = triangulated(LEFT, RIGHT, T_RIGHT_LEFT, pair)
        np.testing.assert_allclose(found, truth, atol=1e-7)
        forward, backward = epipolar_errors(LEFT, RIGHT, T_RIGHT_LEFT, pair)
        assert max(forward.max(), backward.max()) < 1e-6
