"""Settings of one camera's video stream."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.capture.pixel_format import PIXEL_FORMATS
from thermal_stereo_vo.core.config import setting


@dataclass(frozen=True)
class StreamConfig:
    """What is asked of a frame grabber."""

    device: str = setting(
        "",
        "The grabber by a name that survives a reboot: a udev path such as "
        "/dev/v4l/by-path/..., 'serial:NUMBER' or 'serial:NUMBER/CHANNEL' of the USB device, or "
        "'bus:NAME' as the driver reports it.  /dev/videoN is refused: its order is chance.",
    )
    pixel_format: str = setting(
        "auto",
        "Wire format; auto takes the one with the most bits that the grabber offers.",
        choices=("auto", *PIXEL_FORMATS),
    )
    width: int = setting(640, "Image width.", unit="px", minimum=16, maximum=8192)
    height: int = setting(512, "Image height.", unit="px", minimum=16, maximum=8192)
    rate_hz: float = setting(
        0.0, "Frame rate to ask for; 0 leaves the driver's.", unit="Hz", minimum=0.0, maximum=1000.0
    )
    input: str = setting(
        "", "Input of an analog grabber by name or number; empty leaves the driver's."
    )
    standard: str = setting(
        "",
        "Television standard of an analog camera; empty leaves the driver's.",
        choices=("", "NTSC", "PAL"),
    )
    buffers: int = setting(
        4, "Video buffers; more of them ride out longer stalls.", minimum=4, maximum=8
    )
    timeout_s: float = setting(
        1.0,
        "Silence after which the stream counts as stalled and is opened anew.",
        unit="s",
        minimum=0.05,
        maximum=60.0,
    )
    start_timeout_s: float = setting(
        6.0,
        "The same for the first frame: some grabbers load their firmware first.",
        unit="s",
        minimum=0.05,
        maximum=60.0,
    )
    settling_frames: int = setting(
        3, "Frames to drop after the stream starts: often stale or torn.", minimum=0, maximum=300
    )
    stamp_offset_ms: float = setting(
        0.0,
        "Added to every stamp: minus the exposure-to-stamp latency of this grabber.",
        unit="ms",
        minimum=-1000.0,
        maximum=1000.0,
    )
