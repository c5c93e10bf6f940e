"""Progress bars: on a terminal only, never in a log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress(
    total: int | None, unit: str, *, quiet: bool = False, label: str = ""
) -> Iterator[Callable[[], None]]:
    """Hand out a function to call after each step; draws nothing when quiet or not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda: None
        return
    from tqdm import tqdm

    with tqdm(total=total, unit=unit, desc=label or None, leave=False) as bar:
        yield lambda: bar.update() and None
