"""What every node needs around its core object: start and stop, work off the callbacks, health."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import textwrap
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from types import FrameType
from typing import Any, ClassVar, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from thermal_stereo_vo.core.config import describe, settings_of
from thermal_stereo_vo.core.errors import ThermalStereoError
from thermal_stereo_vo.nodes.conversions import diagnostics_to_msg
from thermal_stereo_vo.nodes.parameters import Parameters
from thermal_stereo_vo.nodes.transport import make_room_for_images
from thermal_stereo_vo.outputs.ros_fields import ERROR, WARN, DiagnosticFields
from thermal_stereo_vo.pipeline import Config as PipelineConfig

Config = TypeVar("Config")

NO_DATA_AFTER_S = 5.0
STOP_CHECK_S = 0.2
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
STOP_LIMIT_S = 8.0
"""``ros2 launch`` kills a process ten seconds after Ctrl-C."""

RELIABLE = QoSProfile(depth=10)
"""``/odom``, ``status``, camera_info: every message, in order."""
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Who comes late still receives the last ones."""
IMAGES_OUT = QoSProfile(depth=5)
"""Reliable, so that both kinds of subscription connect."""
IMAGES_NEWEST = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
IMAGES_NEWEST_RELIABLE = QoSProfile(depth=5)
PATIENT = 50
"""Images of one eye that may wait for the other where none may be lost."""
IMAGES_ALL = QoSProfile(depth=PATIENT)


