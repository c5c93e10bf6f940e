"""Recordings of a visible and a thermal camera, whose images differ in size and type."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE, Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.transforms import make_transform
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.outputs.dataset_bag import write_dataset

PERIOD_NS = 50_000_000
RIG = RigCalibration(
    {
        VISIBLE: RigCamera(Camera(64, 48, 60.0, 60.0, 31.5, 23.5)),
        THERMAL: RigCamera(
            Camera(40, 32, 50.0, 50.0, 19.5, 15.5), make_transform(np.eye(3), [0.1, 0.0, 0.0])
        ),
    }
)


class TwoBands:
    """A few random images in memory."""

    name, cameras = "two bands", (VISIBLE, THERMAL)

    def frames(self):
        rng = np.random.default_rng(8)
        for i in range(3):
            visible = rng.integers(0, 255, (48, 64)).astype(np.uint8)
            thermal = rng.integers(5000, 9000, (32, 40)).astype(np.uint16)
            yield RawFrame(visible, i * PERIOD_NS + 1, VISIBLE, i)
            yield RawFrame(thermal, i * PERIOD_NS + 1, THERMAL, i)

    def calibration(self):
        return RIG

    def ground_truth(self):
        return None

    def instants(self):
        return 3


def assert_the_same(dataset):
    assert dataset.cameras == (VISIBLE, THERMAL)
    for found, wanted in zip(dataset.frames(), TwoBands().frames(), strict=True):
        assert (found.camera, found.stamp_ns) == (wanted.camera, wanted.stamp_ns)
        assert found.image.dtype == wanted.image.dtype
        np.testing.assert_array_equal(found.image, wanted.image)
    calibration = dataset.calibration()
    assert calibration[THERMAL].camera == RIG[THERMAL].camera
    np.testing.assert_array_equal(calibration[THERMAL].T_rig_camera, RIG[THERMAL].T_rig_camera)


def test_a_bag_brings_both_bands_and_their_rig(tmp_path):
    write_dataset(TwoBands(), tmp_path / "bag")
    dataset, reason = open_dataset(tmp_path / "bag")
    assert "/visible/image_raw and /thermal/image_raw" in reason
    assert_the_same(dataset)


def test_a_bag_whose_images_change_size_is_cut_there(tmp_path):
    class Growing(TwoBands):
        def frames(self):
            yield from TwoBands().frames()
            yield RawFrame(np.zeros((48, 64), np.uint16), 9 * PERIOD_NS, THERMAL, 3)

    write_dataset(Growing(), tmp_path / "bag")
    with pytest.raises(DatasetError, match=r"thermal/image_raw is 64x48 .* began with 40x32"):
        list(open_dataset(tmp_path / "bag")[0].frames())


@pytest.mark.parametrize("rate_hz", [None, 20.0])
def test_two_folders_of_images_are_such_a_rig(tmp_path, rate_hz):
    for raw in TwoBands().frames():
        folder = tmp_path / raw.camera
        folder.mkdir(exist_ok=True)
        name = f"{raw.stamp_ns:016d}.png" if rate_hz is None else f"{raw.sequence:03d}.png"
        cv2.imwrite(str(folder / name), raw.image)
    save_calibration(RIG, tmp_path)
    dataset, reason = open_dataset(tmp_path, SourceOptions(rate_hz=rate_hz))
    assert reason == "pair of image folders: it has visible and thermal"
    if rate_hz is None:
        assert_the_same(dataset)
    else:
        assert [f.stamp_ns for f in dataset.frames() if f.camera == THERMAL] == [
            0,
            50_000_000,
            100_000_000,
        ]
