from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.calibration.radiometric import FlatFrame, fit_flat_field
from thermal_stereo_vo.core.config import dump_yaml, load_yaml
from thermal_stereo_vo.core.errors import CalibrationError, ConfigError, FrameError
from thermal_stereo_vo.core.frames import GapReason, Telemetry
from thermal_stereo_vo.radiometry.flat_field import FlatFieldConfig
from thermal_stereo_vo.radiometry.flat_field_file import save_flat_field
from thermal_stereo_vo.radiometry.front_end import FrontEndConfig, ThermalFrontEnd, warm_up
from thermal_stereo_vo.radiometry.gate import GateConfig, GateState
from thermal_stereo_vo.radiometry.scene_based import SceneBasedConfig

WARM = Telemetry(fpa_temperature_kelvin=302.0)


@pytest.fixture
def folder(tmp_path: Path, sensor) -> Path:
    frames = [
        FlatFrame(sensor.see(level, fpa), fpa, level)
        for fpa in (280.0, 290.0, 300.0, 310.0, 320.0)
        for level in (7000.0, 9000.0)
    ]
    for camera, serial in (("left", "42"), ("right", "43")):
        calibration = fit_flat_field(frames, serial=serial, camera=camera)
        save_flat_field(tmp_path / f"flat_{camera}.npz", calibration)
    return tmp_path


def with_flat_field(folder: Path, **more: object) -> FrontEndConfig:
    return FrontEndConfig(flat_field=FlatFieldConfig(file=f"{folder}/flat_{{camera}}.npz", **more))


def test_by_default_good_frames_pass_untouched(small_scene, as_raw):
    front_end = ThermalFrontEnd(FrontEndConfig(), "left")
    for k in range(10):
        raw = as_raw(small_scene.view(3 * k), k, telemetry=WARM)
        frame = front_end.process(raw)
        assert frame.image is raw.image
        assert (frame.stamp_ns, frame.camera, frame.sequence) == (raw.stamp_ns, "left", k)
        assert frame.telemetry is WARM
        assert (frame.epoch, frame.gap, frame.mask) == (0, None, None)
    assert front_end.flat_field_status is None


def test_a_blind_camera_goes_on_without_image_and_tells_its_gap_after(small_scene, as_raw):
    events = []
    front_end = ThermalFrontEnd(FrontEndConfig(), "left", events.append)
    images = [small_scene.view(3 * k) for k in range(50)]
    images[20:35] = [images[19]] * 15
    frames = [front_end.process(as_raw(image, k)) for k, image in enumerate(images)]
    assert [k for k, frame in enumerate(frames) if frame.image is None] == list(range(20, 35))
    assert [frame.sequence for frame in frames] == list(range(50))
    assert {frame.blind for frame in frames[20:35]} == {GapReason.FROZEN}
    assert {frame.blind for frame in (*frames[:20], *frames[35:])} == {None}
    assert frames[35].gap.reason is GapReason.FFC
    assert [frame.epoch for frame in frames] == [0] * 35 + [1] * 15
    assert front_end.decision.state is GateState.TRACKING
    assert len(events) == 1


