"""Our structures and numbers against the kernel header of this machine."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from thermal_stereo_vo.capture import v4l2_abi as abi
from thermal_stereo_vo.capture.pixel_format import PIXEL_FORMATS

STRUCTURES = {
    abi.Capability: "v4l2_capability",
    abi.FormatDescription: "v4l2_fmtdesc",
    abi.FrameSizes: "v4l2_frmsizeenum",
    abi.PixFormat: "v4l2_pix_format",
    abi.Format: "v4l2_format",
    abi.Fraction: "v4l2_fract",
    abi.StreamParameters: "v4l2_streamparm",
    abi.RequestBuffers: "v4l2_requestbuffers",
    abi.Buffer: "v4l2_buffer",
    abi.Input: "v4l2_input",
}
NESTED = {
    "v4l2_format": {"pix": "fmt.pix"},
    "v4l2_frmsizeenum": {"discrete": "discrete", "stepwise": "stepwise"},
    "v4l2_streamparm": {"capture": "parm.capture"},
    "v4l2_buffer": {"offset": "m.offset"},
}
REQUESTS = (
    *("QUERYCAP", "ENUM_FMT", "S_FMT", "REQBUFS", "QUERYBUF", "QBUF", "DQBUF", "STREAMON"),
    *("STREAMOFF", "G_PARM", "S_PARM", "G_STD", "S_STD", "ENUMINPUT", "G_INPUT", "S_INPUT"),
    *("QUERYSTD", "ENUM_FRAMESIZES"),
)
CONSTANTS = (
    *("BUF_TYPE_VIDEO_CAPTURE", "MEMORY_MMAP", "FIELD_ANY", "FIELD_NONE", "FIELD_TOP"),
    *("FIELD_BOTTOM", "FIELD_ALTERNATE", "CAP_VIDEO_CAPTURE", "CAP_STREAMING", "CAP_DEVICE_CAPS"),
    *("CAP_TIMEPERFRAME", "BUF_FLAG_ERROR", "BUF_FLAG_TIMESTAMP_MASK"),
    *("BUF_FLAG_TIMESTAMP_MONOTONIC", "BUF_FLAG_TSTAMP_SRC_MASK", "BUF_FLAG_TSTAMP_SRC_SOE"),
    "FRMSIZE_TYPE_DISCRETE",
)
FAULTS = {
    "no power": "NO_POWER",
    "no signal": "NO_SIGNAL",
    "no horizontal lock": "NO_H_LOCK",
    "no vertical lock": "NO_V_LOCK",
    "no synchronisation lock": "NO_SYNC",
    "no equaliser lock": "NO_EQU",
    "no carrier": "NO_CARRIER",
}


def claims():
    """C expression -> what we believe it is."""
    for cls, name in STRUCTURES.items():
        yield f"sizeof(struct {name})", ctypes.sizeof(cls)
        for field, *_ in cls._fields_:
            if field in ("fmt", "sizes", "parm", "m", "align"):
                continue
            yield f"offsetof(struct {name}, {field})", getattr(cls, field).offset
        for ours, theirs in NESTED.get(name, {}).items():
            yield f"offsetof(struct {name}, {theirs})", getattr(cls, ours).offset
    for name in REQUESTS:
        yield f"VIDIOC_{name}", getattr(abi, name)
    for name in CONSTANTS:
        yield f"V4L2_{name}", getattr(abi, name)
    for pixel_format in PIXEL_FORMATS.values():
        name = pixel_format.name.replace("-", "_")
        yield f"V4L2_PIX_FMT_{name}", pixel_format.code
    for name, mask in abi.STANDARDS.items():
        yield f"V4L2_STD_{name}", mask
    for bit, text in abi.IN_ST_FAULTS.items():
        yield f"V4L2_IN_ST_{FAULTS[text]}", bit


def test_layouts_and_numbers_are_those_of_the_header(tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        message = "a C compiler and the kernel headers are needed (apt install gcc linux-libc-dev)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    ours = dict(claims())
    lines = "\n".join(f'printf("%llu\\n", (unsigned long long)({c}));' for c in ours)
    source = tmp_path / "claims.c"
    source.write_text(
        "#include <stdio.h>\n#include <stddef.h>\n#include <sys/time.h>\n"
        f"#include <linux/videodev2.h>\nint main(void) {{\n{lines}\nreturn 0;\n}}\n"
    )
    subprocess.run([compiler, "-o", tmp_path / "claims", source], check=True)
    output = subprocess.run([tmp_path / "claims"], check=True, capture_output=True, text=True)
    theirs = dict(zip(ours, map(int, output.stdout.split()), strict=True))
    assert {k: v for k, v in ours.items() if v != theirs[k]} == {}


def test_field_names_stand_at_their_numbers():
    assert abi.FIELD_NAMES[abi.FIELD_NONE] == "progressive"
    assert abi.FIELD_NAMES[abi.FIELD_TOP] == "top field only"
    assert abi.FIELD_NAMES[abi.FIELD_BOTTOM] == "bottom field only"
    assert abi.FIELD_NAMES[abi.FIELD_ALTERNATE] == "alternating fields"
