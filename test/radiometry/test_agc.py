from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, THERMAL, VISIBLE, Camera
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import CameraView, GapReason, RigFrame
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain, damping_weight

CAMERA = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)


def background(rng: np.random.Generator, offset: float = 0.0) -> np.ndarray:
    slope = np.linspace(0, 200, 160)[None, :]
    return (8000 + offset + slope + rng.normal(0, 1.5, (120, 160))).astype(np.uint16)


def rig(left, right=None, *, stamp_ns: int = 0, epoch: int = 0, mask=None, blind=()) -> RigFrame:
    views = {LEFT: CameraView(left, CAMERA, mask=mask, epoch=epoch)}
    if right is not None:
        views[RIGHT] = CameraView(right, CAMERA)
    return RigFrame(stamp_ns, views, dict.fromkeys(blind, GapReason.FFC))


def shown(frame: RigFrame, role: str = LEFT) -> np.ndarray:
    display = frame.views[role].display
    assert display is not None
    return display


@pytest.mark.parametrize(
    ("damping", "firmware", "weight"),
    [
        (255, "tau_2_7", 1.0),
        (0, "tau_2_7", 0.0),
        (1, "tau_2_7", 1 / 256),
        (100, "tau_2_7", 100 / 256),
        (0, "earlier", 1.0),
        (1, "earlier", 1 / 256),
        (255, "earlier", 255 / 256),
    ],
)
def test_damping_means_what_each_firmware_says(damping, firmware, weight):
    assert damping_weight(damping, firmware) == pytest.approx(weight)


