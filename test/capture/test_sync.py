"""What a stamp difference between the eyes costs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.capture.image_motion import ImageMotion
from thermal_stereo_vo.capture.sync import SyncConfig, SyncMonitor

MS = 1_000_000
PERIOD_NS = 33_333_333


def scene(rng, contrast):
    blurred = cv2.GaussianBlur(rng.normal(size=(700, 1400)).astype(np.float32), (0, 0), 6)
    return 8000 + contrast * blurred / blurred.std()


@pytest.mark.parametrize("step", [0, 6, 20, 50])
@pytest.mark.parametrize("contrast", [10.0, 500.0])
def test_motion_is_measured_through_fixed_pattern_noise(rng, step, contrast):
    world, pattern = scene(rng, contrast), 5 * rng.normal(size=(512, 640))
    motion = ImageMotion()
    speeds = []
    for n in range(6):
        seen = world[n * step // 4 :, n * step :][:512, :640]
        noisy = seen + pattern + rng.normal(size=seen.shape)
        speeds.append(motion.update(noisy.astype(np.uint16), n * PERIOD_NS))
    assert speeds[0] is None
    truth_px_s = np.hypot(step, step / 4) * 30
    assert np.median([speed for speed in speeds if speed is not None]) == pytest.approx(
        truth_px_s, rel=0.1, abs=90.0
    )


def test_a_flat_picture_tells_no_motion(rng):
    motion = ImageMotion()
    flat = np.full((512, 640), 8000, np.uint16)
    assert [motion.update(flat, n * PERIOD_NS) for n in range(3)] == [None] * 3
    noise = [
        motion.update(rng.integers(7990, 8010, (512, 640)).astype(np.uint16), n * PERIOD_NS)
        for n in range(3, 6)
    ]
    assert noise == [None] * 3


def test_two_frames_out_of_some_are_enough(rng):
    world = scene(rng, 500.0).astype(np.uint16)
    motion = ImageMotion(every=4)
    speeds = [motion.update(world[:512, 40 * n :][:, :640], n * PERIOD_NS) for n in range(12)]
    assert [speed is not None for speed in speeds] == [False, True, False, False] * 3
    assert [speed for speed in speeds if speed] == pytest.approx([1200.0] * 3, rel=0.1)


def test_another_size_starts_anew(rng):
    motion = ImageMotion()
    world = scene(rng, 500.0).astype(np.uint16)
    motion.update(world[:512, :640], 0)
    assert motion.update(world[:480, :640], PERIOD_NS) is None
    assert motion.update(world[:480, :640], 2 * PERIOD_NS) == pytest.approx(0.0, abs=5.0)


def judge(skews_ms, motion_px_s, **config):
    monitor = SyncMonitor(SyncConfig(**config))
    for skew_ms in skews_ms:
        monitor.update(round(skew_ms * MS), motion_px_s)
    return monitor.report()


def test_free_running_cameras_are_judged_by_what_the_skew_costs():
    # 16.7 ms at 1 rad/s and 765 px focal length: 12.8 px of false disparity.
    report = judge([16.7] * 30, 765.0)
    assert report.displacement_px == pytest.approx(12.8, abs=0.05)
    assert "16.70 ms of skew make 12.8 px of false disparity" in report.warning
    assert "synchronise the cameras by hardware" in report.warning
    assert judge([-1.2] * 30, 765.0).warning == ""
    assert judge([-1.4] * 30, 765.0).warning != ""
    assert judge([16.7] * 30, 0.0).warning == ""


def test_cameras_on_a_pulse_are_judged_by_the_skew_itself():
    report = judge([3.0] * 30, 0.0, mode="hardware")
    assert "3.00 ms apart although they share a pulse: check the sync line" in report.warning
    jitter = judge([(-1) ** n * 4.0 for n in range(30)], 0.0, mode="hardware")
    assert jitter.warning == ""
    assert jitter.spread_ms == pytest.approx(8.0)
    assert judge([3.0] * 30, None, mode="free_running").warning == ""


def test_no_pairs_no_judgement():
    assert SyncMonitor(SyncConfig()).report().warning == ""
