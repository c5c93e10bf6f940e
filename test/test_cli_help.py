"""Every verb explains itself, and does so without loading what it would need for its work."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from thermal_stereo_vo import __version__
from thermal_stereo_vo.cli.main import VERBS

REPOSITORY = Path(__file__).resolve().parent.parent
HEAVY = ["cv2", "matplotlib", "numba", "rosbags", "scipy", "trimesh"]


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "thermal_stereo_vo", *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.mark.parametrize("verb", VERBS)
def test_verb_has_help_and_loads_nothing_heavy(verb: str) -> None:
    """The time of a start is the time of its imports."""
    program = f"""
import sys
from thermal_stereo_vo.cli.main import main
try:
    main([{verb!r}, "--help"])
except SystemExit as end:
    assert end.code == 0, end.code
print("HEAVY", sorted(set({HEAVY!r}) & set(sys.modules)))
"""
    run = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert run.returncode == 0, run.stderr
    assert f"usage: python3 -m thermal_stereo_vo {verb}" in run.stdout
    assert run.stdout.splitlines()[-1] == "HEAVY []"


def test_overview_lists_every_verb() -> None:
    run = command("--help")
    assert run.returncode == 0
    assert set(VERBS) <= set(run.stdout.split())


def test_version_is_the_package_s() -> None:
    assert command("--version").stdout.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [((), "the following arguments are required: VERB"), (("fly",), "invalid choice: 'fly'")],
)
def test_wrong_use_is_code_2(arguments: tuple[str, ...], complaint: str) -> None:
    run = command(*arguments)
    assert run.returncode == 2
    assert complaint in run.stderr
    assert "Traceback" not in run.stderr
