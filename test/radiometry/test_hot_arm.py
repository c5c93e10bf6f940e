"""Mouats et al. 2015, Fig. 8, on the simulated flight with a pilot's arm before the cameras."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain

RATE_HZ = 5.0
SETTINGS = ("render.scale=0.2", "render.workers=0", "render.lag=none", "duration_s=7")


@pytest.fixture(scope="module")
def counts():
    """(N, 96, 128) what the left camera sees in 7 s; the arm is there from 3 s to 5 s."""
    dataset = open_simulated("hot_arm", SourceOptions(rate_hz=RATE_HZ, overrides=SETTINGS))
    camera = dataset.calibration()["left"].camera
    return camera, np.array([f.image for f in dataset.frames() if f.camera == "left"])


def road(counts, damping: int) -> np.ndarray:
    """(N,) mean grey level of the road below the arm, less that before the arm came."""
    camera, images = counts
    gain = AutomaticGain(AgcConfig(damping=damping))
    levels = []
    for i, image in enumerate(images):
        frame = gain.process(RigFrame(i, {"left": CameraView(image, camera)}))
        display = frame.views["left"].display
        assert display is not None
        levels.append(display[80:94, 50:80].mean())
    return np.array(levels) - np.mean(levels[5:15])


def at(seconds: float) -> int:
    return round(seconds * RATE_HZ)


def test_the_arm_is_hot_and_hides_no_road(counts):
    _, images = counts
    arm = images[at(4.0), 40:70].astype(float) - images[at(2.4), 40:70]
    assert np.percentile(arm, 80) > 500
    beside = images[at(4.0), 80:94, 50:80].astype(float) - images[at(2.4), 80:94, 50:80]
    assert abs(beside.mean()) < 10


def test_at_damping_1_the_arm_has_virtually_no_impact(counts):
    change = road(counts, 1)
    assert np.abs(change[at(3.2) : at(4.8)]).max() < 4.0
    assert np.abs(change[at(5.4) :]).max() < 6.0


def test_at_damping_100_the_picture_darkens_at_once_and_comes_back(counts):
    change = road(counts, 100)
    assert change[at(4.6)] < -30.0
    assert change[at(3.6)] < 0.6 * change[at(4.6)]
    assert np.abs(change[-3:]).max() < 10.0
