"""A camera at the other end of a pseudo-terminal; folders whose tests need another process."""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from collections import defaultdict

import pytest

collect_ignore = []
if "FAKE_V4L2" not in os.environ:
    collect_ignore.append("under_fake")
if "CAPTURE_GUEST" not in os.environ:
    collect_ignore.append("in_guest")

# Only a failure takes as long; a machine with other work to do must not make one.  The clock of the
# guest counts instructions, whatever else its host does.
PATIENCE_S = 30.0 if "CAPTURE_GUEST" in os.environ else 240.0
ASK_AGAIN_S = 10.0

GAIN, FFC_MODE, DO_FFC, DIGITAL, SENSOR, ROI = 0x0A, 0x0B, 0x0C, 0x12, 0x20, 0x4C


def bitwise_crc(data: bytes) -> int:
    """CCITT-16 from 0, bit by bit: another way than the code under test takes."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def packet(function: int, data: bytes = b"", status: int = 0) -> bytes:
    header = struct.pack(">BBBBH", 0x6E, status, 0, function, len(data))
    crc1 = struct.pack(">H", bitwise_crc(header))
    return header + crc1 + data + struct.pack(">H", bitwise_crc(data))


class PtyCamera:
    """Plays a Tau 2; the attributes below are its moods."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        tty.setraw(self._master)
        self.port = os.ttyname(slave)
        self._slave = slave
        self.received: list[tuple[int, bytes]] = []
        self.registers = {
            0x00: b"",
            0x04: struct.pack(">II", 12345, 67890),
            0x05: struct.pack(">4H", 2, 7, 3, 1),
            GAIN: b"\0\0",
            FFC_MODE: b"\0\1",
            0x0D: struct.pack(">H", 5400),
            0x0E: struct.pack(">H", 10),
            0x0F: b"\0\0",
            DIGITAL: b"\0\2",
            0x13: b"\0\0",
            0x21: b"\0\0",
            0x3C: b"\0\x3c",
            0x3E: b"\0\x40",
            0x72: b"\0\0",
            0x79: b"\0\0",
        }
        self.xp = 0
        self.regions = struct.pack(">12h", -320, -240, 320, 240, *(0,) * 8)
        self.sensors = {0x00: 253, 0x01: 9000, 0x0A: 3120, 0x11: 0}
        self.refused: dict[int, int] = {}
        self.stuck: set[int] = set()  # registers that do not take what is written
        self.silent = False
        self.busy_replies = 0
        self.bad_crc_replies = 0
        self.garbage = b""
        self.babble = b""
        self.delay_s = 0.0
        self.cut_s = 0.0
        self.ffc_s = 0.15
        self.blocked_during_ffc = True
        self.ordered_s: list[float] = []
        self._ffc_until_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def correcting(self) -> bool:
        return time.monotonic() < self._ffc_until_s

    def functions(self) -> list[int]:
        return [function for function, _ in self.received]

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        line = b""
        while not self._stop.is_set():
            if self.babble:
                os.write(self._master, self.babble)
            if not select.select([self._master], [], [], 0.01)[0]:
                continue
            line += os.read(self._master, 4096)
            while len(line) >= 10:
                length = 10 + int.from_bytes(line[4:6], "big")
                if len(line) < length:
                    break
                message, line = line[:length], line[length:]
                self._hear(message)

    def _hear(self, message: bytes) -> None:
        assert message == packet(message[3], message[8:-2]), message.hex(" ")
        function, data = message[3], message[8:-2]
        self.received.append((function, data))
        if self.correcting and self.blocked_during_ffc:
            while self.correcting and not self._stop.is_set():
                time.sleep(0.005)
        if self.silent:
            return
        status, answer = self._execute(function, data)
        reply = packet(function, answer, status)
        if self.bad_crc_replies:
            self.bad_crc_replies -= 1
            reply = reply[:-1] + bytes([reply[-1] ^ 1])
        time.sleep(self.delay_s)
        os.write(self._master, self.garbage)
        if self.cut_s:
            os.write(self._master, reply[:5])
            time.sleep(self.cut_s)
            reply = reply[5:]
        os.write(self._master, reply)

    def _execute(self, function: int, data: bytes) -> tuple[int, bytes]:
        if self.busy_replies:
            self.busy_replies -= 1
            return 0x01, b""
        if function in self.refused:
            return self.refused[function], b""
        if function == DO_FFC:
            self.ordered_s.append(time.monotonic())
            self._ffc_until_s = self.ordered_s[-1] + self.ffc_s
            return 0, data
        if function == SENSOR:
            return 0, self._read_sensor(int.from_bytes(data, "big"))
        if function == ROI:
            return 0, self._agc_region(data)
        if function == DIGITAL and data[:1] in (b"\2", b"\3"):
            if data[0] == 3:
                self.xp = data[1]
            return 0, struct.pack(">H", self.xp)
        if function not in self.registers:
            return 0x06, b""
        if data and function not in self.stuck:
            self.registers[function] = data
        return 0, self.registers[function]

    def _read_sensor(self, selector: int) -> bytes:
        value = self.sensors[selector]
        if selector == 0x11 and self.correcting:
            value |= 1 << 6
        return struct.pack(">h", value)

    def _agc_region(self, data: bytes) -> bytes:
        if len(data) == len(self.regions):
            self.regions = data
        elif len(data) == 8 and len(self.regions) == 16:
            self.regions = data + self.regions[8:]
        return self.regions[:8] if not data else self.regions


