"""The measurement of dense stereo: its figures on maps made up, and on a small simulated world."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.dense import (
    OURS,
    OURS_FILLED,
    PLAIN,
    PLAIN_THINNED,
    dense_report,
    measure,
    score,
    surest,
)
from thermal_stereo_vo.benchmarks.dense_views import TrueView, true_views
from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.stereo.dense import DenseConfig

NAN = np.nan


def made_view(truth):
    truth = np.asarray(truth, np.float32)
    height, width = truth.shape
    camera = Camera(width, height, 100.0, 100.0, 0.0, 0.0)
    frame = RigFrame(0, {"left": CameraView(np.zeros(truth.shape, np.uint16), camera)})
    return TrueView(frame, truth, np.ones(truth.shape, np.bool_), baseline_m=0.3)


def test_shares_are_of_the_pixels_that_are_judged_and_given():
    view = made_view([[10.0, 10.0, 10.0, 10.0, 0.0, 0.0, 0.5, 0.5]])
    found = score(view, np.array([[10.5, 11.5, 14.0, NAN, 9.0, NAN, 0.5, 0.4]], np.float32))
    assert found.density == 6 / 8
    assert found.off_1 == 3 / 6  # 1.5 px, 4 px, and the sky
    assert found.off_3 == 2 / 6
    # f B = 30 px m: nearer than 30 m are disparities above 1 px.
    assert found.depth_error == pytest.approx(np.median([0.5 / 10.5, 1.5 / 11.5, 4 / 14]), rel=1e-5)


def test_a_map_without_disparities_has_density_zero():
    found = score(made_view([[1.0, 2.0]]), np.full((1, 2), NAN, np.float32))
    assert found.density == 0.0
    assert np.isnan(found.off_1)


def test_the_surest_pixels_come_first_and_those_kept_before_all_others():
    kept = np.array([[5.0, NAN, NAN, 8.0]], np.float32)
    everything = np.array([[1.0, 2.0, 3.0, 4.0]], np.float32)
    sigma = np.array([[0.9, 0.1, 0.2, 0.3]], np.float32)
    judged = np.ones((1, 4), np.bool_)
    for share, expected in (
        (0.25, [NAN, NAN, NAN, 8.0]),
        (0.5, [5.0, NAN, NAN, 8.0]),
        (0.75, [5.0, 2.0, NAN, 8.0]),
        (1.0, [5.0, 2.0, 3.0, 8.0]),
    ):
        np.testing.assert_array_equal(
            surest(kept, everything, sigma, judged, share), np.array([expected], np.float32)
        )


@pytest.fixture(scope="module")
def small_views():
    settings = ("render.scale=0.5", "render.workers=0", "world.density=0.2")
    return list(true_views("hover", 2, settings))


def test_true_disparities_agree_with_the_pictures(small_views):
    """The left picture drawn from the right one by the truth: the difference is noise."""

    def difference(view, offset_px):
        left, right = (view.frame.views[eye].image.astype(float) for eye in ("left", "right"))
        rows, columns = np.nonzero(view.judged & (view.disparity_px > 5.0))
        at = columns - view.disparity_px[rows, columns] - offset_px
        below = np.floor(at).astype(int)
        part = at - below
        seen = right[rows, below] * (1 - part) + right[rows, below + 1] * part
        apart = left[rows, columns] - seen
        return np.median(np.abs(apart - np.median(apart)))

    for view in small_views:
        aligned = difference(view, 0.0)
        assert aligned < 3.0
        assert all(difference(view, offset_px) > 1.1 * aligned for offset_px in (-2.0, 2.0))
        assert 0.05 < (view.disparity_px == 0.0).mean() < 0.6


def test_fewer_pixels_are_off_than_with_opencv_at_equal_density(small_views):
    cells = measure("day", small_views, DenseConfig(disparities=48))
    scores = {cell.matcher: cell.score for cell in cells}
    assert scores[OURS_FILLED].density == pytest.approx(scores[PLAIN].density, abs=0.01)
    assert scores[OURS_FILLED].off_1 < 0.7 * scores[PLAIN].off_1
    assert scores[OURS].off_1 < 0.7 * scores[PLAIN_THINNED].off_1
    assert 0.3 < scores[OURS].density < 0.95
    report = dense_report(cells)
    assert "fewer pixels off by more than 1 px" in report
    assert f"{100 * scores[OURS].off_1:.1f}" in report
