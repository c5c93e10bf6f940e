"""Agree with a video device on input, standard, format and rate, or refuse with what it offers."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from dataclasses import dataclass

from thermal_stereo_vo.capture import v4l2_abi as abi
from thermal_stereo_vo.capture.pixel_format import (
    PIXEL_FORMATS,
    PixelFormat,
    fourcc_name,
)
from thermal_stereo_vo.capture.stream_config import StreamConfig
from thermal_stereo_vo.core.errors import CaptureError


@dataclass(frozen=True)
class StreamFormat:
    """What a device delivers.  ``rate_hz`` is None where the driver does not say."""

    driver: str
    card: str
    bus: str
    pixel_format: PixelFormat
    width: int
    height: int
    bytes_per_line: int
    field: str
    rate_hz: float | None
    input: str
    standard: str
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:.4g} Hz"
        return f"{self.pixel_format.name} {self.width}x{self.height}{rate} from {self.card}"


def negotiate(fd: int, device: str, config: StreamConfig) -> StreamFormat:
    """Configure the open device ``fd`` as ``config`` asks.

    Raises CaptureError that lists what the device offers instead.
    """
    capability = read_capability(fd, device)
    warnings: list[str] = []
    chosen_input = _choose_input(fd, device, config.input)
    standard = _choose_standard(fd, device, config.standard)
    pixel_format = _choose_pixel_format(fd, device, config.pixel_format)
    pix = _set_format(fd, device, config, pixel_format)
    rate_hz = _set_rate(fd, config.rate_hz)
    if config.rate_hz and rate_hz and not math.isclose(rate_hz, config.rate_hz, rel_tol=0.02):
        warnings.append(f"asked for {config.rate_hz:g} Hz, the driver gives {rate_hz:.4g} Hz")
    return StreamFormat(
        driver=capability.driver.decode("utf-8", "replace"),
        card=capability.card.decode("utf-8", "replace"),
        bus=capability.bus_info.decode("utf-8", "replace"),
        pixel_format=pixel_format,
        width=pix.width,
        height=pix.height,
        bytes_per_line=pix.bytesperline or pix.width * pixel_format.step,
        field=abi.FIELD_NAMES[pix.field] if pix.field < len(abi.FIELD_NAMES) else str(pix.field),
        rate_hz=rate_hz,
        input=chosen_input,
        standard=standard,
        warnings=tuple(warnings),
    )


def read_capability(fd: int, device: str) -> abi.Capability:
    """The device's own description.  Raises CaptureError for anything that cannot stream video."""
    capability = abi.Capability()
    if not abi.try_ioctl(fd, abi.QUERYCAP, capability):
        raise CaptureError(f"{device} is not a video device: name a V4L2 capture node")
    has_own = capability.capabilities & abi.CAP_DEVICE_CAPS
    caps = capability.device_caps if has_own else capability.capabilities
    if not caps & abi.CAP_VIDEO_CAPTURE or not caps & abi.CAP_STREAMING:
        raise CaptureError(
            f"{device} ({capability.card.decode('utf-8', 'replace')}) cannot stream video: a "
            "camera often has a second node for metadata, name the one with index 0"
        )
    return capability


def input_fault(fd: int) -> str | None:
    """What the driver says is wrong at the current input (``no signal``), or None."""
    index = ctypes.c_int()
    description = abi.Input()
    if not abi.try_ioctl(fd, abi.G_INPUT, index):
        return None
    description.index = index.value
    if not abi.try_ioctl(fd, abi.ENUMINPUT, description):
        return None
    faults = [text for bit, text in abi.IN_ST_FAULTS.items() if description.status & bit]
    return ", ".join(faults) or None


def offered_formats(fd: int) -> list[int]:
    """Codes of the pixel formats, in the order of the driver."""
    codes = []
    for index in range(256):
        description = abi.FormatDescription(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE)
        if not abi.try_ioctl(fd, abi.ENUM_FMT, description):
            break
        codes.append(description.pixelformat)
    return codes


def describe_offer(fd: int) -> str:
    """``Y16 (640x512, 320x256), GREY (2x1 to 800x600 in steps of 2x1); not usable here: MJPG``."""
    usable = {pixel_format.code for pixel_format in PIXEL_FORMATS.values()}
    offered = offered_formats(fd)
    offers = []
    for code in offered:
        if code in usable:
            sizes = ", ".join(_sizes(fd, code))
            offers.append(f"{fourcc_name(code)} ({sizes})" if sizes else fourcc_name(code))
    text = ", ".join(offers) or "nothing"
    others = [fourcc_name(code) for code in offered if code not in usable]
    return f"{text}; not usable here: {', '.join(others)}" if others else text


def _sizes(fd: int, code: int) -> Iterator[str]:
    for index in range(64):
        entry = abi.FrameSizes(index=index, pixel_format=code)
        if not abi.try_ioctl(fd, abi.ENUM_FRAMESIZES, entry):
            return
        if entry.type == abi.FRMSIZE_TYPE_DISCRETE:
            yield f"{entry.discrete.width}x{entry.discrete.height}"
        else:
            steps = entry.stepwise
            yield (
                f"{steps.min_width}x{steps.min_height} to {steps.max_width}x{steps.max_height}"
                f" in steps of {steps.step_width}x{steps.step_height}"
            )
            return


