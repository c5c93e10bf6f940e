"""A room of known walls, flown through with known poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import default_T_base_rig
from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.radiometry.thermometer import Thermometer, ThermometerConfig
from thermal_stereo_vo.reconstruction.reconstructor import ModelConfig, Reconstructor, in_axes
from thermal_stereo_vo.stereo.dense import DenseConfig

DENSE = DenseConfig(disparities=64)
CONFIG = ModelConfig(keyframe_m=0.25, max_range_m=12.0)


def wall_distance_m(room, xyz):
    """(N,) distance of points to the nearest wall of the box."""
    return np.min(np.abs(np.stack([xyz - room.low, xyz - room.high])), axis=(0, 2))


def fly(room, reconstructor, frames=9, statuses=None):
    rng = np.random.default_rng(1)
    for k, T in enumerate(room.path(frames, step=(0.1, 0.0, 0.12, 0.0, 0.02, 0.0))):
        status = TrackingStatus.TRACKING if statuses is None else statuses[k]
        pose = None if status is TrackingStatus.LOST else T
        reconstructor.on_rig_frame(room.rig_frame(k, T, rng))
        reconstructor.on_result(OdometryResult(k, status, pose, None))
    return reconstructor


@pytest.fixture(scope="module")
def flown(room):
    thermometer = Thermometer(ThermometerConfig(planck_r=5000.0))
    return fly(room, Reconstructor(DENSE, CONFIG, thermometer))


def test_the_model_is_where_the_walls_are(room, flown):
    model = flown.model()
    off_m = wall_distance_m(room, model.cloud.xyz)
    assert len(off_m) > 3000
    assert np.median(off_m) < 0.05
    assert np.percentile(off_m, 90) < 0.25
    assert np.ptp(model.cloud.xyz[:, 0]) > 8.0  # both side walls
    assert np.all(np.isfinite(model.cloud.temperature_kelvin))


def test_keyframes_are_apart(flown):
    # 1.2 m flown in steps of 16 cm, a keyframe every 25 cm: every other frame.
    assert flown.keyframes == 5
    assert flown.measured_points > 50_000
    assert flown.sample.density > 0.5


def test_only_tracked_frames_with_two_eyes_enter(room):
    tracked, lost, gap = TrackingStatus.TRACKING, TrackingStatus.LOST, TrackingStatus.GAP
    statuses = [lost, gap, tracked, gap, gap, lost, TrackingStatus.DEGRADED, lost, gap]
    assert fly(room, Reconstructor(DENSE, CONFIG), statuses=statuses).keyframes == 1
    blind = Reconstructor(DENSE, CONFIG)
    whole = room.rig_frame(0, np.eye(4))
    blind.on_rig_frame(RigFrame(0, {"left": whole.views["left"]}))
    blind.on_result(OdometryResult(0, tracked, np.eye(4), None))
    assert (blind.keyframes, len(blind.model().cloud.xyz)) == (0, 0)


def test_the_range_is_limited(room):
    near = fly(room, Reconstructor(DENSE, replace(CONFIG, max_range_m=6.0)), frames=3)
    assert 4.0 < near.model().cloud.xyz[:, 2].max() < 7.0


def test_axes_change_the_points_and_nothing_else(flown):
    model = flown.model()
    turned = in_axes(default_T_base_rig(), model)
    np.testing.assert_allclose(turned.cloud.xyz[:, 0], model.cloud.xyz[:, 2], atol=1e-5)
    np.testing.assert_allclose(turned.cloud.xyz[:, 2], -model.cloud.xyz[:, 1], atol=1e-5)
    np.testing.assert_array_equal(turned.cloud.intensity, model.cloud.intensity)
    np.testing.assert_array_equal(turned.count, model.count)
