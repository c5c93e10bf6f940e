"""The capture on the virtual video devices of a real kernel, in a small virtual machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
MACHINE = HERE / "virtual_machine.py"
UNAVAILABLE = 77


@pytest.mark.skipif("WITHOUT_GUEST" in os.environ, reason="WITHOUT_GUEST is set")
@pytest.mark.timeout(900)
def test_passes_in_the_guest():
    tests = [sys.executable, "-m", "pytest", "-q", "--color=no", "-p", "no:cacheprovider"]
    options = ["--timeout", "840", "--env", "CAPTURE_GUEST=1"]
    # Plugins cost seconds of the emulated processor, and none is needed.
    options += ["--env", "PYTEST_DISABLE_PLUGIN_AUTOLOAD=1"]
    run = subprocess.run(
        [sys.executable, MACHINE, *options, *tests, HERE / "in_guest", "--durations=20"],
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode == UNAVAILABLE and not os.environ.get("CI"):
        pytest.skip(run.stderr.strip().splitlines()[-1])
    assert run.returncode == 0, run.stdout + run.stderr
    print(run.stdout)
