"""Inertial and satellite measurements, and the truth about corrections, on their way into a bag."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from thermal_stereo_vo.outputs.ros_fields import OK, DiagnosticFields
from thermal_stereo_vo.simulation.schedule import stamp_ns

if TYPE_CHECKING:
    from thermal_stereo_vo.outputs.bag_writer import BagWriter
    from thermal_stereo_vo.simulation.simulation import Simulation

IMU_TOPIC, FIX_TOPIC, PLACE_TOPIC = "/imu/data", "/gps/fix", "/gps/position"
CORRECTIONS_TOPIC = "/simulation/corrections"
_BASE_FRAME, _MAP_FRAME = "base_link", "map"


class NavigationFeed:
    """Writes ``/imu/data``, ``/gps/fix`` and ``/gps/position`` up to a stamp.

    ``/simulation/corrections`` tells when each camera's shutter closed and opened, at both times.
    """

    def __init__(self, simulation: Simulation) -> None:
        config = simulation.config.navigation
        self._rate_variance = config.gyro_noise**2 * config.imu_rate_hz
        self._force_variance = config.accelerometer_noise**2 * config.imu_rate_hz
        self._inertial = _Ahead(simulation.inertial())
        self._fixes = _Ahead(simulation.fixes())
        self._events = _Ahead(iter(_corrections(simulation)))

    def write(self, bag: BagWriter, up_to_ns: int | None) -> None:
        """Write what was measured up to a stamp, or all that is left."""
        for measured in self._inertial.until(up_to_ns):
            bag.write_imu(
                IMU_TOPIC,
                measured.stamp_ns,
                measured.rate_rad_s,
                measured.force_m_s2,
                _BASE_FRAME,
                angular_variance=self._rate_variance,
                acceleration_variance=self._force_variance,
            )
        for fix in self._fixes.until(up_to_ns):
            bag.write_nav_sat_fix(
                FIX_TOPIC,
                fix.stamp_ns,
                fix.latitude_deg,
                fix.longitude_deg,
                fix.altitude_m,
                _BASE_FRAME,
            )
            bag.write_point(PLACE_TOPIC, fix.stamp_ns, fix.position_m, _MAP_FRAME)
        for event in self._events.until(up_to_ns):
            bag.write_diagnostics(CORRECTIONS_TOPIC, event)


class _HasStamp(Protocol):
    @property
    def stamp_ns(self) -> int: ...


Stamped = TypeVar("Stamped", bound=_HasStamp)


class _Ahead(Generic[Stamped]):
    """A stream of stamped things, read one ahead."""

    def __init__(self, stream: Iterator[Stamped]) -> None:
        self._stream = stream
        self._next = next(stream, None)

    def until(self, stamp_ns: int | None) -> Iterator[Stamped]:
        """Those up to a stamp, or all that are left."""
        while self._next is not None and (stamp_ns is None or self._next.stamp_ns <= stamp_ns):
            yield self._next
            self._next = next(self._stream, None)


def _corrections(simulation: Simulation) -> list[DiagnosticFields]:
    duration_s = simulation.config.ffc.duration_s
    events = []
    for camera, role in enumerate(simulation.plan.roles):
        for start_s in simulation.corrections_s(camera):
            for time_s, what in ((start_s, "closed"), (start_s + duration_s, "opened")):
                values = (("shutter", what), ("start_s", repr(start_s)))
                event = DiagnosticFields(
                    stamp_ns(time_s), OK, role, f"shutter {what}", values, role
                )
                events.append(event)
    return sorted(events, key=lambda event: event.stamp_ns)