def _inputs(fd: int) -> list[str]:
    names = []
    for index in range(64):
        description = abi.Input(index=index)
        if not abi.try_ioctl(fd, abi.ENUMINPUT, description):
            break
        names.append(description.name.decode("utf-8", "replace"))
    return names


def _choose_input(fd: int, device: str, wanted: str) -> str:
    names = _inputs(fd)
    if wanted:
        if wanted in names:
            index = names.index(wanted)
        elif wanted.isdecimal() and int(wanted) < len(names):
            index = int(wanted)
        else:
            offered = ", ".join(f"{i} ({name})" for i, name in enumerate(names)) or "none"
            raise CaptureError(f"{device} has no input '{wanted}'; it has: {offered}")
        abi.ioctl(fd, abi.S_INPUT, ctypes.c_int(index))
        return names[index]
    current = ctypes.c_int()
    if abi.try_ioctl(fd, abi.G_INPUT, current) and current.value < len(names):
        return names[current.value]
    return ""


def _choose_standard(fd: int, device: str, wanted: str) -> str:
    current = ctypes.c_uint64()
    if not wanted:
        has_one = abi.try_ioctl(fd, abi.G_STD, current)
        return _standard_name(current.value) if has_one else ""
    mask = abi.STANDARDS[wanted]
    if not abi.try_ioctl(fd, abi.S_STD, ctypes.c_uint64(mask)):
        raise CaptureError(
            f"{device} does not take the television standard {wanted}: leave 'standard' empty for "
            "a digital camera, or choose the analog input"
        )
    if abi.try_ioctl(fd, abi.G_STD, current) and not current.value & mask:
        raise CaptureError(
            f"{device} was set to {wanted} but stays at {_standard_name(current.value)}"
        )
    detected = ctypes.c_uint64()
    # Zero: no signal yet.  Several bits: the grabber cannot tell them apart.
    if abi.try_ioctl(fd, abi.QUERYSTD, detected) and detected.value and not detected.value & mask:
        raise CaptureError(
            f"the camera at {device} sends {_standard_name(detected.value)}, the settings say "
            f"{wanted}: correct one of the two"
        )
    return wanted


def _standard_name(mask: int) -> str:
    names = [name for name, bits in abi.STANDARDS.items() if mask & bits]
    return "/".join(names) or f"0x{mask:x}"


def _choose_pixel_format(fd: int, device: str, wanted: str) -> PixelFormat:
    offered = set(offered_formats(fd))
    candidates = PIXEL_FORMATS if wanted == "auto" else {wanted: PIXEL_FORMATS[wanted]}
    for pixel_format in candidates.values():
        if pixel_format.code in offered:
            return pixel_format
    what = "none of " + ", ".join(PIXEL_FORMATS) if wanted == "auto" else f"no {wanted}"
    raise CaptureError(f"{device} offers {what}; it offers: {describe_offer(fd)}")


def _set_format(
    fd: int, device: str, config: StreamConfig, pixel_format: PixelFormat
) -> abi.PixFormat:
    request = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    request.pix.width = config.width
    request.pix.height = config.height
    request.pix.pixelformat = pixel_format.code
    request.pix.field = abi.FIELD_ANY
    abi.ioctl(fd, abi.S_FMT, request)
    pix: abi.PixFormat = request.pix
    got = (pix.width, pix.height, pix.pixelformat)
    if got != (config.width, config.height, pixel_format.code):
        raise CaptureError(
            f"{device} gives {fourcc_name(pix.pixelformat)} {pix.width}x{pix.height} when asked "
            f"for {pixel_format.name} {config.width}x{config.height}; it offers: "
            f"{describe_offer(fd)}"
        )
    if pix.field in (abi.FIELD_TOP, abi.FIELD_BOTTOM, abi.FIELD_ALTERNATE):
        raise CaptureError(
            f"{device} gives single fields ({abi.FIELD_NAMES[pix.field]}) of an interlaced "
            f"picture: ask for the full height ({config.height} lines asked)"
        )
    if 0 < pix.bytesperline < pix.width * pixel_format.step:
        raise CaptureError(
            f"{device} claims {pix.bytesperline} bytes for a line of {pix.width} pixels of "
            f"{pixel_format.step} bytes: its driver is broken, choose another pixel format"
        )
    return pix


def _set_rate(fd: int, rate_hz: float) -> float | None:
    parameters = abi.StreamParameters(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    if not abi.try_ioctl(fd, abi.G_PARM, parameters):
        return None
    if rate_hz and parameters.capture.capability & abi.CAP_TIMEPERFRAME:
        parameters.capture.timeperframe.numerator = 1000
        parameters.capture.timeperframe.denominator = round(rate_hz * 1000)
        abi.try_ioctl(fd, abi.S_PARM, parameters)
    interval = parameters.capture.timeperframe
    if not interval.numerator or not interval.denominator:
        return None
    return float(interval.denominator / interval.numerator)
