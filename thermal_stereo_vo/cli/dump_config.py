"""``dump-config``: every setting with its default, unit, range and sentence."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.config_arguments import add_config_arguments, load_config

MARKDOWN_HEAD = """\
# Parameters

Every setting of the pipeline, for `--set`, YAML files and ROS parameters. Generated: \
`python3 -m thermal_stereo_vo dump-config --markdown`.

"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``dump-config``."""
    add_config_arguments(parser)
    parser.add_argument(
        "--markdown", action="store_true", help="docs/parameters.md, a table, instead of YAML"
    )
    parser.add_argument(
        "--capture",
        metavar="RIG",
        help="the parameter file of stereo_capture_node instead, for two cameras of the kind "
        "sensoray (Tau 2 on Sensoray grabbers), boson (USB) or analog (8 bits)",
    )


def run(args: argparse.Namespace) -> int:
    """Print the YAML document, the table, or the settings of a rig."""
    if args.capture is not None:
        from thermal_stereo_vo.stereo_capture_presets import preset_text

        print(preset_text(args.capture), end="")
        return 0
    from thermal_stereo_vo.core.config import dump_yaml, markdown_table

    config = load_config(args)
    print(
        MARKDOWN_HEAD + markdown_table(type(config)) if args.markdown else dump_yaml(config), end=""
    )
    return 0
