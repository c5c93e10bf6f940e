"""What the documents say is still true."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

from thermal_stereo_vo.cli.main import VERBS, main
from thermal_stereo_vo.core.calibration_yaml import parse_rig
from thermal_stereo_vo.stereo.undistortion import Undistorter

REPOSITORY = Path(__file__).resolve().parent.parent


def test_the_table_of_parameters_is_that_of_the_code(capsys):
    text = (REPOSITORY / "docs" / "parameters.md").read_text(encoding="utf-8")
    assert main(["dump-config", "--markdown"]) == 0
    assert text == capsys.readouterr().out, (
        "put the output of `dump-config --markdown` into docs/parameters.md"
    )


def test_the_readme_shows_every_picture_it_names():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert pictures
    for picture in pictures:
        assert (REPOSITORY / picture).is_file(), picture


def test_the_readme_names_only_verbs_and_nodes_that_exist():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^    \.\.\. ([a-z-]+)", text, flags=re.MULTILINE))
    assert named
    assert named <= set(VERBS)
    nodes = set(re.findall(r"^\| `([a-z_]+_node)`", text, flags=re.MULTILINE))
    setup = (REPOSITORY / "setup.py").read_text(encoding="utf-8")
    assert nodes == set(re.findall(r'"([a-z_]+_node)"', setup))


def test_the_example_of_a_rig_of_two_bands_is_one():
    text = (REPOSITORY / "docs" / "multispectral.md").read_text(encoding="utf-8")
    block = re.search(r"^    cameras:\n(?:^ {4,}.*\n)+", text, flags=re.MULTILINE)
    assert block is not None
    rig = parse_rig(textwrap.dedent(block[0]), Path("example"))
    assert Undistorter(rig, ("visible", "thermal")).roles == tuple(rig.cameras)
