"""``dump-config``: every setting with its default, unit, range and sentence."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.config_arguments import add_config_arguments, load_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``dump-config``."""
    add_config_arguments(parser)
    parser.add_argument(
        "--markdown", action="store_true", help="a table instead of YAML, as in docs/parameters.md"
    )


def run(args: argparse.Namespace) -> int:
    """Print the YAML document, or the table."""
    from thermal_stereo_vo.core.config import dump_yaml, markdown_table

    config = load_config(args)
    print(markdown_table(type(config)) if args.markdown else dump_yaml(config), end="")
    return 0
