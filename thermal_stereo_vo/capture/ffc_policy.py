"""When each camera shall correct its flat field: never both blind at once, never in a manoeuvre."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from thermal_stereo_vo.capture.camera_control import NO_FLAGS, StatusFlags
from thermal_stereo_vo.core.config import setting

_RETRY_NS = 5_000_000_000
_JOIN_NS = 2_000_000_000


@dataclass(frozen=True)
class FfcConfig:
    """Who decides on flat-field corrections (FFC), and when."""

    authority: str = setting(
        "host",
        "host: the cameras are set to manual and this program decides; camera: they correct "
        "themselves; none: their mode is left alone.",
        choices=("host", "camera", "none"),
    )
    schedule: str = setting(
        "staggered",
        "staggered: one camera at a time, so that one always sees; together: one common gap.",
        choices=("staggered", "together"),
    )
    period_s: float = setting(
        180.0, "Time between corrections; 0 for never.", unit="s", minimum=0.0, maximum=86400.0
    )
    temperature_delta_kelvin: float = setting(
        1.0,
        "Change of the detector's temperature that calls for a correction; 0 for never.",
        unit="K",
        minimum=0.0,
        maximum=100.0,
    )
    separation_s: float = setting(
        2.0,
        "Staggered: the other camera has seen for at least this long before one goes blind.",
        unit="s",
        minimum=0.0,
        maximum=600.0,
    )
    force_after_s: float = setting(
        60.0,
        "A camera that asks for a correction for longer than this gets it, inhibited or not.",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
    )
    inhibit_limit_s: float = setting(
        30.0,
        "An inhibition lapses after this unless it is asked for again.",
        unit="s",
        minimum=0.1,
        maximum=3600.0,
    )
    duration_s: float = setting(
        0.5,
        "How long a correction takes when the camera does not tell.",
        unit="s",
        minimum=0.05,
        maximum=10.0,
    )
    limit_s: float = setting(
        3.0,
        "A correction that is not over after this has failed.",
        unit="s",
        minimum=0.1,
        maximum=60.0,
    )
    settle_s: float = setting(
        0.1,
        "Frames this long after a correction still count as taken during it.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )


@dataclass(frozen=True)
class FfcOrder:
    """Correct now; ``long`` also switches the table.  ``reason`` is for people."""

    long: bool
    reason: str


@dataclass
class _Eye:
    last_ns: int
    flags: StatusFlags = NO_FLAGS
    fpa_kelvin: float | None = None
    fpa_at_last_kelvin: float | None = None
    asking_since_ns: int | None = None
    requested: bool = False
    joins_until_ns: int | None = None
    running: bool = False
    ended_ns: int | None = None
    not_before_ns: int | None = None


class FfcPolicy:
    """Decides for all cameras of a rig; times are on CLOCK_MONOTONIC; safe to use from threads.

    Each camera's control reports with ``observe``, asks with ``take_order``, and tells the outcome
    with ``finished``.
    """

    def __init__(self, config: FfcConfig, cameras: Sequence[str], now_ns: int) -> None:
        self._config = config
        self._lock = threading.Lock()
        # A camera corrects itself when it is powered up.  Staggered, the second is due halfway.
        lead_ns = 0
        if config.schedule == "staggered":
            lead_ns = round(config.period_s * 1e9 / len(cameras))
        self._eyes = {
            camera: _Eye(last_ns=now_ns - index * lead_ns) for index, camera in enumerate(cameras)
        }
        self._inhibited_until_ns: int | None = None

    def inhibit(self, now_ns: int) -> None:
        """No corrections for now; ask again before ``inhibit_limit_s`` to prolong it."""
        with self._lock:
            self._inhibited_until_ns = now_ns + round(self._config.inhibit_limit_s * 1e9)

    def release(self) -> None:
        """Corrections may take place again."""
        with self._lock:
            self._inhibited_until_ns = None

    def inhibited(self, now_ns: int) -> bool:
        """Whether an inhibition holds."""
        return self._inhibited_until_ns is not None and now_ns < self._inhibited_until_ns

    def camera_may_decide(self, now_ns: int) -> bool:
        """Whether the camera's own automatic mode shall be on."""
        return self._config.authority == "camera" and not self.inhibited(now_ns)

    def request(self, camera: str | None = None) -> None:
        """Somebody asks for a correction of one or all cameras, inhibited or not."""
        with self._lock:
            for name, eye in self._eyes.items():
                if camera in (None, name):
                    eye.requested = True

    def observe(
        self, camera: str, now_ns: int, flags: StatusFlags, fpa_kelvin: float | None
    ) -> None:
        """What a camera says of itself."""
        with self._lock:
            eye = self._eyes[camera]
            eye.flags = flags
            if fpa_kelvin is not None:
                eye.fpa_kelvin = fpa_kelvin
                if eye.fpa_at_last_kelvin is None:
                    eye.fpa_at_last_kelvin = fpa_kelvin
            if not flags.asks_for_ffc:
                eye.asking_since_ns = None
            elif eye.asking_since_ns is None:
                eye.asking_since_ns = now_ns

    def take_order(self, camera: str, now_ns: int) -> FfcOrder | None:
        """What the camera shall do now; an order counts as begun."""
        with self._lock:
            eye = self._eyes[camera]
            reason = self._reason(eye, now_ns)
            if not reason or eye.running or self._too_close_to_another(camera, now_ns):
                return None
            if eye.joins_until_ns is None and self._config.schedule == "together":
                for other in self._eyes.values():
                    other.joins_until_ns = now_ns + _JOIN_NS
            eye.running, eye.requested, eye.joins_until_ns = True, False, None
            return FfcOrder(long=eye.flags.asks_for_long_ffc, reason=reason)

    def finished(self, camera: str, now_ns: int, *, done: bool) -> None:
        """The correction that was ordered is over, or has failed and will be tried again."""
        with self._lock:
            eye = self._eyes[camera]
            eye.running = False
            eye.ended_ns = now_ns
            if done:
                eye.last_ns = now_ns
                eye.fpa_at_last_kelvin = eye.fpa_kelvin
                eye.asking_since_ns = None
                eye.flags = NO_FLAGS
                eye.not_before_ns = None
            else:
                eye.not_before_ns = now_ns + _RETRY_NS

    def _reason(self, eye: _Eye, now_ns: int) -> str:
        config = self._config
        if eye.requested:
            return "requested"
        if eye.joins_until_ns is not None:
            if now_ns <= eye.joins_until_ns:
                return "together with the other camera"
            eye.joins_until_ns = None
        if config.authority == "none":
            return ""
        if eye.not_before_ns is not None and now_ns < eye.not_before_ns:
            return ""
        if eye.asking_since_ns is not None:
            asked_ns = now_ns - eye.asking_since_ns
            if asked_ns >= config.force_after_s * 1e9:
                return f"the camera has asked for {asked_ns * 1e-9:.0f} s"
        if config.authority == "camera" or self.inhibited(now_ns):
            return ""
        if eye.asking_since_ns is not None:
            return "the camera asks for it"
        if config.period_s and now_ns - eye.last_ns >= config.period_s * 1e9:
            return "period"
        if (
            config.temperature_delta_kelvin
            and eye.fpa_kelvin is not None
            and eye.fpa_at_last_kelvin is not None
            and abs(eye.fpa_kelvin - eye.fpa_at_last_kelvin) >= config.temperature_delta_kelvin
        ):
            return "temperature"
        return ""

    def _too_close_to_another(self, camera: str, now_ns: int) -> bool:
        if self._config.schedule == "together":
            return False
        separation_ns = self._config.separation_s * 1e9
        return any(
            other.running
            or (other.ended_ns is not None and now_ns - other.ended_ns < separation_ns)
            for name, other in self._eyes.items()
            if name != camera
        )
