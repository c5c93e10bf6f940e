"""The drawn plane is what it says: a rig that moves by its step before a plane."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.benchmarks.drawn_plane import STEP, drawn_frames, drawn_rig
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.pipeline import Config, Pipeline
from thermal_stereo_vo.stereo.pairing import Pair


def test_the_odometry_finds_the_step() -> None:
    rig = drawn_rig(320, 240)
    frames = list(drawn_frames(rig, 6, 50_000_000, np.random.default_rng(2)))
    assert [frame.camera for frame in frames[:4]] == ["left", "right", "left", "right"]
    assert frames[0].image.shape == (240, 320)
    assert frames[0].image.dtype == np.uint16
    pipeline = Pipeline(Config(), rig)
    pairs = [Pair(left, right) for left, right in zip(frames[::2], frames[1::2], strict=True)]
    results = [pipeline.push_pair(pair) for pair in pairs]
    pipeline.close()
    statuses = [result.status for result in results if result is not None]
    assert statuses == [TrackingStatus.INITIALISING] + 5 * [TrackingStatus.TRACKING]
    # Results are of the rectified left camera, which is turned against the raw one.
    T_rig_rectified = pipeline.rectifier.T_rig_rectified
    T = T_rig_rectified @ results[-1].T_world_rig @ inverse(T_rig_rectified)
    np.testing.assert_allclose(T, np.linalg.matrix_power(exp_se3(STEP), 5), atol=0.006)


def test_the_same_seed_draws_the_same() -> None:
    rig = drawn_rig(64, 48)

    def images(seed: int) -> np.ndarray:
        frames = drawn_frames(rig, 2, 1, np.random.default_rng(seed))
        return np.array([frame.image for frame in frames])

    np.testing.assert_array_equal(images(1), images(1))
    assert np.any(images(1) != images(2))
    assert np.any(images(1)[0] != images(1)[2])
