import numpy as np
import pytest

from thermal_stereo_vo.calibration.loop import close_loop
from thermal_stereo_vo.calibration.result import StoredPair, load_pair
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import exp_se3, inverse

NAMES = ("a", "b", "c", "d")
SIGMA = np.array([2e-3, 1e-3, 5e-3, 2e-3, 4e-3, 1e-3])


def pairs(rng, noise=0.0):
    T_world = [exp_se3(rng.normal(0, 0.3, 6)) for _ in NAMES]
    found = []
    for k in range(4):
        first, second = k, (k + 1) % 4
        T = inverse(T_world[second]) @ T_world[first]
        T = exp_se3(noise * SIGMA * rng.normal(size=6)) @ T
        found.append(StoredPair(NAMES[first], NAMES[second], T, np.diag(SIGMA**2), ""))
    return found


def test_exact_pairs_close(rng):
    closure = close_loop(pairs(rng))
    assert closure.cameras == ("a", "b", "c", "d", "a")
    np.testing.assert_allclose(closure.twist, 0.0, atol=1e-12)
    assert closure.agrees


def test_direction_of_a_pair_does_not_matter(rng):
    loop = pairs(rng, noise=1.0)
    plain = close_loop(loop)
    b = loop[1]
    turned = inverse(b.T_second_first)
    from thermal_stereo_vo.core.transforms import adjoint

    A = adjoint(turned)
    loop[1] = StoredPair(b.second, b.first, turned, A @ b.covariance @ A.T, "")
    again = close_loop(loop)
    np.testing.assert_allclose(again.twist, plain.twist, atol=1e-12)
    assert again.chi2 == pytest.approx(plain.chi2)


def test_chi2_has_six_degrees_of_freedom(rng):
    scores = [close_loop(pairs(rng, noise=1.0)).chi2 for _ in range(300)]
    assert 5.3 < np.mean(scores) < 6.7
    assert np.mean([s > 16.81 for s in scores]) < 0.04


def test_a_wrong_pair_is_beyond_its_uncertainty(rng):
    loop = pairs(rng, noise=1.0)
    loop[2] = StoredPair(
        "c", "d", exp_se3([0.03, 0, 0, 0, 0, 0]) @ loop[2].T_second_first, loop[2].covariance, ""
    )
    assert not close_loop(loop).agrees


def test_refusals(rng):
    loop = pairs(rng)
    with pytest.raises(CalibrationError, match="at least three pairs"):
        close_loop(loop[:2])
    with pytest.raises(CalibrationError, match=r"lead from 'a' to 'd' and not back"):
        close_loop(loop[:3])
    with pytest.raises(CalibrationError, match="form no loop"):
        close_loop([loop[0], loop[1], StoredPair("x", "y", np.eye(4), np.eye(6), "")])


def test_reports_that_are_none(tmp_path):
    with pytest.raises(CalibrationError, match="give a folder that 'calibrate stereo' wrote"):
        load_pair(tmp_path)
    (tmp_path / "report.json").write_text('{"cameras": {}}')
    with pytest.raises(CalibrationError, match="is no report of a stereo calibration"):
        load_pair(tmp_path)
