"""The machine under the figures: a time without it says nothing."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

from thermal_stereo_vo.outputs.run_folder import versions


def machine() -> dict[str, Any]:
    """Processor, cores, load of the last one and five minutes, versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": list(os.getloadavg()[:2]) if hasattr(os, "getloadavg") else None,
        "versions": versions(),
    }


def machine_line() -> str:
    """The same in a sentence."""
    found = machine()
    load = "" if found["load"] is None else ", load {:.1f} {:.1f}".format(*found["load"])
    return (
        f"{found['processor']}, {found['cores']} cores{load}; Python "
        f"{found['versions']['python']}, numpy {found['versions']['numpy']}, OpenCV "
        f"{found['versions']['opencv']}, numba {found['versions']['numba']}"
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
