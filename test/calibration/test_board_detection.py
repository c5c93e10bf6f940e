import numpy as np
import pytest

from thermal_stereo_vo.calibration.detection import detect
from thermal_stereo_vo.calibration.normalisation import without_bad_pixels
from thermal_stereo_vo.calibration.targets import parse_target
from thermal_stereo_vo.core.errors import FrameError

CHESSBOARD = parse_target("chessboard:7x5:0.04")
MASK = parse_target("mask:5x3:0.04")


def error_px(stage, target, T, view):
    return np.linalg.norm(view.pixels - stage.pixels(target, T)[view.ids], axis=1)


@pytest.mark.parametrize(
    ("coated", "plain"), [(3400.0, 3000.0), (3000.0, 3400.0)], ids=["warm paint", "cold paint"]
)
def test_chessboard_of_either_polarity(stage, hold, rng, coated, plain):
    T = hold(CHESSBOARD, (20.0, -15.0, 10.0), (0.03, -0.02), 0.42)
    image = stage.picture(CHESSBOARD, T, rng, coated=coated, plain=plain)
    detection = detect(image, CHESSBOARD)
    assert detection.found, detection.reason
    assert not detection.beyond
    assert len(detection.view) == CHESSBOARD.count
    assert error_px(stage, CHESSBOARD, T, detection.view).max() < 0.1


def test_weak_contrast_under_a_hot_spot(stage, hold, rng):
    """40 counts of pattern on 2500 counts of hot spot; a shift to 8 bit leaves one grey level."""
    T = hold(CHESSBOARD, (-20.0, 10.0, -5.0), (0.0, 0.0), 0.42)
    image = stage.picture(
        CHESSBOARD, T, rng, coated=3040.0, plain=3000.0, hot_spot=2500.0, noise=1.5
    )
    detection = detect(image, CHESSBOARD)
    assert detection.found, detection.reason
    error = error_px(stage, CHESSBOARD, T, detection.view)
    assert np.median(error) < 0.15
    # The claimed uncertainty is of the order of the error, neither far below nor above.
    assert 0.3 < np.median(detection.view.sigma_px) / np.median(error) < 3.0


def test_a_hidden_corner_is_left_out_and_the_rest_used(stage, hold, rng):
    T = hold(CHESSBOARD, (0.0, 20.0, 0.0), (0.0, 0.0), 0.42)
    image = stage.picture(CHESSBOARD, T, rng)
    x, y = stage.pixels(CHESSBOARD, T)[0].astype(int)
    image[y - 14 : y + 8, x - 14 : x + 8] = 3900  # something warm mirrored there
    detection = detect(image, CHESSBOARD)
    assert detection.found, detection.reason
    assert 0 not in detection.view.ids
    assert len(detection.view) >= CHESSBOARD.count - 4
    assert error_px(stage, CHESSBOARD, T, detection.view).max() < 0.2


def test_board_cut_by_the_border_is_refused(stage, hold, rng):
    T = hold(CHESSBOARD, (0.0, 10.0, 0.0), (0.45, 0.0), 0.42)
    detection = detect(stage.picture(CHESSBOARD, T, rng), CHESSBOARD)
    assert not detection.found
    assert "partial view" in detection.reason
    assert "where the board has 7x5" in detection.reason


def test_larger_board_is_noticed(stage, hold, rng):
    """A piece of a larger board has the right size; the line beyond gives it away."""
    T = hold(CHESSBOARD, (15.0, 10.0, 0.0), (0.0, 0.0), 0.42)
    detection = detect(stage.picture(CHESSBOARD, T, rng), parse_target("chessboard:6x5:0.04"))
    assert not detection.found or detection.beyond


@pytest.mark.parametrize("wrong", ["chessboard:8x6:0.04", "chessboard:7x6:0.04"])
def test_smaller_board_is_refused(stage, hold, rng, wrong):
    T = hold(CHESSBOARD, (15.0, 10.0, 0.0), (0.0, 0.0), 0.42)
    detection = detect(stage.picture(CHESSBOARD, T, rng), parse_target(wrong))
    assert not detection.found
    assert detection.reason


@pytest.mark.parametrize("target", [CHESSBOARD, MASK, parse_target("circles:4x3:0.06")])
def test_images_without_a_board(target, rng):
    noise = rng.normal(3000.0, 30.0, (240, 320)).astype(np.uint16)
    for image in (noise, np.full((240, 320), 77, np.uint16), np.zeros((240, 320), np.uint8)):
        detection = detect(image, target)
        assert not detection.found
        assert detection.reason


def test_colour_is_refused():
    with pytest.raises(FrameError, match="single-channel"):
        detect(np.zeros((20, 20, 3), np.uint8), CHESSBOARD)


