"""``dump-config``: every setting with its default, unit, range and sentence."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.config_arguments import add_config_arguments, load_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``dump-config``."""
    add_config_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the YAML document."""
    from thermal_stereo_vo.core.config import dump_yaml

    print(dump_yaml(load_config(args)), end="")
    return 0
