"""The arguments that change settings, alike in every verb that runs the pipeline."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from thermal_stereo_vo.pipeline import Config

Settings = TypeVar("Settings")

SIMULATION_PREFIX = "sim."


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """``--config``, ``--set`` and ``--method``."""
    parser.add_argument("--config", type=Path, metavar="F", help="YAML file with settings")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one setting, e.g. odometry.solver=gauss_newton; sim.KEY=VALUE changes the "
        "simulated run; may be repeated",
    )
    parser.add_argument("--method", metavar="NAME", help="same as --set odometry.method=NAME")


def load_config(args: argparse.Namespace) -> Config:
    """The settings of the pipeline, as ``load_settings`` gathers them."""
    from thermal_stereo_vo.pipeline import Config

    return load_settings(args, Config())


def load_settings(args: argparse.Namespace, defaults: Settings) -> Settings:
    """Defaults, then the file, then ``--set``, then ``--method``.

    Raises ConfigError that names every unknown or impossible setting.
    """
    from thermal_stereo_vo.core.config import load_yaml, with_overrides
    from thermal_stereo_vo.core.errors import ConfigError

    config = defaults
    if args.config is not None:
        try:
            text = args.config.read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"cannot read the settings {args.config}: {error.strerror}") from None
        config = load_yaml(type(config), text, origin=str(args.config), base=config)
    overrides = [text for text in args.overrides if not text.startswith(SIMULATION_PREFIX)]
    if args.method is not None:
        overrides.append(f"odometry.method={args.method}")
    return with_overrides(config, overrides)


def simulation_overrides(args: argparse.Namespace) -> tuple[str, ...]:
    """The ``--set sim.KEY=VALUE`` texts without their prefix."""
    return tuple(
        text.removeprefix(SIMULATION_PREFIX)
        for text in args.overrides
        if text.startswith(SIMULATION_PREFIX)
    )
