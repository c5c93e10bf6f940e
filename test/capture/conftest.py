"""Folders whose tests need another process: started from a test beside them."""

from __future__ import annotations

import os

collect_ignore = []
if "FAKE_V4L2" not in os.environ:
    collect_ignore.append("under_fake")
if "CAPTURE_GUEST" not in os.environ:
    collect_ignore.append("in_guest")
