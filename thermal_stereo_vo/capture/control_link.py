"""Keep one camera's control port alive: settings, temperatures, flags, corrections."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from thermal_stereo_vo.capture.camera_control import (
    NO_FLAGS,
    CameraSettings,
    StatusFlags,
    Tau2Control,
    open_serial,
)
from thermal_stereo_vo.capture.cci import (
    BusyError,
    CameraControlError,
    CciPort,
    NoReplyError,
    SerialPort,
)
from thermal_stereo_vo.capture.ffc_policy import FfcConfig, FfcOrder, FfcPolicy
from thermal_stereo_vo.core.config import setting
from thermal_stereo_vo.core.errors import CaptureError, ConfigError
from thermal_stereo_vo.core.frames import FfcState, Telemetry

logger = logging.getLogger(__name__)

_LOST_AFTER_FAILURES = 3
_TEMPERATURE_PERIOD_NS = 1_000_000_000
_FFC_POLL_S = 0.05


@dataclass(frozen=True)
class ControlConfig:
    """The serial control ports."""

    left_port: str = setting(
        "", "Serial port of the left camera by its udev name; empty for no control."
    )
    right_port: str = setting("", "The same for the right camera.")
    baud: int = setting(57600, "Baud rate of the camera.", minimum=9600, maximum=921600)
    timeout_s: float = setting(
        1.0, "Longest wait for one answer.", unit="s", minimum=0.1, maximum=10.0
    )
    poll_period_s: float = setting(
        0.2, "How often the camera is asked for its state.", unit="s", minimum=0.02, maximum=10.0
    )
    reopen_s: float = setting(
        1.0, "Wait before a lost port is opened again.", unit="s", minimum=0.05, maximum=60.0
    )
    stale_s: float = setting(
        3.0,
        "What a camera said of itself is forgotten after this.",
        unit="s",
        minimum=0.1,
        maximum=600.0,
    )


@dataclass(frozen=True)
class ControlStatus:
    """What is known of a camera over its control port; times on CLOCK_MONOTONIC.

    ``ffc_state`` None: not known.  ``settings`` are the camera's own words at the last connection.
    """

    camera: str
    connected: bool = False
    reason: str = "not opened yet"
    identity: str = ""
    settings: Mapping[str, str] = field(default_factory=dict)
    flags: StatusFlags = NO_FLAGS
    fpa_temperature_kelvin: float | None = None
    housing_temperature_kelvin: float | None = None
    heard_ns: int = 0
    ffc_state: FfcState | None = None
    ffc_ended_ns: int | None = None
    ffc_count: int = 0
    ffc_failures: int = 0
    ffc_reason: str = ""


class ControlLink:
    """A thread that talks to one camera and does not give up."""

    def __init__(
        self,
        camera: str,
        port: str,
        config: ControlConfig,
        settings: CameraSettings,
        ffc: FfcConfig,
        policy: FfcPolicy,
        *,
        open_port: Callable[[str, int], SerialPort] = open_serial,
    ) -> None:
        self.camera = camera
        self._port = port
        self._config = config
        self._settings = settings
        self._ffc = ffc
        self._policy = policy
        self._open_port = open_port
        self._status = ControlStatus(camera)
        self._stop = threading.Event()
        self._reconnect = threading.Event()
        self._shutter = threading.Event()
        self._thread: threading.Thread | None = None
        self._automatic: bool | None = None
        self._temperatures_ns: int | None = None

    def start(self) -> None:
        """Begin to connect; returns at once."""
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._run, name=f"control-{self.camera}", daemon=True
        )
        self._thread.start()

    def request_stop(self) -> None:
        """Begin to close the port; returns at once."""
        self._stop.set()
        self._reconnect.set()

    def stop(self) -> None:
        """Close the port; returns when it is closed."""
        self.request_stop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def reconnect(self) -> None:
        """Close and open the port now."""
        self._reconnect.set()

    def open_shutter(self) -> None:
        """Open a shutter that a shock has closed, as soon as the camera listens."""
        self._shutter.set()

    def status(self) -> ControlStatus:
        """A snapshot."""
        return self._status

    def telemetry(self, monotonic_ns: int) -> Telemetry | None:
        """What the camera says of itself at this moment; None when it is silent."""
        status = self._status
        correcting = status.ffc_state is FfcState.IN_PROGRESS
        stale_ns = self._config.stale_s * 1e9
        if not status.heard_ns or (monotonic_ns - status.heard_ns > stale_ns and not correcting):
            return None
        ended_ns = status.ffc_ended_ns
        return Telemetry(
            fpa_temperature_kelvin=status.fpa_temperature_kelvin,
            housing_temperature_kelvin=status.housing_temperature_kelvin,
            ffc_state=status.ffc_state,
            time_since_ffc_ns=None if ended_ns is None else max(monotonic_ns - ended_ns, 0),
        )

    def _run(self) -> None:
        while not self._stop.is_set():
            self._reconnect.clear()
            try:
                self._talk()
            except (CaptureError, ConfigError) as error:
                self._tell(connected=False, reason=str(error), ffc_state=None)
            except Exception as error:  # a fault of ours must not end the control for good
                logger.exception("control of camera '%s'", self.camera)
                self._tell(connected=False, reason=f"internal fault: {error!r}", ffc_state=None)
            self._reconnect.wait(self._config.reopen_s)
        self._tell(connected=False, reason="closed", ffc_state=None)

    def _talk(self) -> None:
        port = CciPort(
            self._open_port(self._port, self._config.baud), timeout_s=self._config.timeout_s
        )
        try:
            control = Tau2Control(port)
            self._automatic = self._temperatures_ns = None
            identity = str(control.identity())
            changes = control.configure(self._settings, self.camera)
            if changes:
                logger.info("camera '%s' set: %s", self.camera, "; ".join(changes))
            self._tell(
                connected=True,
                reason="",
                identity=identity,
                settings=control.report(),
                heard_ns=time.monotonic_ns(),
            )
            failures = 0
            while not self._reconnect.is_set():
                try:
                    self._poll(control)
                    self._serve(control)
                    failures = 0
                except (NoReplyError, BusyError) as error:
                    failures += 1
                    if failures >= _LOST_AFTER_FAILURES:
                        raise
                    self._tell(reason=str(error))
                self._reconnect.wait(self._config.poll_period_s)
            if self._stop.is_set() and self._ffc.authority == "camera" and not self._automatic:
                control.set_ffc_automatic(True)  # nobody is left to end the inhibition
        finally:
            port.close()

    def _poll(self, control: Tau2Control) -> None:
        flags = control.flags()
        now_ns = time.monotonic_ns()
        last_ns = self._temperatures_ns
        if last_ns is None or now_ns - last_ns >= _TEMPERATURE_PERIOD_NS:
            self._temperatures_ns = now_ns
            self._tell(
                fpa_temperature_kelvin=control.fpa_temperature_kelvin(),
                housing_temperature_kelvin=control.housing_temperature_kelvin(),
            )
        self._policy.observe(self.camera, now_ns, flags, self._status.fpa_temperature_kelvin)
        self._tell(
            flags=flags, heard_ns=now_ns, connected=True, reason="", **self._own_correction(flags)
        )

    def _own_correction(self, flags: StatusFlags) -> dict[str, object]:
        """What changes when the camera corrects itself."""
        status = self._status
        if StatusFlags.FFC_IN_PROGRESS in flags:
            return {"ffc_state": FfcState.IN_PROGRESS}
        if status.ffc_state is FfcState.IN_PROGRESS:
            return {
                "ffc_state": FfcState.COMPLETE,
                "ffc_ended_ns": time.monotonic_ns(),
                "ffc_count": status.ffc_count + 1,
                "ffc_reason": "the camera's own decision",
            }
        if self._policy.camera_may_decide(time.monotonic_ns()) and flags.asks_for_ffc:
            return {"ffc_state": FfcState.IMMINENT}
        done = status.ffc_ended_ns is not None
        return {"ffc_state": FfcState.COMPLETE if done else FfcState.NONE}

    def _serve(self, control: Tau2Control) -> None:
        now_ns = time.monotonic_ns()
        if self._ffc.authority != "none":
            automatic = self._policy.camera_may_decide(now_ns)
            if automatic != self._automatic:
                control.set_ffc_automatic(automatic)
                self._automatic = automatic
        if self._shutter.is_set():
            try:
                control.open_shutter()
            except (NoReplyError, BusyError):
                raise  # it may listen later
            except CameraControlError as error:
                logger.warning("camera '%s': %s", self.camera, error)
            self._shutter.clear()
        order = self._policy.take_order(self.camera, now_ns)
        if order is not None:
            self._correct(control, order)

    def _correct(self, control: Tau2Control, order: FfcOrder) -> None:
        before = self._status.ffc_state
        # Told before the order is sent: no frame of the closed shutter may pass for a good one.
        self._tell(ffc_state=FfcState.IN_PROGRESS, ffc_reason=order.reason)
        done = False
        try:
            control.do_ffc(long=order.long)
            done = self._wait_for_end(control)
        finally:
            now_ns = time.monotonic_ns()
            self._policy.finished(self.camera, now_ns, done=done)
            status = self._status
            if done:
                self._tell(
                    ffc_state=FfcState.COMPLETE, ffc_ended_ns=now_ns, ffc_count=status.ffc_count + 1
                )
            else:
                self._tell(ffc_state=before, ffc_failures=status.ffc_failures + 1)

    def _wait_for_end(self, control: Tau2Control) -> bool:
        """Ask until the camera says that the correction is over; it may not answer before."""
        began_s = time.monotonic()
        deadline_s = began_s + self._ffc.limit_s
        seen = False
        while time.monotonic() < deadline_s and not self._stop.is_set():
            self._stop.wait(_FFC_POLL_S)
            try:
                flags = control.flags(timeout_s=min(0.3, self._config.timeout_s))
            except (NoReplyError, BusyError):
                continue
            if StatusFlags.FFC_IN_PROGRESS in flags:
                seen = True
            elif seen or time.monotonic() - began_s >= self._ffc.duration_s:
                self._stop.wait(self._ffc.settle_s)
                return True
        return False

    def _tell(self, **changes: object) -> None:
        self._status = replace(self._status, **changes)  # type: ignore[arg-type]