def test_repeats_of_a_slow_core_are_left_out(small_scene, as_raw):
    front_end = ThermalFrontEnd(FrontEndConfig(), "left")
    views = [small_scene.view(9 * k) for k in range(20)]
    frames = [front_end.process(as_raw(views[k // 3], k)) for k in range(60)]
    assert [k for k, frame in enumerate(frames) if frame is not None] == list(range(0, 60, 3))


def test_the_stored_flat_field_of_each_camera_is_applied(small_scene, sensor, as_raw, folder):
    for camera in ("left", "right"):
        front_end = ThermalFrontEnd(with_flat_field(folder), camera)
        truth = small_scene.clean(50)
        raw = as_raw(sensor.see(truth, 302.0).round().astype(np.uint16), 0, telemetry=WARM)
        frame = front_end.process(raw)
        assert frame.image.dtype == np.uint16
        assert np.std((frame.image - truth)[~sensor.dead]) < 0.7
        assert front_end.flat_field_status.ok


def test_scene_based_refinement_takes_the_rest(scene, rng, as_raw):
    config = FrontEndConfig(scene_based=SceneBasedConfig(enabled=True))
    front_end = ThermalFrontEnd(config, "left")
    stripes = 8.0 * rng.standard_normal(scene.shape[1])[None, :] * np.ones((scene.shape[0], 1))
    for k in range(150):
        clean = scene.clean(4 * k)
        frame = front_end.process(as_raw(scene.noisy(clean + stripes), k))
    left = (frame.image - clean).mean(axis=0)
    assert np.std(left - left.mean()) < 0.5 * np.std(stripes)


def test_after_a_correction_nothing_is_learnt_until_it_has_settled(scene, as_raw):
    config = FrontEndConfig(
        gate=GateConfig(settle_frames=5), scene_based=SceneBasedConfig(enabled=True)
    )
    front_end = ThermalFrontEnd(config, "left")
    images = [scene.view(8 * k) for k in range(60)]
    images[20:35] = [images[19]] * 15
    views = []
    for k, image in enumerate(images):
        front_end.process(as_raw(image, k))
        views.append(front_end._scene_based.views)
    assert views[19] > 0
    assert views[39] == 0 or views[39] == views[34]
    assert views[59] > views[39]


def test_the_settings_travel_through_yaml(folder):
    config = with_flat_field(folder, serials=("left=42", "right=43"))
    assert load_yaml(FrontEndConfig, dump_yaml(config), origin="test") == config


class TestWrongUse:
    def test_left_and_right_exchanged(self, folder):
        (folder / "flat_left.npz").replace(folder / "spare.npz")
        (folder / "flat_right.npz").replace(folder / "flat_left.npz")
        with pytest.raises(CalibrationError, match="made for camera 'right', not for 'left'"):
            ThermalFrontEnd(with_flat_field(folder), "left")

    def test_another_serial(self, folder):
        config = with_flat_field(folder, serials=("left=99",))
        with pytest.raises(CalibrationError, match="serial 42, but camera 'left' has serial 99"):
            ThermalFrontEnd(config, "left")

    @pytest.mark.parametrize("entry", ["42", "left=", "=42"])
    def test_serials_without_camera(self, entry):
        config = FrontEndConfig(flat_field=FlatFieldConfig(serials=(entry,)))
        with pytest.raises(ConfigError, match=r"flat_field.serials holds .*write camera=serial"):
            ThermalFrontEnd(config, "left")

    @pytest.mark.parametrize("file", ["flat_{side}.npz", "flat_{}.npz", "flat_{camera"])
    def test_a_name_with_unknown_braces(self, file):
        config = FrontEndConfig(flat_field=FlatFieldConfig(file=file))
        with pytest.raises(ConfigError, match=r"only \{camera\} may stand in braces"):
            ThermalFrontEnd(config, "left")

    def test_a_missing_file(self, tmp_path):
        with pytest.raises(CalibrationError, match="there is no flat field"):
            ThermalFrontEnd(with_flat_field(tmp_path), "left")

    def test_an_image_size_the_flat_field_does_not_have(self, folder, as_raw):
        front_end = ThermalFrontEnd(with_flat_field(folder), "left")
        image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
        with pytest.raises(FrameError, match="64x48 images but its flat field is 128x96"):
            front_end.process(as_raw(image, 0, telemetry=WARM))


def test_reset_starts_again_at_any_stamp(small_scene, as_raw):
    front_end = ThermalFrontEnd(FrontEndConfig(), "left")
    front_end.process(as_raw(small_scene.view(0), 50))
    front_end.reset()
    assert front_end.process(as_raw(small_scene.view(3), 1)).image is not None


def test_warm_up_runs():
    warm_up()
