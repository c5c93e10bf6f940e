"""What all nodes share: the worker, stamps, silent inputs, starting and ending."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from thermal_stereo_vo.nodes import rectification_node, replay_node, stereo_odometry_node
from thermal_stereo_vo.nodes.runtime import InputWatch, StampGuard, StampOrder, Worker, help_text

NODES = {
    "rectification_node": (rectification_node, rectification_node.RectificationNode),
    "stereo_odometry_node": (stereo_odometry_node, stereo_odometry_node.StereoOdometryNode),
    "replay_node": (replay_node, replay_node.ReplayNode),
}


class Recorder:
    """Jobs that note their number; the first one waits until it is let go."""

    def __init__(self) -> None:
        self.done: list[int] = []
        self.errors: list[BaseException] = []
        self.go = threading.Event()
        self.started = threading.Event()
        self.finished = threading.Event()

    def job(self, number: int, *, last: bool = False):
        def work() -> None:
            self.started.set()
            assert self.go.wait(600)
            self.done.append(number)
            if last:
                self.finished.set()

        return work

    def run(self, worker: Worker, jobs: list[tuple[int, bool]]) -> None:
        worker.submit(self.job(0), frame=True)
        assert self.started.wait(600)
        for number, frame in jobs:
            worker.submit(self.job(number), frame=frame)
        worker.submit(self.job(99, last=True))
        self.go.set()
        assert self.finished.wait(600)
        worker.close()


def test_worker_does_every_job_in_order() -> None:
    recorder = Recorder()
    worker = Worker(newest_only=False, on_error=recorder.errors.append)
    recorder.run(worker, [(1, True), (2, False), (3, True), (4, True)])
    assert recorder.done == [0, 1, 2, 3, 4, 99]
    assert worker.dropped == 0
    assert recorder.errors == []


def test_newest_frame_wins_and_the_dropped_are_counted() -> None:
    recorder = Recorder()
    worker = Worker(newest_only=True, on_error=recorder.errors.append)
    recorder.run(worker, [(1, True), (2, False), (3, True), (4, True)])
    assert recorder.done == [0, 2, 4, 99]
    assert worker.dropped == 2


def test_an_error_in_a_job_reaches_the_node() -> None:
    arrived = threading.Event()
    errors: list[BaseException] = []

    def on_error(error: BaseException) -> None:
        errors.append(error)
        arrived.set()

    worker = Worker(newest_only=False, on_error=on_error)
    worker.submit(lambda: 1 // 0)
    assert arrived.wait(600)
    worker.close()
    assert isinstance(errors[0], ZeroDivisionError)


def test_stamps_are_judged_stream_by_stream() -> None:
    guard = StampGuard()
    assert guard.check("left", 100) is StampOrder.NEXT
    assert guard.check("right", 90) is StampOrder.NEXT
    assert guard.check("left", 100) is StampOrder.REPEATED
    assert guard.check("left", 101) is StampOrder.NEXT
    assert guard.check("left", 50) is StampOrder.BACK
    # The other stream may start again as well, which is no second jump.
    assert guard.check("right", 50) is StampOrder.NEXT
    assert guard.check("right", 49) is StampOrder.BACK
    guard.forget()
    assert guard.check("right", 1) is StampOrder.NEXT


class Graph:
    """The two questions that the watch asks of a node."""

    def __init__(self, publishers: dict[str, int]) -> None:
        self._publishers = publishers

    def resolve_topic_name(self, topic: str) -> str:
        return topic if topic.startswith("/") else f"/front/{topic}"

    def count_publishers(self, topic: str) -> int:
        return self._publishers[topic]


def test_silence_is_told_after_five_seconds_with_its_topics() -> None:
    now_s = [100.0]
    graph = Graph({"/front/left/image_raw": 1, "/front/right/image_raw": 0})
    watch = InputWatch(graph, ["left/image_raw", "right/image_raw"], lambda: now_s[0])
    now_s[0] = 104.9
    assert watch.complaint() is None
    now_s[0] = 105.0
    assert watch.complaint() == (
        "no data yet: waiting for /front/left/image_raw (1 publisher), /front/right/image_raw "
        "(0 publishers); check the topic names, the quality of service and the sender with "
        "'ros2 topic hz /front/left/image_raw'"
    )
    watch.saw("left/image_raw")
    complaint = watch.complaint()
    assert complaint is not None
    assert complaint.startswith("input is missing: waiting for /front/right/image_raw (0 publ")
    watch.saw("right/image_raw")
    assert watch.complaint() is None
    now_s[0] = 111.0
    complaint = watch.complaint()
    assert complaint is not None
    assert complaint.startswith("input is missing: waiting for /front/left/image_raw (1 publ")


@pytest.mark.parametrize("name", NODES)
def test_help_names_topics_and_parameters(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, node_type = NODES[name]
    assert module.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.rstrip() == help_text(node_type)
    assert f"ros2 run thermal_stereo_vo {name} --ros-args" in text
    for live in node_type.LIVE:
        assert f" *{live} = " in text


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["extra"], "unknown argument 'extra': settings are given as --ros-args -p name:=value"),
        (["--ros-args", "-p", "raet:=2.0"], "unknown setting 'raet': did you mean 'rate'?"),
        (["--ros-args", "-p", "rate:=-1.0"], "rate = -1 is out of range"),
        (["--ros-args"], "no recording to play: give one with -p source:=PATH"),
        (["--ros-args", "-p", "source:=/no/such"], "there is no recording /no/such"),
        (["--ros-args", "--params-file", "/no/such.yaml"], "/no/such.yaml"),
    ],
)
def test_wrong_use_ends_with_one_line_and_code_2(
    arguments: list[str],
    complaint: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path,
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    assert replay_node.main(["replay_node", *arguments]) == 2
    error = capfd.readouterr().err.strip()
    assert error.startswith("replay_node: ")
    assert complaint in error
    assert "\n" not in error


NODE = """
import sys, threading
from dataclasses import dataclass
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.nodes import runtime

