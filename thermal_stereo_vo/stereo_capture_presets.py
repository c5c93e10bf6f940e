"""Ready settings for usual rigs; ``config/stereo_capture_*.yaml`` are written from them."""

from __future__ import annotations

import textwrap
from typing import Any

from thermal_stereo_vo.core.config import dump_yaml, from_mapping
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.stereo_capture import StereoCaptureConfig

_NTSC_FRAME_MS = 33.4

_COMMON = {
    "left_calibration": "file:///etc/thermal_stereo_vo/left.yaml",
    "right_calibration": "file:///etc/thermal_stereo_vo/right.yaml",
}


def _eyes(**stream: Any) -> dict[str, Any]:
    return {eye: {"device": f"/dev/thermal_{eye}", **stream} for eye in ("left", "right")}


_PRESETS: dict[str, tuple[str, dict[str, Any]]] = {
    "sensoray": (
        "Two Tau 2 with analog video on one Sensoray 2255 grabber, control over serial ports.\n"
        "The driver stamps a complete frame, hence the stamp_offset_ms of one frame.",
        {
            "sync": {"mode": "hardware", "max_skew_ms": 2.0},
            "grabbers": {
                **_eyes(
                    pixel_format="GREY",
                    width=640,
                    height=480,
                    standard="NTSC",
                    stamp_offset_ms=-_NTSC_FRAME_MS,
                ),
                "control": {
                    "left_port": "/dev/thermal_left_control",
                    "right_port": "/dev/thermal_right_control",
                },
                "camera": {
                    "gain_mode": "high",
                    "video_standard": "NTSC_30",
                    "zoom": "1x",
                    "external_sync": "left_master",
                    "ffc_warn_frames": 0,
                },
            },
        },
    ),
    "boson": (
        "Two Boson 640 on USB, 16 bits.  Their control protocol is another one: they correct\n"
        "themselves, and the frame gate sees it in the images.",
        {
            "pairing": {"tolerance_ms": 8.0},
            "sync": {"mode": "hardware", "max_skew_ms": 2.0},
            "grabbers": {
                **_eyes(pixel_format="Y16", width=640, height=512, rate_hz=60.0),
                "ffc": {"authority": "none"},
            },
        },
    ),
    "analog": (
        "Two analog thermal cameras on cheap USB grabbers (720 samples a line), 8 bits, free\n"
        "running.",
        {
            "pairing": {"tolerance_ms": 20.0},
            "grabbers": {
                **_eyes(width=720, height=480, standard="NTSC", stamp_offset_ms=-_NTSC_FRAME_MS),
                "ffc": {"authority": "none"},
            },
        },
    ),
}

PRESETS = tuple(_PRESETS)


def preset(name: str) -> StereoCaptureConfig:
    """The settings of a usual rig.  Raises ConfigError for an unknown name."""
    try:
        _, mapping = _PRESETS[name]
    except KeyError:
        raise ConfigError(
            f"there is no preset '{name}' of stereo_capture: choose {', '.join(PRESETS)}"
        ) from None
    return from_mapping(StereoCaptureConfig, {**_COMMON, **mapping})


def preset_text(name: str) -> str:
    """A preset as a parameter file of the node.  Raises ConfigError for an unknown name."""
    settings = textwrap.indent(dump_yaml(preset(name)), "    ")
    title = textwrap.indent(_PRESETS[name][0], "# ")
    return f"{title}\n\n/**/stereo_capture:\n  ros__parameters:\n{settings}"