class TestHotArm:
    """Mouats et al. 2015, Fig. 8: a hot arm enters and leaves, at damping 1 and 100."""

    @staticmethod
    def run(damping: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Mean grey level of the still background, and how much it differs from the first frame."""
        gain = AutomaticGain(AgcConfig(damping=damping))
        away = (slice(60, 120), slice(0, 160))
        levels = []
        for k in range(60):
            image = background(rng)
            if 20 <= k < 40:
                image[:60, :] += np.uint16(900)
            levels.append(shown(gain.process(rig(image, stamp_ns=k)))[away].astype(float))
        first = levels[0]
        return np.array([level.mean() for level in levels]), np.array(
            [np.abs(level - first).mean() for level in levels]
        )

    def test_at_damping_1_the_arm_has_virtually_no_impact(self, rng):
        _, change = self.run(1, rng)
        assert change.max() < 6.0

    def test_at_damping_100_the_picture_changes_at_once_and_back(self, rng):
        mean, change = self.run(100, rng)
        settled = change[36:40].mean()
        assert settled > 25.0
        assert change[22] > 0.6 * settled, "most of it within three frames"
        assert change[45:].max() < 0.2 * settled, "and it comes back"
        assert abs(mean[59] - mean[0]) < 3.0

    def test_the_step_is_the_coefficient(self, rng):
        """After n frames 1 - (1 - a/256)^n of the way is done."""
        for damping in (4, 16, 64):
            gain = AutomaticGain(AgcConfig(damping=damping, mode="linear", tail_percent=0.0))
            cold, hot = background(rng), background(rng)
            hot[:20] += np.uint16(700)
            gain.process(rig(cold))
            start = gain.curve(LEFT)
            target_gain = AutomaticGain(AgcConfig(mode="linear", tail_percent=0.0))
            target_gain.process(rig(hot))
            target = target_gain.curve(LEFT)
            for k in range(8):
                gain.process(rig(hot, stamp_ns=k + 1))
            done = (gain.curve(LEFT) - start)[8050] / (target - start)[8050]
            assert done == pytest.approx(1 - (1 - damping / 256) ** 8, abs=0.01)


def test_damping_0_of_new_firmware_holds_the_first_curve(rng):
    gain = AutomaticGain(AgcConfig(damping=0))
    gain.process(rig(background(rng)))
    first = gain.curve(LEFT)
    image = background(rng)
    image[:60] += np.uint16(500)
    gain.process(rig(image, stamp_ns=1))
    np.testing.assert_array_equal(gain.curve(LEFT), first)


def test_both_eyes_share_one_mapping(rng):
    gain = AutomaticGain()
    left, right = background(rng), background(rng, offset=60.0)
    frame = gain.process(rig(left, right))
    common = np.intersect1d(left, right)
    assert len(common) > 50
    for count in common[::10]:
        levels = {*shown(frame)[left == count], *shown(frame, RIGHT)[right == count]}
        assert len(levels) == 1


def test_leaving_out_the_sky_gives_the_ground_more_contrast(rng):
    """Mouats et al. 2015, Fig. 7: cold sky above, the ground below."""
    image = background(rng)
    image[:48] = rng.integers(2000, 3500, (48, 160)).astype(np.uint16)
    ground = (slice(60, None), slice(None))
    spread = {}
    for name, config in {
        "all": AgcConfig(mode="linear"),
        "rectangle": AgcConfig(mode="linear", roi=(0.0, 0.4, 1.0, 1.0)),
        "polygon": AgcConfig(mode="linear", roi_polygon=(0.0, 0.4, 1.0, 0.4, 1.0, 1.0, 0.0, 1.0)),
    }.items():
        display = shown(AutomaticGain(config).process(rig(image)))
        spread[name] = np.ptp(np.percentile(display[ground], (2, 98)))
    assert spread["all"] < 20
    assert spread["rectangle"] > 200
    assert spread["polygon"] == pytest.approx(spread["rectangle"], abs=2)


def test_masked_pixels_do_not_count(rng):
    image = background(rng)
    mask = np.ones(image.shape, np.bool_)
    image[:, :30] = 0
    mask[:, :30] = False
    masked = AutomaticGain(AgcConfig(mode="linear", tail_percent=0.0))
    masked.process(rig(image, mask=mask))
    plain = AutomaticGain(AgcConfig(mode="linear", tail_percent=0.0))
    plain.process(rig(np.ascontiguousarray(image)[:, 30:]))
    np.testing.assert_allclose(masked.curve(LEFT), plain.curve(LEFT), atol=6.0)
    assert masked.curve(LEFT)[8030] < 20


def test_noise_of_a_bland_scene_is_not_blown_up(rng):
    noise = np.round(rng.normal(8000, 1.5, (120, 160))).astype(np.uint16)
    spread = {}
    for gain in (1.0, 4.0, 255.0):
        display = shown(AutomaticGain(AgcConfig(max_gain=gain)).process(rig(noise)))
        spread[gain] = display.std()
    assert 1.0 < spread[1.0] < 2.2
    assert 4.0 < spread[4.0] < 8.0
    assert spread[255.0] > 40


def test_the_mapping_holds_while_an_eye_is_blind(rng):
    gain = AutomaticGain(AgcConfig(damping=255))
    gain.process(rig(background(rng), background(rng)))
    before = gain.curve(LEFT)
    hot = background(rng)
    hot[:60] += np.uint16(700)
    for k in range(1, 10):
        frame = gain.process(rig(hot, stamp_ns=k, blind=(RIGHT,)))
        assert RIGHT not in frame.views
    np.testing.assert_array_equal(gain.curve(LEFT), before)
    gain.process(rig(hot, hot, stamp_ns=11))
    assert np.abs(gain.curve(LEFT) - before).max() > 20


def test_an_eye_that_stays_away_no_longer_holds_the_mapping(rng):
    gain = AutomaticGain(AgcConfig(damping=255))
    gain.process(rig(background(rng), background(rng)))
    before = gain.curve(LEFT)
    hot = background(rng)
    hot[:60] += np.uint16(700)
    for k in range(1, 95):
        gain.process(rig(hot, stamp_ns=k))
    assert np.abs(gain.curve(LEFT) - before).max() > 20


def test_a_correction_that_moves_the_counts_starts_the_mapping_anew(rng):
    gain = AutomaticGain(AgcConfig(damping=1))
    gain.process(rig(background(rng)))
    frame = gain.process(rig(background(rng, offset=90), stamp_ns=1, epoch=1))
    assert shown(frame).mean() == pytest.approx(127, abs=6)
    waiting = AutomaticGain(AgcConfig(damping=1))
    waiting.process(rig(background(rng)))
    frame = waiting.process(rig(background(rng, offset=90), stamp_ns=1))
    assert shown(frame).mean() > 180


def test_a_picture_all_white_under_the_old_mapping_is_not_waited_for(rng):
    gain = AutomaticGain(AgcConfig(damping=1))
    gain.process(rig(background(rng)))
    frame = gain.process(rig(background(rng, offset=3000), stamp_ns=1))
    assert 90 < shown(frame).mean() < 165


@pytest.mark.parametrize(("mode", "same"), [("auto", True), ("linear", False), ("plateau", False)])
def test_8_bit_images_pass_as_they_are_in_auto(rng, mode, same):
    image = rng.integers(90, 110, (120, 160)).astype(np.uint8)
    frame = AutomaticGain(AgcConfig(mode=mode)).process(rig(image))
    assert np.array_equal(shown(frame), image) is same


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("value", [0, 77, 255])
@pytest.mark.parametrize("mode", ["linear", "plateau"])
def test_constant_images_become_one_grey(dtype, value, mode):
    image = np.full((120, 160), value, dtype)
    display = shown(AutomaticGain(AgcConfig(mode=mode)).process(rig(image)))
    assert np.ptp(display) == 0
    assert 120 <= display[0, 0] <= 130


def test_nan_and_infinity_do_no_harm(rng):
    image = background(rng).astype(np.float32)
    clean = AutomaticGain(AgcConfig(tail_percent=1.0))
    clean.process(rig(image.copy()))
    image[5, :40], image[6, :10], image[7, :10] = np.nan, np.inf, -np.inf
    gain = AutomaticGain(AgcConfig(tail_percent=1.0))
    display = shown(gain.process(rig(image)))
    assert (display[5, :40] == 0).all()
    assert display[60].std() > 30
    np.testing.assert_allclose(gain.curve(LEFT), clean.curve(LEFT), atol=8.0)


def test_an_image_of_nothing_but_nan_keeps_the_mapping(rng):
    gain = AutomaticGain()
    lost = np.full((120, 160), np.nan, np.float32)
    assert np.ptp(shown(gain.process(rig(lost)))) == 0
    gain.process(rig(background(rng), stamp_ns=1))
    before = gain.curve(LEFT)
    gain.process(rig(lost, stamp_ns=2))
    np.testing.assert_array_equal(gain.curve(LEFT), before)


def test_bands_do_not_share_a_mapping(rng):
    views = {
        VISIBLE: CameraView(rng.integers(0, 4000, (120, 160)).astype(np.uint16), CAMERA),
        THERMAL: CameraView(background(rng), CAMERA),
    }
    gain = AutomaticGain()
    gain.process(RigFrame(0, views))
    assert gain.curve(THERMAL)[4000] < 1
    assert gain.curve(VISIBLE)[4000] > 254


def test_a_frame_without_views_passes(rng):
    frame = RigFrame(5, {}, {LEFT: GapReason.FFC, RIGHT: GapReason.FFC})
    assert AutomaticGain().process(frame) == frame


def test_nothing_but_the_display_changes(rng):
    frame = rig(background(rng), background(rng))
    seen = AutomaticGain().process(frame)
    for role, view in frame.views.items():
        assert seen.views[role].image is view.image
        assert view.display is None
        assert not seen.views[role].display.flags.writeable


def test_reset_forgets(rng):
    gain = AutomaticGain(AgcConfig(damping=0))
    gain.process(rig(background(rng)))
    gain.reset()
    assert gain.curve(LEFT) is None
    gain.process(rig(background(rng, offset=2000)))
    assert gain.curve(LEFT)[8100] < 1


@pytest.mark.parametrize("roi", [(0, 0, 1), (0.5, 0, 0.5, 1), (0, 0.9, 1, 0.4), (0, 0, 1, 1.2)])
def test_a_bad_rectangle_is_refused(roi):
    with pytest.raises(ConfigError, match=r"roi = .*left, top, right, bottom in fractions"):
        AutomaticGain(AgcConfig(roi=roi))


@pytest.mark.parametrize("polygon", [(0, 0, 1, 1), (0, 0, 1, 0, 1), (0, 0, 1, 0, 2, 2), ("a",) * 6])
def test_a_bad_polygon_is_refused(polygon):
    with pytest.raises(ConfigError, match=r"roi_polygon = .*three corners"):
        AutomaticGain(AgcConfig(roi_polygon=polygon))


def test_warm_up_leaves_no_mapping_behind():
    gain = AutomaticGain()
    gain.warm_up()
    assert gain.curve(LEFT) is None
