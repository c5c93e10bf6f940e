"""Frames are what they say, and nobody can change them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import (
    CalibrationError,
    CaptureError,
    ConfigError,
    DatasetError,
    EvaluationError,
    FrameError,
    OutOfOrderError,
    SimulationError,
    ThermalStereoError,
)
from thermal_stereo_vo.core.frames import (
    CameraView,
    Gap,
    GapReason,
    RadiometricFrame,
    RawFrame,
    RigFrame,
)
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats

CAMERA = Camera(4, 3, 5.0, 5.0, 2.0, 1.5)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((3, 4, 3), np.uint8),
        np.zeros((3, 4), np.float32),
        np.zeros((3, 4), np.int16),
        np.zeros(12, np.uint16),
        np.zeros((3, 4, 1), np.uint16),
    ],
    ids=["colour", "float", "signed", "flat", "one channel but 3-D"],
)
def test_raw_frame_refuses_other_images(image):
    with pytest.raises(
        FrameError,
        match=r"camera 'left' gave an image of shape .* and type .*: "
        "give a single-channel 8- or 16-bit image",
    ):
        RawFrame(image, 0, "left")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_raw_frame_keeps_counts_and_freezes_them(dtype):
    image = np.arange(12, dtype=dtype).reshape(3, 4)
    frame = RawFrame(image, 5, "left", 7)
    assert frame.image.dtype == dtype
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        frame.stamp_ns = 6


def test_every_array_of_a_frame_is_read_only():
    mask = np.ones((3, 4), bool)
    radiometric = RadiometricFrame(np.zeros((3, 4), np.uint16), 0, "left", mask=mask)
    view = CameraView(
        np.zeros((3, 4), np.uint16),
        CAMERA,
        mask=np.ones((3, 4), bool),
        display=np.zeros((3, 4), np.uint8),
    )
    arrays = [radiometric.image, radiometric.mask, view.image, view.mask, view.display]
    assert not any(array.flags.writeable for array in [*arrays, view.T_rig_camera])


def test_a_blind_frame_has_no_image_but_goes_on_in_time():
    gap = Gap(500_000_000, GapReason.FFC, epoch_changed=True)
    frame = RadiometricFrame(None, 12, "left", sequence=3, gap=gap)
    assert frame.image is None
    assert (frame.stamp_ns, frame.sequence, frame.gap.reason) == (12, 3, GapReason.FFC)


def test_views_do_not_share_their_default_pose():
    image = np.zeros((3, 4), np.uint8)
    a, b = CameraView(image, CAMERA), CameraView(image, CAMERA)
    assert a.T_rig_camera is not b.T_rig_camera
    assert RigFrame(0, {}).blind is not RigFrame(0, {}).blind


def test_result_defaults_claim_nothing():
    result = OdometryResult(0, TrackingStatus.LOST, None, None)
    assert result.twist is None
    assert result.twist_covariance is None
    assert result.stats == TrackStats()
    assert result.reset_counter == 0


def test_stage_times_do_not_make_results_unequal():
    assert TrackStats(features=3, stage_ms={"a": 1.0}) == TrackStats(
        features=3, stage_ms={"a": 2.0}
    )
    assert TrackStats(features=3) != TrackStats(features=4)


def test_empty_cloud():
    cloud = PointCloud.empty()
    assert cloud.xyz.shape == (0, 3)
    assert cloud.xyz.dtype == cloud.intensity.dtype == np.float32
    assert cloud.temperature_kelvin is None


def test_every_error_is_one_family():
    """The command line turns this family, and nothing else, into exit code 2."""
    for error in (
        ConfigError, CalibrationError, DatasetError, FrameError, OutOfOrderError,
        EvaluationError, CaptureError, SimulationError,
    ):  # fmt: skip
        assert issubclass(error, ThermalStereoError)
    assert issubclass(OutOfOrderError, FrameError)
    assert not issubclass(ThermalStereoError, ValueError)
