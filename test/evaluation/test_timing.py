from __future__ import annotations

import time

import pytest

from thermal_stereo_vo.evaluation.timing import FrameTimer


def test_summary_of_known_times():
    timer = FrameTimer()
    for i in range(1, 101):
        stages = {"match": 2.0 * i} if i % 2 else {"match": 2.0 * i, "keyframe": 7.0}
        timer.add(float(i), 10.0 if i <= 25 else 20.0, stages)
    content = timer.summary().as_dict()
    assert content["frames"] == 100
    assert content["wall_ms_per_frame"]["median"] == 50.5
    assert content["wall_ms_per_frame"]["p95"] == pytest.approx(95.05)
    assert content["wall_ms_per_frame"]["max"] == 100.0
    assert content["cpu_ms_per_frame"] == 17.5
    # A stage that runs in half of the frames keeps its own median.
    assert content["stages_ms"] == {"match": 101.0, "keyframe": 7.0}


def test_frame_measures_wall_and_cpu_apart():
    timer = FrameTimer()
    with timer.frame() as stages_ms:
        time.sleep(0.05)
        stages_ms["sleep"] = 50.0
    summary = timer.summary()
    assert summary.frames == 1
    assert summary.wall_max_ms >= 49.0
    assert 0.0 <= summary.cpu_ms < summary.wall_max_ms
    assert summary.stages_ms == {"sleep": 50.0}


def test_frame_that_raises_is_not_counted():
    timer = FrameTimer()
    with pytest.raises(KeyError), timer.frame():
        raise KeyError
    assert timer.summary().frames == 0


def test_no_frames_have_no_times():
    content = FrameTimer().summary().as_dict()
    assert content["frames"] == 0
    assert content["wall_ms_per_frame"] == {"median": None, "p95": None, "max": None}
    assert content["cpu_ms_per_frame"] is None
