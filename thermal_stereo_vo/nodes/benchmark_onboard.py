"""Feeds the onboard node over DDS from another process, and measures it from outside.

python3 -m thermal_stereo_vo.nodes.benchmark_onboard --seconds 120 --rate 30
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from stereo_msgs.msg import DisparityImage

from thermal_stereo_vo.benchmarks.drawn_plane import drawn_frames, drawn_rig
from thermal_stereo_vo.benchmarks.machine import machine_line
from thermal_stereo_vo.benchmarks.recorded import record
from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import ThermalStereoError
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.nodes.stereo_input import EYES
from thermal_stereo_vo.nodes.transport import make_room_for_images
from thermal_stereo_vo.nodes.vitals import processor_s, resident_mb
from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

LATENCY_GOAL_MS = 60.0
SETTLING_S = 10.0
READY_S = 300.0
"""For a machine that compiles every kernel."""
LAST_ANSWER_S = 30.0
DOMAIN = 101
"""The last that is free on every system; the tests take those below."""
QOS = QoSProfile(depth=1000)
NODE = "thermal_stereo_vo.nodes.onboard_node"


class OnboardBenchmarkError(ThermalStereoError):
    """The node could not be measured."""


@dataclass(frozen=True)
class OnboardFigures:
    """What a run has shown.

    Latencies go from the stamp of an image, set when it was about to be sent, to the moment when
    its pose was received; ``of_node`` is the node's own view, up to the moment of publishing.
    Memory is resident; ``settled`` means after the first ``SETTLING_S`` (a third of a short run).
    """

    seconds: float
    rate_hz: float
    pairs_sent: int
    pairs_answered: int
    poses: int
    latency_ms: dict[str, float]
    cpu_percent: float
    cpu_ms_per_answer: float
    memory_mb_settled: float
    memory_mb_end: float
    memory_mb_most: float
    feeder_late_ms_most: float
    load: tuple[float, ...]
    of_node: dict[str, str] = field(default_factory=dict)

    def report(self) -> str:
        """For people."""
        keys = (
            "latency_ms_median",
            "latency_ms_p95",
            "latency_ms_max",
            "pairs_dropped",
            "dense_maps",
        )
        own = ", ".join(f"{key} {self.of_node[key]}" for key in keys if key in self.of_node)
        reached = self.latency_ms["p95"] <= LATENCY_GOAL_MS
        growth_mb = self.memory_mb_end - self.memory_mb_settled
        return "\n".join(
            [
                machine_line(),
                f"{self.pairs_sent} pairs at {self.rate_hz:g} Hz in {self.seconds:.1f} s, sent up "
                f"to {self.feeder_late_ms_most:.1f} ms late",
                f"answered  {self.pairs_answered} of {self.pairs_sent}, {self.poses} with a pose",
                f"latency   median {self.latency_ms['median']:.1f}, p95 "
                f"{self.latency_ms['p95']:.1f}, max {self.latency_ms['max']:.1f} ms to the "
                f"receiver; p95 of {LATENCY_GOAL_MS:g} ms {'reached' if reached else 'missed'}",
                f"  by the node itself: {own or 'not told'}",
                f"processor {self.cpu_percent:.0f} % of one core, {self.cpu_ms_per_answer:.1f} ms "
                "an answer, transport included",
                f"memory    {self.memory_mb_settled:.1f} MB when settled, {self.memory_mb_end:.1f} "
                f"at the end ({growth_mb:+.1f}), at most {self.memory_mb_most:.1f}",
            ]
        )


def benchmark_onboard(
    seconds: float,
    rate_hz: float,
    rig: RigCalibration,
    frames: Sequence[RawFrame],
    parameters: Sequence[str] = (),
    *,
    dense: bool = False,
) -> OnboardFigures:
    """Run the node for ``seconds`` on these frames, played forth and back.

    ``parameters`` are further ``name:=value`` texts for the node.  With ``dense`` somebody listens
    to its dense clouds.

    Raises OnboardBenchmarkError when the node ends or does not get ready.
    """
    pairs = round(seconds * rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "node.log"
        node = _start_node(log, [f"latency_window:={max(pairs, 1)}", *parameters])
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=DOMAIN)
        try:
            feeder = _Feeder(context, rig, frames, dense)
            feeder.wait_until_ready(node, log)
            return feeder.run(node, log, pairs, rate_hz)
        finally:
            rclpy.try_shutdown(context=context)
            node.send_signal(signal.SIGINT)
            node.wait()


def _start_node(log: Path, parameters: Sequence[str]) -> subprocess.Popen[bytes]:
    arguments = [text for parameter in parameters for text in ("-p", parameter)]
    with log.open("wb") as stream:
        return subprocess.Popen(
            [
                sys.executable,
                "-m",
                NODE,
                "--ros-args",
                *arguments,
            ],
            env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)},
            stdout=stream,
            stderr=subprocess.STDOUT,
        )


class _Feeder:
    """Cameras and autopilot in one: sends pairs, hears what comes back."""

    def __init__(
        self,
        context: rclpy.Context,
        rig: RigCalibration,
        frames: Sequence[RawFrame],
        dense: bool,
    ) -> None:
        self._node = rclpy.create_node(
            "feeder", context=context, start_parameter_services=False, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._infos = infos_from_calibration(with_rectification(rig, RectificationConfig())[0])
        self._pairs = list(_as_messages(frames))
        node = self._node
        self._images = {eye: node.create_publisher(Image, f"{eye}/image_raw", QOS) for eye in EYES}
        self._info_out = {
            eye: node.create_publisher(CameraInfo, f"{eye}/camera_info", QOS) for eye in EYES
        }
        self._sent: set[int] = set()
        self._answered: set[int] = set()
        self._latency_ms: dict[int, float] = {}
        self._of_node: dict[str, str] = {}
        self._late_ms = 0.0
        self._done = threading.Event()
        node.create_subscription(Odometry, "odom", self._on_odom, QOS)
        node.create_subscription(DiagnosticArray, "status", self._on_status, QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, QOS)
        if dense:
            for kind, topic in ((DisparityImage, "disparity"), (PointCloud2, "points2")):
                node.create_subscription(kind, topic, _let_pass, QOS, raw=True)

    def wait_until_ready(self, process: subprocess.Popen[bytes], log: Path) -> None:
        """Send the calibration until the node asks for images."""
        deadline_s = time.monotonic() + READY_S
        while any(out.get_subscription_count() == 0 for out in self._images.values()):
            for eye in EYES:
                self._info_out[eye].publish(
                    conversions.camera_info_to_msg(self._infos[eye], 0, f"{eye}_optical")
                )
            self._executor.spin_once(timeout_sec=0.2)
            _check_alive(process, log)
            if time.monotonic() > deadline_s:
                raise OnboardBenchmarkError(
                    f"the onboard node was not ready within {READY_S:.0f} s\n{log.read_text()}"
                )

    def run(
        self, process: subprocess.Popen[bytes], log: Path, pairs: int, rate_hz: float
    ) -> OnboardFigures:
        """Send ``pairs`` pairs at this rate and wait for the last answers."""
        sender = threading.Thread(target=self._send, args=(pairs, rate_hz), daemon=True)
        settling_s = min(SETTLING_S, pairs / rate_hz / 3)
        memory_mb: list[tuple[float, float]] = []
        start_s, start_cpu_s = time.monotonic(), processor_s(process.pid)
        sender.start()
        while not self._done.is_set():
            self._executor.spin_once(timeout_sec=0.05)
            now_s = time.monotonic() - start_s
            if not memory_mb or now_s - memory_mb[-1][0] > 0.5:
                _check_alive(process, log)
                memory_mb.append((now_s, resident_mb(process.pid)))
        seconds = time.monotonic() - start_s
        cpu_s = processor_s(process.pid) - start_cpu_s
        # Older pairs may have been dropped, the newest is answered.
        self._spin_while(lambda: max(self._sent) not in self._answered)
        self._of_node = {}
        self._spin_while(lambda: not self._of_node)
        memory_mb.append((seconds, resident_mb(process.pid)))
        if not self._latency_ms:
            raise OnboardBenchmarkError(f"the node gave no pose at all\n{log.read_text()}")
        latencies = np.array(list(self._latency_ms.values()))
        median, p95, most = np.percentile(latencies, [50, 95, 100])
        settled = [mb for at_s, mb in memory_mb if at_s >= settling_s]
        return OnboardFigures(
            seconds=seconds,
            rate_hz=rate_hz,
            pairs_sent=len(self._sent),
            pairs_answered=len(self._sent & self._answered),
            poses=len(self._latency_ms),
            latency_ms={"median": float(median), "p95": float(p95), "max": float(most)},
            cpu_percent=100.0 * cpu_s / seconds,
            cpu_ms_per_answer=1e3 * cpu_s / len(self._answered),
            memory_mb_settled=settled[0],
            memory_mb_end=settled[-1],
            memory_mb_most=max(settled),
            feeder_late_ms_most=self._late_ms,
            load=os.getloadavg(),
            of_node=self._of_node,
        )

    def _spin_while(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + LAST_ANSWER_S
        while condition() and time.monotonic() < deadline_s:
            self._executor.spin_once(timeout_sec=0.05)

    def _send(self, pairs: int, rate_hz: float) -> None:
        start_s = time.monotonic()
        for i, index in enumerate(itertools.islice(forth_and_back(len(self._pairs)), pairs)):
            due_s = start_s + i / rate_hz
            time.sleep(max(due_s - time.monotonic(), 0.0))
            self._late_ms = max(self._late_ms, (time.monotonic() - due_s) * 1e3)
            stamp_ns = time.time_ns()
            self._sent.add(stamp_ns)
            for eye, message in self._pairs[index].items():
                message.header.stamp = conversions.stamp_to_msg(stamp_ns)
                self._images[eye].publish(message)
        self._done.set()

    def _on_odom(self, message: Odometry) -> None:
        stamp_ns = conversions.stamp_from_msg(message.header.stamp)
        self._latency_ms[stamp_ns] = (time.time_ns() - stamp_ns) * 1e-6

    def _on_status(self, message: DiagnosticArray) -> None:
        self._answered.add(conversions.stamp_from_msg(message.header.stamp))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._of_node = {item.key: item.value for item in message.status[0].values}


def _let_pass(message: bytes) -> None:
    """A listener that costs nothing."""


def forth_and_back(count: int) -> Iterator[int]:
    """Endless indices without a jump and without a repetition.

    >>> list(itertools.islice(forth_and_back(3), 7))
    [0, 1, 2, 1, 0, 1, 2]
    """
    return itertools.cycle([*range(count), *range(count - 2, 0, -1)])


def _as_messages(frames: Sequence[RawFrame]) -> Iterator[dict[str, Image]]:
    """The pairs as messages that need only a stamp, so that sending costs little."""
    eyes = {eye: [frame for frame in frames if frame.camera == eye] for eye in EYES}
    for pair in zip(*eyes.values(), strict=False):
        yield {
            frame.camera: conversions.image_to_msg(frame.image, 0, f"{frame.camera}_optical")
            for frame in pair
        }


def _check_alive(process: subprocess.Popen[bytes], log: Path) -> None:
    if process.poll() is not None:
        raise OnboardBenchmarkError(
            f"the onboard node ended with {process.returncode}\n{log.read_text()}"
        )


def _images(source: str | None, pairs: int, rate_hz: float) -> tuple[RigCalibration, Any]:
    if source is None:
        rig = drawn_rig()
        rng = np.random.default_rng(5)
        return rig, list(drawn_frames(rig, pairs, round(1e9 / rate_hz), rng))
    recorded = record(open_dataset(source)[0], RectificationConfig(), pairs=pairs)
    return recorded.calibration, recorded.frames


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="benchmark_onboard",
        description="Feed the onboard node over DDS at a steady rate; report answers, latency, "
        "processor time and memory.",
    )
    parser.add_argument("--seconds", type=float, default=120.0, help="default 120")
    parser.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="default 30")
    parser.add_argument(
        "--source", help="recording to take images from (default: a drawn plane, 640x480, 14 bits)"
    )
    parser.add_argument(
        "--pairs", type=int, default=60, help="pairs held in memory, played forth and back"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="name:=value", help="parameter of the node"
    )
    parser.add_argument("--dense", action="store_true", help="listen to disparity and points2")
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures here as well")
    args = parser.parse_args(argv)
    if not (args.seconds > 0 and args.rate > 0 and args.pairs >= 3):
        parser.error("--seconds and --rate must be positive, --pairs at least 3")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    make_room_for_images()
    try:
        rig, frames = _images(args.source, args.pairs, args.rate)
        figures = benchmark_onboard(
            args.seconds, args.rate, rig, frames, args.set, dense=args.dense
        )
    except ThermalStereoError as error:
        print(f"benchmark_onboard: {error}", file=sys.stderr)
        return 2
    print(figures.report())
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(figures), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
