"""What the measurements on a recording have in common: its frames, and where the figures go."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_config,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress
from thermal_stereo_vo.cli.source_arguments import add_source_arguments, source_options

if TYPE_CHECKING:
    from thermal_stereo_vo.benchmarks.recorded import Recorded
    from thermal_stereo_vo.pipeline import Config

DEFAULT_SOURCE = "sim:corridor"


def add_recording_arguments(parser: argparse.ArgumentParser, pairs: int | None) -> None:
    """``--source`` and all about it; ``pairs`` is how many are taken unless told (None: all)."""
    add_source_arguments(parser, DEFAULT_SOURCE)
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help=f"pairs to take from the beginning (default {'all' if pairs is None else pairs})",
    )
    add_config_arguments(parser)
    add_output_arguments(parser)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """``--output`` and ``--quiet``."""
    parser.add_argument("--output", type=Path, metavar="F", help="file for the figures as JSON")
    parser.add_argument("--quiet", action="store_true", help="draw no progress bar")


def read_recording(args: argparse.Namespace, pairs: int | None) -> tuple[Config, Recorded]:
    """Settings and frames of the source, read or rendered before anything is measured.

    Raises ThermalStereoError for settings or a source that cannot be used.
    """
    from thermal_stereo_vo.benchmarks.recorded import record
    from thermal_stereo_vo.datasets.registry import open_dataset

    if args.frames is not None:
        require_positive(args, "frames")
        pairs = args.frames
    config = load_config(args)
    dataset, _ = open_dataset(args.source, source_options(args, simulation_overrides(args)))
    total = dataset.instants()
    if pairs is not None:
        total = pairs if total is None else min(total, pairs)
    with progress(total, "pair", quiet=args.quiet, label="reading") as step:
        recorded = record(dataset, config.rectification, pairs=pairs, on_progress=step)
    return config, recorded


def require_positive(args: argparse.Namespace, name: str) -> None:
    """Raise ConfigError for a count below 1."""
    from thermal_stereo_vo.core.errors import ConfigError

    value = getattr(args, name)
    if value < 1:
        raise ConfigError(f"--{name} must be 1 or more, not {value}")


def title(recorded: Recorded) -> str:
    """The recording in a few words."""
    width, height = recorded.image_size
    bits = recorded.frames[0].image.dtype.itemsize * 8
    return f"{recorded.name}: {recorded.pairs} pairs of {width}x{height}, {bits} bit"


def report(args: argparse.Namespace, text: str, figures: Any) -> int:
    """Print what was found and the machine it was found on; ``--output`` gets the figures."""
    from thermal_stereo_vo.benchmarks.machine import machine, machine_line
    from thermal_stereo_vo.core.errors import ConfigError
    from thermal_stereo_vo.outputs.replacing import write_text
    from thermal_stereo_vo.outputs.run_folder import to_json

    print(text)
    print(f"\nmeasured on {machine_line()}")
    if args.output is not None:
        try:
            write_text(args.output, to_json({"machine": machine(), "figures": figures}))
        except OSError as error:
            raise ConfigError(f"{args.output} cannot be written: {error.strerror}") from None
    return 0
