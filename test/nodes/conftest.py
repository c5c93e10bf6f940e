"""A small recording, and nodes as real processes in a ROS domain of their own."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    Camera,
    DistortionModel,
    RigCalibration,
    RigCamera,
)
from thermal_stereo_vo.core.transforms import exp_se3

REPOSITORY = Path(__file__).resolve().parent.parent.parent
PATIENCE_S = 300.0
"""For a machine that compiles every kernel and has other work to do."""
ASK_AGAIN_S = 10.0


def raw_calibration(width: int = 320, height: int = 240) -> RigCalibration:
    """Two lenses with distortion, turned against each other: nothing is rectified yet."""

    def camera(fx: float, cx: float, k1: float) -> Camera:
        model = DistortionModel.RADIAL_TANGENTIAL
        return Camera(width, height, fx, fx, cx, 119.0, model, (k1, 0.02, 1e-3, -5e-4, 0.0))

    T_left_right = exp_se3([0.3, 0.004, -0.006, 0.010, -0.015, 0.008])
    return RigCalibration(
        cameras={
            LEFT: RigCamera(camera(260.0, 161.0, -0.12)),
            RIGHT: RigCamera(camera(262.0, 158.0, -0.10), T_left_right),
        },
        origin="of the textured ramp",
    )


class TexturedRamp:
    """14-bit counts of a plane that leans away from the rig: depth changes over the image."""

    def __init__(self, rng: np.random.Generator) -> None:
        texture = np.zeros((1024, 1024), np.float32)
        for size in (16, 64, 256, 512):
            patch = rng.standard_normal((size, size)).astype(np.float32)
            texture += cv2.resize(patch, (1024, 1024), interpolation=cv2.INTER_CUBIC)
        self._counts = 7000.0 + 400.0 * texture
        self._normal = np.array([0.0, -0.35, 1.0])
        self._distance_m = 8.0

    def image(self, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
        """(H, W) uint16."""
        x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.unproject(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        origin = T_world_camera[:3, 3]
        directions = rays @ T_world_camera[:3, :3].T
        depth = (self._distance_m - origin @ self._normal) / (directions @ self._normal)
        points = origin + depth[:, None] * directions
        where = (points[:, :2] * 50.0 + 512.0).astype(np.float32).reshape(*x.shape, 2)
        counts = cv2.remap(
            self._counts, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        return np.clip(np.rint(counts), 0, 16383).astype(np.uint16)


@pytest.fixture(scope="session")
def textured_ramp() -> TexturedRamp:
    return TexturedRamp(np.random.default_rng(5))


PAIRS = 24


def write_ramp_bag(
    path: Path,
    ramp: TexturedRamp,
    *,
    blind: range = range(0),
    frozen: Mapping[str, range] | None = None,
) -> None:
    """A rig that flies and turns before the ramp at 10 Hz.

    The right eye misses the images ``blind``; those ``frozen`` repeat the one before.
    """
    from thermal_stereo_vo.core.camera_info import infos_from_calibration
    from thermal_stereo_vo.outputs.bag_writer import BagWriter
    from thermal_stereo_vo.stereo.rectification import RectificationConfig, with_rectification

    rng = np.random.default_rng(6)
    shown: dict[str, np.ndarray] = {}
    raw = raw_calibration()
    infos = infos_from_calibration(with_rectification(raw, RectificationConfig())[0])
    with BagWriter(path) as bag:
        for i in range(PAIRS):
            stamp_ns = 1_700_000_000_000_000_000 + i * 100_000_000
            T_world_rig = exp_se3([0.05 * i, 0.01 * i, 0.08 * i, 0.002 * i, -0.004 * i, 0.003 * i])
            for eye, mounted in raw.cameras.items():
                if eye == RIGHT and i in blind:
                    continue
                image = ramp.image(mounted.camera, T_world_rig @ mounted.T_rig_camera)
                if frozen is None or i not in frozen.get(eye, ()):
                    shown[eye] = image + rng.integers(0, 8, image.shape, dtype=np.uint16)
                bag.write_image(f"/{eye}/image_raw", stamp_ns, shown[eye], f"{eye}_optical")
                bag.write_camera_info(f"/{eye}/camera_info", stamp_ns, infos[eye], f"{eye}_optical")


class Ros:
    """A ROS domain of this test: processes in it, and a node of the test itself."""

    def __init__(self, folder: Path, context: Any, executor: Any, node: Any) -> None:
        self._folder = folder
        self._context = context
        self._executor = executor
        self._processes: list[tuple[str, subprocess.Popen[bytes], Path]] = []
        self.node = node

    def start(
        self, name: str, remappings: Mapping[str, str] | None = None, **parameters: object
    ) -> subprocess.Popen[bytes]:
        """Start a node of the package with these parameters ('__' stands for a dot)."""
        arguments = [sys.executable, "-m", f"thermal_stereo_vo.nodes.{name}", "--ros-args"]
        for old, new in (remappings or {}).items():
            arguments += ["-r", f"{old}:={new}"]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else value
            arguments += ["-p", f"{key.replace('__', '.')}:={text}"]
        log = self._folder / f"{name}.{len(self._processes)}.log"
        with log.open("wb") as stream:
            process = subprocess.Popen(
                arguments, cwd=REPOSITORY, stdout=stream, stderr=subprocess.STDOUT
            )
        self._processes.append((name, process, log))
        return process

    def logs(self) -> str:
        """What all processes have said."""
        return "\n".join(
            f"--- {name} ({process.poll()})\n{log.read_text(errors='replace')}"
            for name, process, log in self._processes
        )

    def spin_until(self, condition: Callable[[], bool], what: str) -> None:
        """Handle messages until the condition holds; fail with the logs when it never does."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            assert time.monotonic() < deadline, f"gave up waiting for {what}\n{self.logs()}"
            for name, process, _ in self._processes:
                fault = process.poll() not in (None, 0)
                assert not fault, f"{name} ended while waiting for {what}\n{self.logs()}"

    def call(self, client: Any, request: Any) -> Any:
        """The answer of a service, asked again when an answer is lost.

        A server that has not yet found the client's end for answers drops what it says.
        """
        self.spin_until(client.service_is_ready, f"service {client.srv_name}")
        future, asked_s = client.call_async(request), time.monotonic()

        def answered() -> bool:
            nonlocal future, asked_s
            if not future.done() and time.monotonic() - asked_s > ASK_AGAIN_S:
                client.remove_pending_request(future)
                future, asked_s = client.call_async(request), time.monotonic()
            return bool(future.done())

        self.spin_until(answered, f"an answer of {client.srv_name}")
        return future.result()

    def stop(self) -> None:
        """End the processes as a person would, with Ctrl-C."""
        for _, process, _ in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for name, process, _ in self._processes:
            code = process.wait(timeout=PATIENCE_S)
            assert code == 0, f"{name} left {code} after Ctrl-C\n{self.logs()}"


@pytest.fixture
def ros(ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    """A node of the test and others as processes, heard on this machine only."""
    rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter

    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ros_domain)
    node = rclpy.create_node(
        "listener",
        context=context,
        parameter_overrides=[Parameter("use_sim_time", value=False)],
        start_parameter_services=False,
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    ros = Ros(tmp_path, context, executor, node)
    try:
        yield ros
    finally:
        try:
            ros.stop()
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.try_shutdown(context=context)


@pytest.fixture
def write_bag(textured_ramp: TexturedRamp) -> Callable[..., None]:
    """``write_bag(path, blind=range)``: the flight before the ramp as a bag."""
    return lambda path, **options: write_ramp_bag(path, textured_ramp, **options)