def steady_clock() -> Clock:
    """Runs on while a simulated clock stands still."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def overridable() -> QoSOverridingOptions:
    """Let ``qos_overrides.<topic>...`` parameters change history, depth and reliability."""
    return QoSOverridingOptions.with_default_policies()


class Worker:
    """A thread that does jobs in order, so that callbacks stay short.

    With ``newest_only`` a frame job that has not begun is thrown away when a newer one comes;
    ``dropped`` counts them.  Other jobs are always done.
    """

    def __init__(self, *, newest_only: bool, on_error: Callable[[BaseException], None]) -> None:
        self.dropped = 0
        self._newest_only = newest_only
        self._on_error = on_error
        self._jobs: deque[tuple[Callable[[], None], bool]] = deque()
        self._wake = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Jobs that have not begun."""
        return len(self._jobs)

    def submit(self, job: Callable[[], None], *, frame: bool = False) -> None:
        """Do this after all earlier jobs."""
        with self._wake:
            if frame and self._newest_only:
                kept = [entry for entry in self._jobs if not entry[1]]
                self.dropped += len(self._jobs) - len(kept)
                self._jobs = deque(kept)
            self._jobs.append((job, frame))
            self._wake.notify()

    def close(self) -> None:
        """Finish the job under way, forget the others."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                job, _ = self._jobs.popleft()
            try:
                job()
            except Exception as error:
                self._on_error(error)
                return


class StampOrder(Enum):
    """How a stamp follows the last one of its stream."""

    NEXT = "next"
    REPEATED = "repeated"
    BACK = "back"


class StampGuard:
    """Tells streams whose stamps repeat or go back."""

    def __init__(self) -> None:
        self._last_ns: dict[str, int] = {}

    def check(self, stream: str, stamp_ns: int) -> StampOrder:
        """Judge a stamp and remember it; after BACK the other streams may start again too."""
        last_ns = self._last_ns.get(stream)
        if last_ns is not None and stamp_ns < last_ns:
            self._last_ns = {stream: stamp_ns}
            return StampOrder.BACK
        self._last_ns[stream] = stamp_ns
        return StampOrder.REPEATED if stamp_ns == last_ns else StampOrder.NEXT

    def forget(self) -> None:
        """Any stamp may follow."""
        self._last_ns.clear()


class InputWatch:
    """Knows which inputs have not come for a while, and how to say so."""

    def __init__(self, node: Node, topics: Iterable[str], now_s: Callable[[], float]) -> None:
        self._node = node
        self._now_s = now_s
        start_s = now_s()
        self._last_s = {node.resolve_topic_name(topic): start_s for topic in topics}
        self._seen: set[str] = set()
        self._complained = False

    def is_for(self, topics: Iterable[str]) -> bool:
        """Whether these are the topics that are watched."""
        return set(self._last_s) == {self._node.resolve_topic_name(topic) for topic in topics}

    def saw(self, topic: str) -> None:
        """A message came."""
        name = self._node.resolve_topic_name(topic)
        if name in self._last_s:
            self._last_s[name] = self._now_s()
            self._seen.add(name)

    def complaint(self) -> str | None:
        """One sentence on the topics that are silent, or None when all is well."""
        now_s = self._now_s()
        silent = [t for t, last_s in self._last_s.items() if now_s - last_s >= NO_DATA_AFTER_S]
        if not silent:
            return None
        never = [topic for topic in silent if topic not in self._seen]
        parts = []
        for topic in silent:
            count = self._node.count_publishers(topic)
            parts.append(f"{topic} ({count} publisher{'' if count == 1 else 's'})")
        said = "no data yet" if len(never) == len(self._last_s) else "input is missing"
        return (
            f"{said}: waiting for {', '.join(parts)}; check the topic names, the quality of "
            f"service and the sender with 'ros2 topic hz {silent[0]}'"
        )


class BaseNode(Node, Generic[Config]):  # type: ignore[misc]
    """A node with checked settings that says once a second how it is.

    A subclass names its settings, its inputs and what can be changed while it runs, and tells
    ``health`` what to report.
    """

    NAME: ClassVar[str]
    CONFIG: ClassVar[type]
    TOPICS: ClassVar[str]
    """Lines for ``--help``."""
    LIVE: ClassVar[Collection[str]] = ()

    def __init__(self) -> None:
        super().__init__(self.NAME)
        self.parameters: Parameters[Config] = Parameters(
            self,
            self.CONFIG,
            live=self.LIVE,
            shared={info.path for info in settings_of(PipelineConfig)},
            on_change=self.on_settings,
        )
        self.failure: BaseException | None = None
        self.problem = ""
        """Why the last input was refused; the subclass clears it with the next good one."""
        self._refused = 0
        self._watch: InputWatch | None = None
        self._last_complaint = ""
        self._health = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._tick = self.create_timer(1.0, self._report, clock=steady_clock())
        self._jump = self.get_clock().create_jump_callback(
            # A change between wall and simulated time is a start, not a jump.
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
            ),
            post_callback=self._jumped,
        )

    @property
    def config(self) -> Config:
        """The settings now in force."""
        return self.parameters.config

    def watch_inputs(self, topics: Sequence[str]) -> None:
        """From now on complain when one of these topics is silent, and of no other."""
        if self._watch is None or not self._watch.is_for(topics):
            self._watch = InputWatch(self, topics, time.monotonic)

    def saw(self, topic: str) -> None:
        """A message came on this topic."""
        if self._watch is not None:
            self._watch.saw(topic)

    def senders(self, topic: str) -> int:
        """Publishers of a topic, where it was remapped to; ``count_publishers`` does not follow."""
        return int(self.count_publishers(self.resolve_topic_name(topic)))

    def health(self) -> DiagnosticFields:
        """Level, message and counters for ``/diagnostics``."""
        raise NotImplementedError

    def on_settings(self, config: Config) -> None:
        """Live settings have changed."""

    def on_clock_jump_back(self, jump_s: float) -> None:
        """The clock went back, as when a recording starts again."""

    def close(self) -> None:
        """Stop threads and files; the node is about to go."""

    def fail(self, error: BaseException) -> None:
        """End the process because of this error; may be called from any thread.

        The first one counts: others may come of the end.
        """
        self.failure = self.failure or error
        self.context.try_shutdown()

    def refuse(self, error: ThermalStereoError) -> None:
        """An input is unusable: say so (at most every five seconds in the log) and go on."""
        self._refused += 1
        self.problem = str(error)
        self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _jumped(self, jump: Any) -> None:
        if jump.delta.nanoseconds < 0:
            self.on_clock_jump_back(jump.delta.nanoseconds * 1e-9)

    def _report(self) -> None:
        fields = self.health()
        complaint = self._watch.complaint() if self._watch is not None else None
        if complaint is not None and complaint != self._last_complaint:
            self.get_logger().warning(complaint)
        self._last_complaint = complaint or ""
        level, message = fields.level, fields.message
        if self.problem:
            level, message = ERROR, self.problem
        elif complaint is not None:
            message = f"{complaint}; {message}" if level == ERROR else complaint
            level = max(level, WARN)
        self._health.publish(
            diagnostics_to_msg(
                replace(
                    fields,
                    stamp_ns=fields.stamp_ns or self.get_clock().now().nanoseconds,
                    level=level,
                    name=f"{self.get_fully_qualified_name()}: {fields.name}",
                    message=message,
                    values=(*fields.values, ("refused", str(self._refused))),
                )
            )
        )


def help_text(node_type: type[BaseNode[Any]]) -> str:
    """What ``--help`` prints: purpose, topics and the table of parameters."""
    summary = (sys.modules[node_type.__module__].__doc__ or "").strip()
    lines = [
        f"usage: ros2 run thermal_stereo_vo {node_type.NAME}_node --ros-args "
        "[-p parameter:=value] [--params-file file.yaml] [-r topic:=other]",
        "",
        summary,
        "",
        "Topics",
        textwrap.indent(textwrap.dedent(node_type.TOPICS).strip(), "  "),
        "",
        "Parameters (name, default, meaning; * can be changed while running)",
    ]
    for info in settings_of(node_type.CONFIG):
        live = "*" if info.path in node_type.LIVE else " "
        value = list(info.default) if isinstance(info.default, tuple) else info.default
        lines.append(f" {live}{info.path} = {value!r}")
        lines += textwrap.wrap(
            describe(info), 92, initial_indent="      ", subsequent_indent="      "
        )
    return "\n".join(lines)


class StopRequest:
    """Whether somebody wants the process to end.

    No event: a signal handler may interrupt the very thread that holds the event's lock.
    """

    asked = False


@contextmanager
def stop_signals(limit_s: float = STOP_LIMIT_S) -> Iterator[StopRequest]:
    """Asked at the first Ctrl-C or SIGTERM; the second one ends the process at once.

    An exception out of a signal handler may hit rclpy inside a call that cannot take it: the node
    then ends with an error that is none, or never.  A request waits until the call is over.  What
    is still busy ``limit_s`` after the signal (a compiler, a driver that hangs) is left to itself,
    and the process ends with code 0.
    """
    stop, over = StopRequest(), threading.Event()

    def handler(number: int, frame: FrameType | None) -> None:
        stop.asked = True
        signal.signal(number, signal.SIG_DFL)

    def watch() -> None:
        while not stop.asked:
            if over.wait(STOP_CHECK_S):
                return
        if not over.wait(limit_s):
            print(f"still busy {limit_s:g} s after the signal: left to itself", file=sys.stderr)
            sys.stderr.flush()
            os._exit(0)

    # Started before any signal: a handler may interrupt the start of another thread.
    threading.Thread(target=watch, name="stop", daemon=True).start()
    for number in _STOP_SIGNALS:
        signal.signal(number, handler)
    # Python takes its handlers away before it ends: a signal would kill a node that has just ended.
    atexit.register(_ignore_signals)
    try:
        yield stop
    finally:
        over.set()


def _ignore_signals() -> None:
    for number in _STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _spin(
    node_type: type[BaseNode[Any]], argv: list[str], stop: StopRequest
) -> BaseException | None:
    """Run the node until ``stop`` or the end of its context; returns what went wrong."""
    node: BaseNode[Any] | None = None
    failure: BaseException | None = None
    make_room_for_images()
    rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()
    try:
        node = node_type()
        executor.add_node(node)
        while not stop.asked:
            executor.spin_once(timeout_sec=STOP_CHECK_S)
    except ExternalShutdownException:
        pass
    except Exception as error:
        # A node that ends itself shuts its context down: rclpy then fails in whatever it is doing.
        failure = error if rclpy.ok() else None
    finally:
        executor.shutdown()
        if node is not None:
            failure = node.failure or failure
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    return failure


def run(node_type: type[BaseNode[Any]], args: Sequence[str] | None = None) -> int:
    """Start the node, spin until somebody stops it, clean up.

    Returns the exit code: 0 done, 2 wrong use or unreadable input (one line on stderr), 1 a fault
    of ours.
    """
    argv = list(sys.argv if args is None else args)
    try:
        extra = remove_ros_args(argv)[1:]
    except RuntimeError as error:  # rcl's own message names the argument
        print(f"{node_type.NAME}_node: {error}", file=sys.stderr)
        return 2
    if "-h" in extra or "--help" in extra:
        print(help_text(node_type))
        return 0
    if extra:
        print(
            f"{node_type.NAME}_node: unknown argument '{extra[0]}': settings are given as "
            "--ros-args -p name:=value; see --help",
            file=sys.stderr,
        )
        return 2
    with stop_signals() as stop:
        failure = _spin(node_type, argv, stop)
    if failure is None:
        return 0
    if isinstance(failure, ThermalStereoError):
        print(f"{node_type.NAME}_node: {failure}", file=sys.stderr)
        return 2
    traceback.print_exception(failure)
    return 1