@pytest.mark.parametrize("roll", [0.0, 90.0, 180.0, -90.0])
def test_mask_is_numbered_from_its_mark_whatever_way_up(stage, hold, rng, roll):
    T = hold(MASK, (15.0, -20.0, roll), (0.0, 0.0), 0.62)
    detection = detect(stage.picture(MASK, T, rng), MASK)
    assert detection.found, detection.reason
    # The corner beside the mark is no clean one; all the others must be there.
    assert set(range(1, MASK.count)) <= set(detection.view.ids.tolist())
    assert error_px(stage, MASK, T, detection.view).max() < 0.15


def test_mask_colder_behind_than_before(stage, hold, rng):
    T = hold(MASK, (10.0, 20.0, 5.0), (0.0, 0.0), 0.62)
    image = stage.picture(MASK, T, rng, coated=2800.0, plain=3200.0)
    detection = detect(image, MASK)
    assert detection.found, detection.reason
    assert error_px(stage, MASK, T, detection.view).max() < 0.15


def test_mask_cut_by_the_border_keeps_its_whole_holes(stage, hold, rng):
    T = hold(MASK, (0.0, 15.0, 0.0), (0.42, 0.0), 0.62)
    inside = stage.pixels(MASK, T)[:, 0] < 319
    assert 0.6 < inside.mean() < 0.97
    detection = detect(stage.picture(MASK, T, rng), MASK)
    assert detection.found, detection.reason
    assert error_px(stage, MASK, T, detection.view).max() < 0.2


def test_mask_without_its_mark_is_refused(stage, hold, rng):
    T = hold(MASK, (10.0, 10.0, 0.0), (0.0, 0.0), 0.62)
    image = stage.picture(MASK, T, rng)
    corner = stage.pixels(MASK, T)[0].astype(int)
    image[: corner[1] - 1, : corner[0] - 1] = 3000  # cover the mark
    detection = detect(image, MASK)
    assert not detection.found
    assert "orientation mark" in detection.reason


def test_mirrored_camera_is_named(stage, hold, rng):
    T = hold(MASK, (10.0, 10.0, 0.0), (0.0, 0.0), 0.62)
    detection = detect(np.ascontiguousarray(stage.picture(MASK, T, rng)[:, ::-1]), MASK)
    assert not detection.found
    assert "mirrored" in detection.reason


@pytest.mark.parametrize("text", ["circles:5x4:0.05", "acircles:4x7:0.035"])
@pytest.mark.parametrize("coated", [3400.0, 2600.0])
def test_dots(stage, hold, rng, text, coated):
    target = parse_target(text)
    T = hold(target, (5.0, -8.0, 6.0), (0.0, 0.0), 0.5)
    detection = detect(stage.picture(target, T, rng, coated=coated), target)
    assert detection.found, detection.reason
    assert error_px(stage, target, T, detection.view).max() < 0.35


def test_same_answer_twice_and_image_untouched(stage, hold, rng):
    T = hold(CHESSBOARD, (20.0, -15.0, 10.0), (0.03, -0.02), 0.42)
    image = stage.picture(CHESSBOARD, T, rng)
    image.flags.writeable = False
    first, second = detect(image, CHESSBOARD).view, detect(image, CHESSBOARD).view
    np.testing.assert_array_equal(first.pixels, second.pixels)


def test_dead_and_hot_pixels_are_no_harm(stage, hold, rng):
    """One in the orientation mark, one on a corner, one beside: as if they were not there."""
    T = hold(MASK, (10.0, 10.0, 0.0), (0.0, 0.0), 0.62)
    image = stage.picture(MASK, T, rng)
    clean = detect(image, MASK)
    mark = np.mean(
        stage.camera.project(np.array([[-0.018, -0.018, 0.0]]) @ T[:3, :3].T + T[:3, 3]), 0
    )
    x, y = np.rint(mark).astype(int)
    image[y - 1 : y + 2 : 2, x] = 0
    for k in (13, 27):
        x, y = np.rint(stage.pixels(MASK, T)[k]).astype(int)
        image[y, x] = 16383
    detection = detect(image, MASK)
    assert detection.found, detection.reason
    assert len(detection.view) == len(clean.view)
    assert error_px(stage, MASK, T, detection.view).max() < 0.3


def test_nothing_of_a_board_is_taken_for_a_bad_pixel(stage, hold, rng):
    T = hold(CHESSBOARD, (20.0, -15.0, 10.0), (0.03, -0.02), 0.42)
    image = stage.picture(CHESSBOARD, T, rng, blur_px=0.4)
    assert without_bad_pixels(image) is image
    image[100, 120] = 9000
    mended = without_bad_pixels(image)
    assert mended.dtype == np.uint16
    assert mended[100, 120] < 3500
    assert np.count_nonzero(mended != image) == 1