class LiveNode:
    """The capture node and a listener in this process."""

    def __init__(self, arguments: list[str]) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import CameraInfo, Image

        from thermal_stereo_vo.nodes.stereo_capture_node import StereoCaptureNode

        rclpy.init(args=["--ros-args", *arguments])
        self._rclpy = rclpy
        self.node = StereoCaptureNode()
        self.listener = rclpy.create_node("listener")
        self.heard: dict[str, list] = {}
        topics = {"/diagnostics": DiagnosticArray, "status": DiagnosticArray}
        for eye in ("left", "right"):
            topics |= {f"{eye}/image_raw": Image, f"{eye}/camera_info": CameraInfo}
        for topic, kind in topics.items():
            self.heard[topic] = []
            # Deep: on a busy machine much may arrive before it is taken.
            self.listener.create_subscription(kind, topic, self.heard[topic].append, 1000)
        self._closing = threading.Event()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._executor.add_node(self.listener)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def stamps(self, topic: str) -> list[int]:
        messages = list(self.heard[topic])
        return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]

    def health(self):
        """The newest status of the node: level, message, values."""
        if not self.heard["/diagnostics"]:
            return -1, "nothing heard yet", defaultdict(str)
        return _told(self.heard["/diagnostics"][-1])

    def healths(self):
        """Every status of the node so far, for what is told once only."""
        return [_told(message) for message in list(self.heard["/diagnostics"])]

    def said(self) -> object:
        """For messages of failed tests."""
        counts = {topic: len(messages) for topic, messages in self.heard.items()}
        return counts, self.health()

    def call(self, kind, name: str, request):
        client = self.listener.create_client(kind, name)
        try:
            assert client.wait_for_service(timeout_sec=PATIENCE_S)
            deadline = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline:
                # A server that has not yet found the client's end for answers drops what it says.
                future, ask_again_s = client.call_async(request), time.monotonic() + ASK_AGAIN_S
                while time.monotonic() < ask_again_s:
                    if future.done():
                        return future.result()
                    time.sleep(0.01)
                client.remove_pending_request(future)
            pytest.fail(f"no answer of {name} within {PATIENCE_S} s")
        finally:
            self.listener.destroy_client(client)

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.close()
        self.node.destroy_node()
        self.listener.destroy_node()
        self._rclpy.try_shutdown()

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.1)


def _told(message):
    status = message.status[0]
    return status.level[0], status.message, {v.key: v.value for v in status.values}


@pytest.fixture
def start_node(ros_domain):
    """``start_node(**parameters)``: the capture node of this process ('__' stands for a dot)."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    live = []

    def start(*arguments, **parameters):
        options = list(arguments)
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else value
            options += ["-p", f"{name.replace('__', '.')}:={text}"]
        live.append(LiveNode(options))
        return live[-1]

    yield start
    for node in live:
        node.close()


@pytest.fixture
def pty_camera():
    camera = PtyCamera()
    yield camera
    camera.close()


@pytest.fixture
def two_pty_cameras():
    cameras = {"left": PtyCamera(), "right": PtyCamera()}
    yield cameras
    for camera in cameras.values():
        camera.close()


@pytest.fixture
def eventually():
    """``eventually(lambda: condition)``: wait for it, or fail and tell ``seen()``."""

    def wait(condition, seen=None):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"not within {PATIENCE_S} s: {seen() if seen else condition}")
            time.sleep(0.005)

    return wait
