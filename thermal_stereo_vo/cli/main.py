"""The command line: one verb, one module, imported only when it is called for."""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from collections.abc import Sequence

from thermal_stereo_vo import __version__
from thermal_stereo_vo.core.errors import ThermalStereoError

DONE, FAULT, WRONG_USE, INTERRUPTED = 0, 1, 2, 130

VERBS = {
    "replay": ("replay", "run the odometry over a recording or a simulated flight"),
    "reconstruct": (
        "reconstruct",
        "make a model, with temperatures, of what was seen",
    ),
    "paint": ("paint", "paint a cloud with the temperatures that another camera sees"),
    "evaluate": ("evaluate", "compare a trajectory with the truth"),
    "simulate": ("simulate", "fly a simulated rig and write a ROS 2 bag"),
    "import-dataset": ("import_dataset", "turn any recording into a ROS 2 bag"),
    "inspect-bag": ("inspect_bag", "tell what a bag holds and how well left and right pair"),
    "calibrate": ("calibrate", "calibrate cameras, stereo rigs and flat fields"),
    "benchmark": ("benchmark", "measure the time of every stage"),
    "check-config": ("check_config", "check a configuration file"),
    "dump-config": ("dump_config", "write the settings with their defaults, units and ranges"),
}
"""Verb -> (module in this folder, sentence).  Each module has ``add_arguments`` and ``run``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code: 0 done, 2 wrong use or input, 1 a fault of ours."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = argparse.ArgumentParser(
        prog="python3 -m thermal_stereo_vo",
        description="Thermal stereo odometry: replay, evaluate, simulate, calibrate.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for verb, (module_name, sentence) in VERBS.items():
        sub = verbs.add_parser(
            verb, help=sentence, description=f"{sentence[0].upper()}{sentence[1:]}."
        )
        if arguments[:1] == [verb]:
            # Only the verb that is asked for pays for its imports.
            module = importlib.import_module(f"thermal_stereo_vo.cli.{module_name}")
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    args = parser.parse_args(arguments)
    try:
        return int(args.run(args))
    except ThermalStereoError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_USE
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return DONE
    except Exception:
        traceback.print_exc()
        print("error: this is a fault of the program, please report it", file=sys.stderr)
        return FAULT
