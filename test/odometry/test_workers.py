from __future__ import annotations

import threading

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry
from thermal_stereo_vo.odometry.feature_based.warm_up import synthetic_pair
from thermal_stereo_vo.odometry.workers import make_worker, outcome


@pytest.mark.parametrize("threads", [1, 2])
def test_jobs_run_in_order_in_one_thread_at_most(threads):
    worker = make_worker(threads, "helper")
    seen = []
    futures = [
        worker.submit(lambda i: seen.append((i, threading.current_thread().name)), i)
        for i in range(20)
    ]
    for future in futures:
        future.result()
    assert [i for i, _ in seen] == list(range(20))
    names = {name for _, name in seen}
    assert len(names) == 1
    assert (threading.current_thread().name in names) == (threads == 1)


@pytest.mark.parametrize("threads", [1, 2])
def test_errors_come_with_the_result(threads):
    future = make_worker(threads, "helper").submit(int, "x")
    with pytest.raises(ValueError, match="invalid literal"):
        future.result()


@pytest.mark.parametrize("threads", [1, 2])
def test_the_outcome_of_a_job_is_what_it_gives_or_why_it_failed(threads):
    worker = make_worker(threads, "helper")
    assert outcome(worker.submit(max, 3, 5), "looking") == (5, "")
    for job, why in ((int, "ValueError: invalid literal"), ({}.__getitem__, "KeyError: 'x'")):
        found, failure = outcome(worker.submit(job, "x"), "looking")
        assert found is None
        assert failure.startswith(f"looking failed: {why}")


@pytest.mark.parametrize("threads", [1, 2])
def test_an_interrupt_is_no_failure_of_a_job(threads):
    """Who wants to stop the program shall not be told that an adjustment failed."""

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        outcome(make_worker(threads, "helper").submit(interrupt), "looking")


@pytest.mark.parametrize("window", [0, 3])
def test_number_of_threads_does_not_change_results(window):
    found = []
    for threads in (1, 2):
        settings = [f"window={window}", f"threads={threads}"]
        odometry = create_odometry(with_overrides(OdometryConfig(), settings))
        results = [odometry.process(synthetic_pair(i * 100_000_000)) for i in range(5)]
        found.append([(r.T_world_rig, r.covariance) for r in results])
    for (T_1, P_1), (T_2, P_2) in zip(*found, strict=True):
        np.testing.assert_array_equal(T_1, T_2)
        np.testing.assert_array_equal(P_1, P_2)
