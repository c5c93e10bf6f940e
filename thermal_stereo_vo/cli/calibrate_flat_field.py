"""``calibrate flat-field``: recordings of uniform sources to one flat-field file."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Fit offset and gain of every pixel as polynomials of the FPA temperature, find bad pixels, and write
one file for radiometry.flat_field.file.

Each SOURCE is a folder of uniform frames (.npz with frames and fpa_kelvin; or .raw or .png beside
a .txt with fpaTemperatureC), or a bag with FPA temperatures.  For a gain, show a cold and a warm
source and add their temperatures: cold=5 warm=40.
"""

HELD_OUT_AT_LEAST = 3


def add_flat_field_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_flat_field`` reads."""
    parser.description = DESCRIPTION
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "sources",
        nargs="+",
        metavar="SOURCE[=CELSIUS]",
        help="folder, .npz file or bag of uniform frames, and the temperature of their source",
    )
    parser.add_argument("--output", required=True, metavar="FILE", help="the .npz file to write")
    parser.add_argument("--camera", default="", help="role of the camera: left, right, ...")
    parser.add_argument("--serial", default="", help="serial number where the frames tell none")
    parser.add_argument(
        "--offset-degree",
        type=int,
        choices=range(7),
        metavar="0..6",
        help="degree of the offset over FPA temperature (default: up to 4)",
    )
    parser.add_argument(
        "--gain-degree",
        choices=("auto", "none", "0", "1", "2"),
        default="auto",
        help="degree of the gain; auto: 0 when sources of two temperatures were shown, else none",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing")


def run_flat_field(args: argparse.Namespace) -> int:
    """Calibrate and report; returns the exit code.

    Raises:
        ThermalStereoError: for input that cannot be used.
    """
    from dataclasses import replace

    import numpy as np

    from thermal_stereo_vo.calibration.flat_field_recordings import join, read_flat_fields
    from thermal_stereo_vo.calibration.radiometric import (
        FlatFieldOrders,
        describe_fit,
        every_second_temperature,
        fit_flat_field,
        held_out_counts,
    )
    from thermal_stereo_vo.radiometry.flat_field_file import save_flat_field

    recordings = []
    for text in args.sources:
        path, source_kelvin = _source(text)
        recordings.append(read_flat_fields(path, camera=args.camera, source_kelvin=source_kelvin))
    recording = join(recordings)
    if args.serial:
        recording = join([recording, replace(recording, frames=(), serial=args.serial)])
    gain: int | None = {"auto": -1, "none": None}.get(args.gain_degree, 0)
    if args.gain_degree.isdigit():
        gain = int(args.gain_degree)
    orders = FlatFieldOrders(offset=args.offset_degree, gain=gain)
    calibration = fit_flat_field(
        recording.frames,
        serial=recording.serial,
        camera=args.camera or recording.camera,
        orders=orders,
    )
    save_flat_field(args.output, calibration)
    if args.quiet:
        return 0
    print(describe_fit(calibration))
    if len(every_second_temperature(recording.frames)[1]) >= HELD_OUT_AT_LEAST:
        held_out = held_out_counts(recording.frames, orders)
        print(
            f"every second temperature held out: residual {np.median(held_out):.2f} counts "
            f"(median), {held_out.max():.2f} (largest)"
        )
    print(f"{args.output}: {calibration.describe()}")
    return 0


def _source(text: str) -> tuple[str, float | None]:
    """Path and source temperature (K) of ``PATH`` or ``PATH=CELSIUS``."""
    from thermal_stereo_vo.radiometry.flat_field import KELVIN

    path, equals, celsius = text.rpartition("=")
    if not equals:
        return text, None
    try:
        return path, float(celsius) + KELVIN
    except ValueError:
        return text, None
