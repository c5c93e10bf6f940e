"""What the stereo nodes listen to: two cameras' calibrations, and their images as pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.errors import ThermalStereoError
from thermal_stereo_vo.core.frames import RadiometricFrame
from thermal_stereo_vo.nodes import conversions, runtime
from thermal_stereo_vo.outputs.gate_fields import report_from_fields
from thermal_stereo_vo.radiometry.gate_reports import MOST_WAITING, GatedFrames
from thermal_stereo_vo.stereo.pairing import Pair, PairingConfig, StereoPairer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from thermal_stereo_vo.core.camera_info import CameraInfoFields

EYES = (LEFT, RIGHT)


def patient(pairing: PairingConfig) -> PairingConfig:
    """The same pairs, only decided later where an eye is silent."""
    return replace(pairing, max_waiting=max(pairing.max_waiting, runtime.PATIENT))


class CalibrationInput:
    """``<role>/camera_info`` of two cameras: tells both whenever one has changed."""

    def __init__(
        self,
        node: runtime.BaseNode[Any],
        on_calibration: Callable[[CameraInfoFields, CameraInfoFields], None],
        roles: tuple[str, str] = EYES,
    ) -> None:
        self._node = node
        self._on_calibration = on_calibration
        self._infos: dict[str, CameraInfoFields] = {}
        self._roles = roles
        self.topics = [f"{eye}/camera_info" for eye in roles]
        for eye, topic in zip(roles, self.topics, strict=True):
            node.create_subscription(
                CameraInfo, topic, partial(self._on_info, eye, topic), runtime.RELIABLE
            )

    def _on_info(self, eye: str, topic: str, message: CameraInfo) -> None:
        self._node.saw(topic)
        try:
            info = conversions.camera_info_from_msg(message)
            if info == self._infos.get(eye):
                return
            self._infos[eye] = info
            if len(self._infos) == len(self._roles):
                first, second = (self._infos[role] for role in self._roles)
                self._on_calibration(first, second)
        except ThermalStereoError as error:
            self._node.refuse(error)


class ImageInput:
    """``<role>/<name>`` of two cameras as pairs, from ``open`` to ``close``.

    With ``process_all`` every image is asked for, reliably, and may wait long for its partner: one
    eye's first images can come late, as each topic is discovered on its own.

    A stamp that comes again is passed over; one that goes back starts the pairing anew and tells
    ``on_restart``.  ``masks`` go with the frames of their eye.  ``gated`` images come from
    ``thermal_correction``: they are joined with what its ``status`` says of each.
    """

    def __init__(
        self,
        node: runtime.BaseNode[Any],
        name: str,
        pairing: PairingConfig,
        process_all: bool,
        on_pair: Callable[[Pair[RadiometricFrame]], None],
        on_restart: Callable[[str], None],
        *,
        gated: bool = False,
        roles: tuple[str, str] = EYES,
    ) -> None:
        self._node = node
        self._roles = roles
        self._process_all = process_all
        self._gated = gated
        self._on_pair = on_pair
        self._on_restart = on_restart
        self._guard = runtime.StampGuard()
        self._pairing = pairing
        self._pairer = self._new_pairer()
        self._gates = self._new_gates()
        self._received = dict.fromkeys(roles, 0)
        self._repeated = 0
        self._subscriptions: list[Any] = []
        self.masks: dict[str, NDArray[np.bool_] | None] = {}
        self.topics = [f"{eye}/{name}" for eye in roles]

    @property
    def is_open(self) -> bool:
        """Whether images are asked for."""
        return bool(self._subscriptions)

    def open(self) -> None:
        """Ask for images."""
        self._subscriptions = [
            self._node.create_subscription(
                Image,
                topic,
                partial(self._on_image, eye, topic),
                runtime.IMAGES_ALL if self._process_all else self._newest(topic),
                qos_overriding_options=runtime.overridable(),
            )
            for eye, topic in zip(self._roles, self.topics, strict=True)
        ]
        if self._gated:
            self._subscriptions.append(
                self._node.create_subscription(
                    DiagnosticArray, "status", self._on_status, runtime.IMAGES_ALL
                )
            )

    def close(self) -> None:
        """Ask for no more images and forget those that wait."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self.restart()

    def restart(self, pairing: PairingConfig | None = None) -> None:
        """Forget the images that wait for a partner; any stamp may follow."""
        self._pairing = pairing or self._pairing
        self._pairer = self._new_pairer()
        self._gates = self._new_gates()
        self._guard.forget()

    def counters(self) -> tuple[tuple[str, str], ...]:
        """For diagnostics."""
        counters = self._pairer.counters
        first, second = self._roles
        return (
            (f"received_{first}", str(self._received[first])),
            (f"received_{second}", str(self._received[second])),
            ("repeated_stamps", str(self._repeated)),
            ("pairs", str(counters.pairs)),
            (f"{first}_alone", str(counters.first_alone)),
            (f"{second}_alone", str(counters.second_alone)),
        )

    def _newest(self, topic: str) -> QoSProfile:
        """Reliable where every sender is, as an image is many packets, of which one is easily lost.

        A reliable subscription would hear nothing from a best-effort sender.
        """
        offered = [
            info.qos_profile.reliability for info in self._node.get_publishers_info_by_topic(topic)
        ]
        reliable = bool(offered) and all(r == ReliabilityPolicy.RELIABLE for r in offered)
        return runtime.IMAGES_NEWEST_RELIABLE if reliable else runtime.IMAGES_NEWEST

    def _new_pairer(self) -> StereoPairer[RadiometricFrame]:
        return StereoPairer(patient(self._pairing) if self._process_all else self._pairing)

    def _new_gates(self) -> dict[str, GatedFrames]:
        waiting = runtime.PATIENT if self._process_all else MOST_WAITING
        tolerance_ns = round(self._pairing.tolerance_ms * 1e6)
        return {eye: GatedFrames(eye, tolerance_ns, waiting) for eye in self._roles}

    def _on_image(self, eye: str, topic: str, message: Image) -> None:
        self._node.saw(topic)
        stamp_ns = conversions.stamp_from_msg(message.header.stamp)
        order = self._guard.check(eye, stamp_ns)
        if order is runtime.StampOrder.REPEATED:
            self._repeated += 1
            return
        if order is runtime.StampOrder.BACK:
            self._pairer = self._new_pairer()
            self._gates = self._new_gates()
            self._on_restart(
                f"the stamps of {self._node.resolve_topic_name(topic)} went back: a recording "
                "started anew, or two senders publish on the topic"
            )
        try:
            image = conversions.image_from_msg(message)
            frame = RadiometricFrame(
                image, stamp_ns, eye, self._received[eye], mask=self.masks.get(eye)
            )
            self._received[eye] += 1
            self._push(eye, self._gates[eye].seen(frame) if self._gated else [frame])
        except ThermalStereoError as error:
            self._node.refuse(error)

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in conversions.diagnostics_from_msg(message):
            found = report_from_fields(status)
            if found is None or found[0] not in self._roles:
                continue
            eye, report = found
            try:
                self._push(eye, self._gates[eye].told(report))
            except ThermalStereoError as error:
                self._node.refuse(error)

    def _push(self, eye: str, frames: Iterable[RadiometricFrame]) -> None:
        for frame in frames:
            for pair in self._pairer.push(self._roles.index(eye), frame):
                self._on_pair(pair)
