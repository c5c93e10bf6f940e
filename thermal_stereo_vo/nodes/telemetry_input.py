"""What the cameras say of themselves, heard beside their images."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from thermal_stereo_vo.core.frames import Telemetry
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.nodes.stereo_input import EYES
from thermal_stereo_vo.outputs.ros_fields import telemetry_from_values

TEMPERATURE_AGE_NS = 2_000_000_000
STATE_AGE_NS = 100_000_000


class TelemetryInput:
    """Listens to ``status`` for entries whose hardware id is an eye."""

    def __init__(self, node: Node) -> None:
        self._told: dict[str, tuple[int, Telemetry]] = {}
        node.create_subscription(DiagnosticArray, "status", self._on_status, runtime.RELIABLE)

    def at(self, eye: str, stamp_ns: int) -> Telemetry | None:
        """What is still true of what the camera last told: its status follows the image."""
        told_ns, told = self._told.get(eye, (0, None))
        age_ns = abs(stamp_ns - told_ns)
        if told is None or age_ns > TEMPERATURE_AGE_NS:
            return None
        return Telemetry(
            told.fpa_temperature_kelvin,
            told.housing_temperature_kelvin,
            told.ffc_state if age_ns <= STATE_AGE_NS else None,
        )

    def _on_status(self, message: DiagnosticArray) -> None:
        stamp_ns = conversions.stamp_from_msg(message.header.stamp)
        for status in message.status:
            if status.hardware_id in EYES:
                told = telemetry_from_values({pair.key: pair.value for pair in status.values})
                if told is not None:
                    self._told[status.hardware_id] = (stamp_ns, told)
