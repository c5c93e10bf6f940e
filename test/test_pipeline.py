"""The stages strung together: one composition for replay and for the onboard node."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import RigCalibration, RigCamera
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import (
    CalibrationError,
    DatasetError,
    FrameError,
    OutOfOrderError,
)
from thermal_stereo_vo.core.frames import GapReason, RadiometricFrame, RawFrame
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.odometry.factory import create_odometry
from thermal_stereo_vo.pipeline import Config, Pipeline
from thermal_stereo_vo.replay import replay
from thermal_stereo_vo.stereo.pairing import Pair

PERIOD_NS = 100_000_000
FRAMES = 8
CONFIG = with_overrides(Config(), ["odometry.window=0"])


class Recorder(Observer):
    """Keeps everything it hears."""

    wants_points = True

    def __init__(self):
        self.heard, self.frames, self.results, self.clouds, self.closed = [], [], [], {}, 0

    def on_rig_frame(self, frame):
        self.heard.append("frame")
        self.frames.append(frame)

    def on_result(self, result):
        self.heard.append("result")
        self.results.append(result)

    def on_points(self, stamp_ns, cloud):
        self.heard.append("points")
        self.clouds[stamp_ns] = cloud

    def close(self):
        self.closed += 1


@pytest.fixture(scope="module")
def raws(room):
    stamps = np.arange(FRAMES) * PERIOD_NS
    return list(room.raw_frames(stamps, room.path(FRAMES), np.random.default_rng(1)))


class Recording:
    """Frames in memory as a dataset."""

    name = "room"
    cameras = ("left", "right")

    def __init__(self, raws, calibration, fails_after=None):
        self._raws, self._calibration, self._fails_after = raws, calibration, fails_after

    def calibration(self):
        return self._calibration

    def frames(self):
        for i, raw in enumerate(self._raws):
            if i == self._fails_after:
                raise DatasetError("the disk is gone")
            yield raw

    def ground_truth(self):
        return None

    def instants(self):
        return len(self._raws) // 2


def push_all(pipeline, raws):
    results = []
    for raw in raws:
        results += pipeline.push(raw)
    return results + list(pipeline.flush())


def test_each_pair_gives_one_result_and_observers_hear_in_order(room, raws):
    recorder = Recorder()
    pipeline = Pipeline(CONFIG, room.calibration(), [recorder])
    results = push_all(pipeline, raws)
    assert [r.stamp_ns for r in results] == [i * PERIOD_NS for i in range(FRAMES)]
    assert results[-1].status is TrackingStatus.TRACKING
    assert recorder.results == results
    assert recorder.heard == ["frame", "result", "points"] * FRAMES
    assert recorder.clouds[results[-1].stamp_ns].xyz.shape[0] > 50
    assert recorder.closed == 0
    pipeline.close()
    assert recorder.closed == 1


def test_the_pipeline_adds_nothing_to_what_the_method_says(room, raws):
    """Replay, node and test run the same lines: the same numbers as the stages one by one."""
    recorder = Recorder()
    results = push_all(Pipeline(CONFIG, room.calibration(), [recorder]), raws)
    odometry = create_odometry(CONFIG.odometry)
    for frame, result in zip(recorder.frames, results, strict=True):
        again = odometry.process(frame)
        assert np.array_equal(again.T_world_rig, result.T_world_rig)
        assert np.array_equal(again.covariance, result.covariance)


def test_pairs_made_elsewhere_give_the_same_results(room, raws):
    pushed = push_all(Pipeline(CONFIG, room.calibration()), raws)
    pipeline = Pipeline(CONFIG, room.calibration())
    frames = [RadiometricFrame(r.image, r.stamp_ns, r.camera, r.sequence) for r in raws]
    paired = [pipeline.process(Pair(*frames[i : i + 2])) for i in range(0, len(frames), 2)]
    for a, b in zip(pushed, paired, strict=True):
        assert np.array_equal(a.T_world_rig, b.T_world_rig)


def test_observers_see_the_rectified_frame_with_its_8_bit_view(room, raws):
    """14-bit counts stay whole beside the view; one mapping serves both eyes."""
    recorder = Recorder()
    pipeline = Pipeline(CONFIG, room.calibration(), [recorder])
    for raw in raws[:4]:
        counts = raw.image.astype(np.uint16) * 12 + 6000
        list(pipeline.push(replace(raw, image=counts)))
    views = recorder.frames[-1].views
    for role, raw in (("left", raws[2]), ("right", raws[3])):
        assert views[role].image.dtype == np.uint16
        assert np.array_equal(views[role].image, raw.image.astype(np.uint16) * 12 + 6000)
        assert views[role].display.dtype == np.uint8
        assert views[role].display.std() > 20
    same_counts = [views[role].display[views[role].image == 7536] for role in ("left", "right")]
    assert len(set(np.concatenate(same_counts).tolist())) == 1


def test_a_camera_the_method_does_not_use_is_refused(room, raws):
    pipeline = Pipeline(CONFIG, room.calibration())
    with pytest.raises(
        FrameError, match="camera 'visible' is not one of left, right, which the method needs"
    ):
        list(pipeline.push(replace(raws[0], camera="visible")))


def test_stamps_that_go_back_are_refused_by_name(room, raws):
    pipeline = Pipeline(CONFIG, room.calibration())
    for raw in raws[:6]:
        list(pipeline.push(raw))
    with pytest.raises(OutOfOrderError, match=r"camera 'left'.*stamp"):
        list(pipeline.push(raws[2]))


def test_a_lone_eye_goes_on_when_the_source_ends(room, raws):
    """What waits for a partner is not lost silently: the frame says who is missing."""
    recorder = Recorder()
    pipeline = Pipeline(CONFIG, room.calibration(), [recorder])
    results = push_all(pipeline, raws[:7])
    assert len(results) == 4
    assert recorder.frames[-1].blind == {"right": GapReason.DROPPED}
    assert results[-1].stamp_ns == 3 * PERIOD_NS


def test_a_dropped_image_costs_one_measurement_and_no_more(room, raws):
    kept = [raw for i, raw in enumerate(raws) if i != 7]
    results = push_all(Pipeline(CONFIG, room.calibration()), kept)
    assert [r.status for r in results].count(TrackingStatus.GAP) == 1
    assert results[3].status is TrackingStatus.GAP
    assert results[-1].status is TrackingStatus.TRACKING
    truth = room.path(FRAMES)
    assert np.linalg.norm(results[-1].T_world_rig[:3, 3] - truth[-1][:3, 3]) < 0.08


def test_reset_goes_on_from_the_pose_at_any_stamp(room, raws):
    pipeline = Pipeline(CONFIG, room.calibration())
    first = push_all(pipeline, raws)
    T_start = exp_se3([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    pipeline.reset(T_start)
    second = push_all(pipeline, raws)
    assert second[0].stamp_ns == first[0].stamp_ns
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(b.T_world_rig, T_start @ a.T_world_rig, atol=1e-6)


def test_a_method_that_needs_other_cameras_is_refused_with_those_it_needs(room):
    eyes = room.calibration()
    bands = replace(eyes, cameras={"visible": eyes["left"], "thermal": eyes["right"]}, origin="x")
    with pytest.raises(
        CalibrationError, match="'feature' needs the cameras left and right, but x has visible, th"
    ):
        Pipeline(CONFIG, bands)


def test_a_rig_no_method_can_use_is_refused_before_any_frame(room):
    one_place = RigCalibration(
        {"left": RigCamera(room.camera), "right": RigCamera(room.camera)}, origin="rig.yaml"
    )
    with pytest.raises(CalibrationError, match=r"the baseline of rig.yaml is 0.000 mm"):
        Pipeline(CONFIG, one_place)


def test_a_recording_of_another_rig_is_refused_before_any_frame(room, raws):
    recording = Recording(raws, room.calibration())
    recording.cameras = ("visible", "thermal")
    recorder = Recorder()
    with pytest.raises(
        DatasetError, match="'room' has the cameras visible, thermal, but the method 'feature' need"
    ):
        replay(recording, room.calibration(), CONFIG, [recorder])
    assert recorder.heard == []
    assert recorder.closed == 1


def test_stage_times_are_told_once(room, raws):
    pipeline = Pipeline(CONFIG, room.calibration())
    for raw in raws[:2]:
        list(pipeline.push(raw))
    stages = pipeline.take_stage_ms()
    assert {"rectify", "agc"} <= set(stages)
    assert all(ms >= 0 for ms in stages.values())
    assert pipeline.take_stage_ms() == {}


# ------------------------------------------------------------------------------------------- replay


def test_replay_gives_all_results_their_times_and_progress(room, raws):
    recorder, steps = Recorder(), []
    replayed = replay(
        Recording(raws, room.calibration()), room.calibration(), CONFIG, [recorder],
        on_progress=lambda: steps.append(1),
    )  # fmt: skip
    assert len(replayed.results) == FRAMES == len(steps) == replayed.timing.frames
    assert list(replayed.results) == recorder.results
    assert recorder.closed == 1
    assert replayed.timing.wall_median_ms > 0
    assert {"rectify", "extract", "match", "motion"} <= set(replayed.timing.stages_ms)


def test_replay_closes_observers_when_the_recording_breaks_off(room, raws):
    recorder = Recorder()
    with pytest.raises(DatasetError, match="the disk is gone"):
        replay(
            Recording(raws, room.calibration(), fails_after=5),
            room.calibration(),
            CONFIG,
            [recorder],
        )
    assert recorder.closed == 1
    assert len(recorder.results) == 2


def test_replay_is_the_pipeline(room, raws):
    replayed = replay(Recording(raws, room.calibration()), room.calibration(), CONFIG)
    pushed = push_all(Pipeline(CONFIG, room.calibration()), raws)
    for a, b in zip(replayed.results, pushed, strict=True):
        assert np.array_equal(a.T_world_rig, b.T_world_rig)


def test_recordings_of_one_eye_only_end_without_a_pose_made_up(room, raws):
    lefts = [
        RawFrame(r.image, r.stamp_ns, r.camera, r.sequence) for r in raws if r.camera == "left"
    ]
    replayed = replay(Recording(lefts, room.calibration()), room.calibration(), CONFIG)
    assert len(replayed.results) == FRAMES
    assert {r.status for r in replayed.results} == {TrackingStatus.INITIALISING}
    assert all(np.array_equal(r.T_world_rig, np.eye(4)) for r in replayed.results)


NO_COMPILING = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
sys.path.insert(0, {tests!r})
from textured_room import TexturedRoom
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.pipeline import Config, Pipeline
from dataclasses import replace

room = TexturedRoom()
calibration = replace(room.calibration(), rectified=not {deep})
pipeline = Pipeline(with_overrides(Config(), ["odometry.window={window}"]), calibration)
pipeline.warm_up()

def refuse(self, signature):
    raise SystemExit(f"{{self.py_func.__name__}} is compiled during flight for {{signature}}")

Dispatcher.compile = refuse
path = room.path(6)
for raw in room.raw_frames(np.arange(6) * 100_000_000, path, np.random.default_rng(0)):
    if {deep}:
        raw = replace(raw, image=raw.image.astype(np.uint16) * 12 + 6000)
    for result in pipeline.push(raw):
        pass
assert result.status.value == "TRACKING", result
"""


@pytest.mark.parametrize("window", [0, 7])
@pytest.mark.parametrize("deep", [False, True], ids=["8 bit, rectified", "16 bit, raw"])
def test_warm_up_leaves_nothing_to_compile(window, deep):
    """A first frame that waits seconds for the compiler is a tracking failure in flight."""
    tests = Path(__file__).resolve().parent
    run = subprocess.run(
        [sys.executable, "-c", NO_COMPILING.format(tests=str(tests), window=window, deep=deep)],
        cwd=tests.parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=800,
    )
    assert run.returncode == 0, run.stderr
