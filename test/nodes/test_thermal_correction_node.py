"""The correction node as a process: what it publishes is what the front end gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from thermal_stereo_vo.calibration.flat_field_recordings import read_flat_fields
from thermal_stereo_vo.core.frames import Gap, GapReason, RawFrame, Telemetry
from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.outputs.gate_fields import gap_from_values
from thermal_stereo_vo.outputs.ros_fields import telemetry_fields
from thermal_stereo_vo.radiometry.front_end import FrontEndConfig, ThermalFrontEnd
from thermal_stereo_vo.radiometry.gate import GateConfig

EYES = ("left", "right")
QOS = QoSProfile(depth=200)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000


def flight(rng: np.random.Generator, frames: int) -> list[np.ndarray]:
    wall = np.cumsum(rng.normal(0, 8, (48, 64 + 2 * frames)), axis=1) + 8000
    noise = rng.normal(0, 1.5, (frames, 48, 64))
    return [
        np.round(wall[:, 2 * k : 2 * k + 64] + noise[k]).astype(np.uint16) for k in range(frames)
    ]


class Chain:
    """Publishers of raw images, and all that the node answers."""

    def __init__(self, ros: Any) -> None:
        node = ros.node
        self.ros = ros
        self.corrected: dict[str, list[Image]] = {eye: [] for eye in EYES}
        self.statuses: list[DiagnosticArray] = []
        self.raw_out = {eye: node.create_publisher(Image, f"{eye}/image_raw", QOS) for eye in EYES}
        self.status_out = node.create_publisher(DiagnosticArray, "status", QOS)
        for eye in EYES:
            node.create_subscription(
                Image, f"{eye}/image_corrected", self.corrected[eye].append, QOS
            )
        node.create_subscription(DiagnosticArray, "status", self._on_status, QOS)

    def _on_status(self, message: DiagnosticArray) -> None:
        if message.status[0].name.startswith("thermal correction"):
            self.statuses.append(message)

    def ready(self) -> None:
        self.ros.spin_until(
            lambda: all(out.get_subscription_count() > 0 for out in self.raw_out.values()),
            "the node to ask for images",
        )

    def send(self, eye: str, image: np.ndarray, stamp_ns: int, kelvin: float | None = None) -> None:
        if kelvin is not None:
            told = telemetry_fields(stamp_ns, eye, Telemetry(fpa_temperature_kelvin=kelvin))
            self.status_out.publish(conversions.diagnostics_to_msg(told))
        message = conversions.image_to_msg(image, stamp_ns, f"{eye}_optical")
        self.raw_out[eye].publish(message)

    def values(self, eye: str) -> dict[int, dict[str, str]]:
        """Stamp -> what the status of this eye said."""
        return {
            conversions.stamp_from_msg(message.header.stamp): {
                pair.key: pair.value for pair in message.status[0].values
            }
            for message in self.statuses
            if message.status[0].name == f"thermal correction {eye}"
        }


@pytest.fixture
def chain(ros: Any) -> Chain:
    return Chain(ros)


def test_the_node_publishes_what_the_front_end_gives(chain: Chain, rng) -> None:
    """The left eye freezes for 8 frames; the right one goes on."""
    images = {eye: flight(rng, 30) for eye in EYES}
    images["left"][12:20] = [images["left"][11]] * 8
    # A busy machine may keep images waiting for seconds: that is no dead stream.
    chain.ros.start("thermal_correction_node", process_all=True, front_end__gate__ffc_max_s=60.0)
    chain.ready()
    for k in range(30):
        for eye in EYES:
            chain.send(eye, images[eye][k], START_NS + k * PERIOD_NS)
    chain.ros.spin_until(lambda: len(chain.statuses) == 60, "a status for every image")
    chain.ros.spin_until(
        lambda: [len(chain.corrected[eye]) for eye in EYES] == [22, 30], "every good image"
    )
    for eye in EYES:
        front_end = ThermalFrontEnd(FrontEndConfig(gate=GateConfig(ffc_max_s=60.0)), eye)
        told = chain.values(eye)
        got = iter(chain.corrected[eye])
        for k in range(30):
            stamp_ns = START_NS + k * PERIOD_NS
            frame = front_end.process(RawFrame(images[eye][k], stamp_ns, eye, k))
            assert frame is not None
            assert gap_from_values(told[stamp_ns]) == (frame.epoch, frame.gap)
            assert told[stamp_ns]["blind"] == str(frame.image is None).lower()
            assert told[stamp_ns]["gate"] == front_end.decision.state.value
            if frame.image is not None:
                message = next(got)
                assert conversions.stamp_from_msg(message.header.stamp) == stamp_ns
                assert message.header.frame_id == f"{eye}_optical"
                np.testing.assert_array_equal(conversions.image_from_msg(message), frame.image)
    assert gap_from_values(chain.values("left")[START_NS + 20 * PERIOD_NS]) == (
        1,
        Gap(9 * PERIOD_NS, GapReason.FFC, True),
    )
    assert "camera 'left': ffc of 0.900 s from frame 12 to 20" in chain.ros.logs()


def test_bad_input_is_reported_and_survived(chain: Chain, rng) -> None:
    images = flight(rng, 12)
    chain.ros.start("thermal_correction_node", process_all=True, front_end__gate__bit_depth=14)
    chain.ready()
    chain.send("left", images[0], START_NS)
    chain.send("left", (images[1] // 64).astype(np.uint8), START_NS + PERIOD_NS)
    for k in range(2, 6):
        chain.send("left", images[k], START_NS + k * PERIOD_NS)
    chain.send("left", images[5], START_NS + 5 * PERIOD_NS)
    for k in range(6, 12):
        chain.send("left", images[k], START_NS + (k - 6) * PERIOD_NS)
    chain.ros.spin_until(lambda: len(chain.corrected["left"]) == 11, "all good images")
    logs = chain.ros.logs()
    assert "camera 'left' delivered an 8-bit image but bit_depth is 14" in logs
    assert "the stamps of /left/image_raw went back, the gates start again" in logs


def test_services_reach_the_owner_of_the_cameras(chain: Chain) -> None:
    """Without owner they say so; with one they are passed on, and an inhibition ends by itself."""
    ros = chain.ros
    ros.start("thermal_correction_node", inhibit_limit_s=2.0)
    do_ffc = ros.node.create_client(Trigger, "thermal_correction/do_ffc")
    inhibit = ros.node.create_client(SetBool, "thermal_correction/inhibit_ffc")
    for client, request in ((do_ffc, Trigger.Request()), (inhibit, SetBool.Request(data=True))):
        answer = ros.call(client, request)
        assert not answer.success
        assert "nobody offers" in answer.message
        assert "start the capture node" in answer.message

    orders: list[str] = []

    def on_trigger(request: Any, response: Any) -> Any:
        orders.append("ffc")
        response.success = True
        return response

    def on_inhibit(request: Any, response: Any) -> Any:
        orders.append("inhibit" if request.data else "allow")
        response.success = True
        return response

    ros.node.create_service(Trigger, "stereo_capture/do_ffc", on_trigger)
    ros.node.create_service(SetBool, "stereo_capture/inhibit_ffc", on_inhibit)
    ros.spin_until(lambda: ros.call(do_ffc, Trigger.Request()).success, "the owner to be found")
    ros.spin_until(lambda: "ffc" in orders, "the order to arrive")
    ros.spin_until(
        lambda: ros.call(inhibit, SetBool.Request(data=True)).success, "the owner to be found"
    )
    ros.spin_until(lambda: "allow" in orders, "the watchdog to end the inhibition")
    assert orders.index("inhibit") < orders.index("allow")
    said = "corrections are allowed again after 2 s"
    ros.spin_until(lambda: said in ros.logs(), "the watchdog to say so")


def test_views_of_a_uniform_source_are_recorded(chain: Chain, rng, tmp_path: Path) -> None:
    ros = chain.ros
    folder = tmp_path / "flat"
    ros.start(
        "thermal_correction_node",
        process_all=True,
        flat_field_folder=folder,
        flat_field_frames=6,
    )
    record = ros.node.create_client(Trigger, "thermal_correction/record_flat_field")
    answer = ros.call(record, Trigger.Request())
    assert answer.success
    assert "recording 6 images of each camera" in answer.message
    assert ros.call(record, Trigger.Request()).success, "begins again"
    chain.ready()
    pattern = 30 * rng.standard_normal((48, 64))
    done: list[Path] = []
    sent = 0

    def complete() -> bool:
        nonlocal sent
        for eye in EYES:
            image = np.round(8000 + pattern + rng.normal(0, 1.5, (48, 64))).astype(np.uint16)
            chain.send(eye, image, START_NS + sent * PERIOD_NS, kelvin=303.0)
        sent += 1
        done[:] = sorted(folder.glob("*.npz"))
        return len(done) == 2

    ros.spin_until(complete, "both recordings")
    for eye, path in zip(EYES, done, strict=True):
        (frame,) = read_flat_fields(path).frames
        assert path.name.startswith(f"flat_{eye}_303.00K_")
        assert frame.fpa_kelvin == pytest.approx(303.0)
        assert np.std(frame.image - 8000 - pattern) < 1.2
