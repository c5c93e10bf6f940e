#!/usr/bin/env python3
"""Print what the capture node costs: two fake cameras, 640x512, 16 bits, 30 Hz, and a subscriber.

    measure_capture.py [SECONDS]

Processor time of the fake cameras themselves is left out.  Memory and descriptors are printed after
10 s, then ten times over the whole time (20 s if not given; 600 for ten minutes).  For measurements
by hand; the tests assert no times.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
CAPTURE_THREADS = ("capture-left", "capture-right")
FAKE_THREAD = "fake_v4l2"
SETTLED_S = 10.0
LISTENER = """
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("listener")
for eye in ("left", "right"):
    node.create_subscription(Image, f"{eye}/image_raw", lambda message: None, 10)
node.create_subscription(DiagnosticArray, "status", lambda message: None, 10)
rclpy.spin(node)
"""


def main() -> None:
    """Start again under the preloaded library, or measure."""
    if "FAKE_V4L2" in os.environ:
        measure(float(sys.argv[1]) if len(sys.argv) > 1 else 20.0)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        library = folder / "fake_v4l2.so"
        source = HERE / "under_fake/fake_v4l2.c"
        command = ["cc", "-O2", "-fPIC", "-shared", "-o", library, source, "-ldl", "-lpthread"]
        subprocess.run(command, check=True)
        for eye in ("left", "right"):
            (folder / eye).touch()
            (folder / f"{eye}.control").write_bytes(control_block())
        devices = (f"{folder / eye}={folder / eye}.control" for eye in ("left", "right"))
        environment = {
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": "101",
            **os.environ,
        }
        listener = subprocess.Popen([sys.executable, "-c", LISTENER], env=environment)
        environment |= {"LD_PRELOAD": str(library), "FAKE_V4L2": ";".join(devices)}
        environment["PYTHONPATH"] = str(HERE.parents[1])
        try:
            subprocess.run([sys.executable, __file__, *sys.argv[1:]], env=environment, check=False)
        finally:
            listener.kill()


def control_block() -> bytes:
    """The begin of ``struct control``: Y16, 640x512, 30 Hz, monotonic stamps."""
    numbers = (int.from_bytes(b"Y16 ", "little"), 640, 512, 30_000, 0, 0x2000, 0, 1, 1, 16)
    return bytes((ctypes.c_uint32 * len(numbers))(*numbers)).ljust(4096, b"\0")


def measure(seconds: float) -> None:
    """Run the node in this process and look at its threads."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from thermal_stereo_vo.nodes.stereo_capture_node import StereoCaptureNode

    devices = [entry.split("=")[0] for entry in os.environ["FAKE_V4L2"].split(";")]
    arguments = ["--ros-args", "-p", "pairing.tolerance_ms:=20.0"]
    for eye, device in zip(("left", "right"), devices, strict=True):
        arguments += ["-p", f"grabbers.{eye}.device:={device}"]
    rclpy.init(args=arguments)
    node = StereoCaptureNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True, name="spin").start()
    time.sleep(5.0)
    before, began, pairs = cpu_seconds(), time.monotonic(), pairs_of(node)
    moments = {(step + 1) * seconds / 10 for step in range(10)} | {min(SETTLED_S, seconds)}
    for moment in sorted(moments):
        time.sleep(max(0.0, began + moment - time.monotonic()))
        print(f"{time.monotonic() - began:6.0f} s: {memory()}", flush=True)
    elapsed, pairs = time.monotonic() - began, pairs_of(node) - pairs
    spent = {name: cpu - before.get(name, 0.0) for name, cpu in cpu_seconds().items()}
    capture = sum(spent[name] for name in CAPTURE_THREADS)
    print(f"{pairs / elapsed:.2f} pairs/s")
    print(f"capture: {1e3 * capture / pairs:.3f} ms of processor time per pair")
    print(f"published: {100 * sum(spent.values()) / elapsed:.1f} % of one core")
    os._exit(0)


def pairs_of(node: object) -> int:
    """Complete pairs so far, as ``/diagnostics`` tells."""
    return int(dict(node.health().values)["pairs"])  # type: ignore[attr-defined]


def cpu_seconds() -> dict[str, float]:
    """Processor time of every thread by name, but for those of the fake cameras."""
    ours = {thread.native_id: thread.name for thread in threading.enumerate()}
    ticks = os.sysconf("SC_CLK_TCK")
    times: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        name = ours.get(int(task.name)) or (task / "comm").read_text().strip()
        fields = (task / "stat").read_text().rsplit(")", 1)[1].split()
        times[name] = times.get(name, 0.0) + (int(fields[11]) + int(fields[12])) / ticks
    times.pop(FAKE_THREAD, None)
    return times


def memory() -> str:
    """Resident memory and open descriptors."""
    lines = Path("/proc/self/status").read_text().splitlines()
    resident = next(line.split()[1] for line in lines if line.startswith("VmRSS"))
    return (
        f"{int(resident) / 1024:.1f} MB, {len(list(Path('/proc/self/fd').iterdir()))} descriptors"
    )


if __name__ == "__main__":
    main()
