"""Who does the work that may run beside the main thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


class InlineExecutor(Executor):
    """Does each job at once, in the thread that hands it in.

    >>> InlineExecutor().submit(max, 3, 5).result()
    5
    """

    def submit(self, job: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Run the job; what it raises is raised again by ``result``."""
        future: Future[Result] = Future()
        try:
            future.set_result(job(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def timed(job: Callable[..., Result], *args: Any, **kwargs: Any) -> tuple[Result, float]:
    """What a job gives, and the milliseconds of its thread's processor time that it took."""
    start = time.thread_time()
    result = job(*args, **kwargs)
    return result, (time.thread_time() - start) * 1e3


def outcome(future: Future[Result], job: str) -> tuple[Result, str] | tuple[None, str]:
    """Wait for what a job gives: that and nothing, or None and a sentence why the job failed.

    Whatever it is that work beside the main thread raises, the odometry goes on without it.

    >>> outcome(InlineExecutor().submit(int, "x"), "counting")[1]
    "counting failed: ValueError: invalid literal for int() with base 10: 'x'"
    """
    try:
        return future.result(), ""
    except Exception as error:
        return None, f"{job} failed: {type(error).__name__}: {error}"


def make_worker(threads: int, name: str) -> Executor:
    """One more thread called ``name`` where two may be used, else none.

    Jobs run one after the other in the order they were handed in, so that results are the same.
    """
    if threads == 1:
        return InlineExecutor()
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
