"""``benchmark``: what the methods cost and what they are worth, measured on this machine."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from thermal_stereo_vo.cli.benchmark_stages import add_stages_arguments, run_stages

MEASUREMENTS = {
    "scaling": "time against image size, features and window",
    "gaps": "accuracy with pairs replaced by copies or a shutter",
    "ffc": "simulated flights with and without flat-field corrections",
    "solvers": "Gauss-Newton, Levenberg-Marquardt and Double Dogleg on the same problems",
    "calibration": "simulated board views against the true rig, and a flight with the result",
    "table5": "nine simulated flights by every method: Table V of the paper",
    "multispectral": "visible + thermal runs by both cameras and by each alone: Table II of P2",
    "simulate": "pictures a second, processor time and memory of the simulator",
    "radiometry": "flat field, gate and scene-based refinement on real recordings",
    "shutterless": "odometry while the cores warm up without a shutter",
    "dense": "dense stereo by day and night beside plain OpenCV",
    "extrinsics": "simulated flights with an error in the yaw between the eyes",
    "reconstruction": "a model of a simulated street against its true surface and temperature",
    "plane": "dense points on the boards of a real thermal pair",
    "painting": "temperatures on the cloud of a visible camera",
    "enhancement": "odometry on 8-bit views made in several ways",
}
"""WHAT -> sentence.  The module ``benchmark_WHAT`` has ``add_WHAT_arguments`` and ``run_WHAT``."""

INHERITING = ("scaling", "gaps", "solvers")


class _MeasurementParser(argparse.ArgumentParser):
    """Where ``inherits``: what is not said after WHAT is as it was said, or not, before it."""

    inherits = False

    def add_argument(self, *names: str, **options: Any) -> argparse.Action:
        if self.inherits:
            options["default"] = argparse.SUPPRESS
        return super().add_argument(*names, **options)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``benchmark`` and of everything that may follow it."""
    parser.description = (
        "Measure the time of every stage, frame to frame and windowed, on one thread and on two, "
        "in turns with an OpenCV baseline; or what is named by WHAT."
    )
    add_stages_arguments(parser)
    parser.set_defaults(measure=run_stages)
    whats = parser.add_subparsers(
        dest="what", metavar="WHAT", title="other measurements", parser_class=_MeasurementParser
    )
    for what, sentence in MEASUREMENTS.items():
        module = importlib.import_module(f"thermal_stereo_vo.cli.benchmark_{what}")
        sub = whats.add_parser(
            what, help=sentence, description=f"{sentence[0].upper()}{sentence[1:]}."
        )
        sub.inherits = what in INHERITING
        getattr(module, f"add_{what}_arguments")(sub)
        sub.set_defaults(measure=getattr(module, f"run_{what}"))


def run(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    return int(args.measure(args))
