"""The capture against fake V4L2 devices: each file of ``under_fake`` in a process of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PATIENCE_S = 800
FOLDER = Path(__file__).parent / "under_fake"


@pytest.fixture(scope="session")
def fake_library(tmp_path_factory) -> Path:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        message = "a C compiler and the kernel headers are needed (apt install gcc linux-libc-dev)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    library = tmp_path_factory.mktemp("fake_v4l2") / "fake_v4l2.so"
    options = ("-O2", "-Wall", "-Werror", "-fPIC", "-shared")
    source = FOLDER / "fake_v4l2.c"
    subprocess.run([compiler, *options, "-o", library, source, "-ldl", "-lpthread"], check=True)
    return library


@pytest.mark.parametrize("file", sorted(path.name for path in FOLDER.glob("test_*.py")))
def test_passes_under_the_fake(file, fake_library, tmp_path):
    devices = []
    for name in ("left", "right"):
        (tmp_path / name).touch()
        (tmp_path / f"{name}.control").write_bytes(bytes(4096))
        devices.append(f"{tmp_path / name}={tmp_path / name}.control")
    environment = {
        **{k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "COV_"))},
        "LD_PRELOAD": str(fake_library),
        "FAKE_V4L2": ";".join(devices),
    }
    command = [sys.executable, "-m", "pytest", "-q", "--color=no", "-p", "no:cacheprovider"]
    run = subprocess.run(
        [*command, f"--rootdir={Path.cwd()}", FOLDER / file],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    if run.returncode == pytest.ExitCode.NO_TESTS_COLLECTED:
        pytest.skip(run.stdout)
    assert run.returncode == 0, run.stdout + run.stderr