@dataclass(frozen=True)
class NoSettings:
    count: int = setting(1, "Nothing.")

class Stubborn(runtime.BaseNode[NoSettings]):
    NAME, CONFIG, TOPICS = "stubborn", NoSettings, ""

    def __init__(self):
        super().__init__()
        {begin}

    def close(self):
        {end}
        print("closed", flush=True)

runtime.stop_signals.__wrapped__.__defaults__ = ({limit_s},)
sys.exit(runtime.run(Stubborn, ["stubborn"]))
"""
SAY_SO = "print('begun', flush=True)"


@pytest.mark.parametrize(
    ("begin", "end", "limit_s", "output", "error"),
    [
        pytest.param(SAY_SO, "pass", 600, "closed\n", "", id="waits"),
        pytest.param(
            f"{SAY_SO}; sys.stdin.readline()", "pass", 600, "closed\n", "", id="still begins"
        ),
        pytest.param(
            f"{SAY_SO}; threading.Event().wait()", "pass", 0.5, "", "still busy", id="never begins"
        ),
        pytest.param(SAY_SO, "threading.Event().wait()", 0.5, "", "still busy", id="never closes"),
        pytest.param(
            f"{SAY_SO}; self.context.try_shutdown()", "pass", 600, "closed\n", "", id="by itself"
        ),
    ],
)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_ends_a_node_with_code_0_whatever_it_does(
    tmp_path, begin: str, end: str, limit_s: float, output: str, error: str, number: int
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", NODE.format(begin=begin, end=end, limit_s=limit_s)],
        cwd=Path(__file__).resolve().parents[2],
        env={**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_LOG_DIR": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,  # nothing after the line is read with it
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"begun\n"
    process.send_signal(number)
    said, complaint = (text.decode() for text in process.communicate(b"go on\n", timeout=600))
    assert (process.returncode, said) == (0, output), complaint
    assert complaint.startswith(error)
    assert bool(complaint) == bool(error)
