"""``check-config F``: all mistakes of a configuration file at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from thermal_stereo_vo.cli.config_arguments import load_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``check-config``."""
    parser.add_argument("config", type=Path, metavar="F", help="YAML file with settings")


def run(args: argparse.Namespace) -> int:
    """Read the file and say what it changes."""
    from thermal_stereo_vo.core.config import flatten
    from thermal_stereo_vo.pipeline import Config

    config = load_config(argparse.Namespace(config=args.config, overrides=[], method=None))
    defaults = flatten(Config())
    changed = {key: value for key, value in flatten(config).items() if value != defaults[key]}
    print(f"{args.config}: no mistakes, {len(changed)} settings differ from their defaults")
    for key, value in changed.items():
        print(f"  {key}: {value}")
    return 0
