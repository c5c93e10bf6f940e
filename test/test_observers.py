"""Those who listen to a pipeline, and the clock of its stages."""

from __future__ import annotations

import pytest

from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.observers import Observer, ObserverList, StageTimer

FRAME = RigFrame(5, {})
RESULT = OdometryResult(5, TrackingStatus.LOST, None, None)


class Recorder(Observer):
    """Writes down what it hears."""

    def __init__(self, name, heard, wants_points=False, error=None):
        self.name, self.heard, self.wants_points, self.error = name, heard, wants_points, error

    def on_rig_frame(self, frame):
        self.heard.append((self.name, "frame", frame))

    def on_result(self, result):
        self.heard.append((self.name, "result", result))

    def on_points(self, stamp_ns, cloud):
        self.heard.append((self.name, "points", stamp_ns))

    def close(self):
        self.heard.append((self.name, "close", None))
        if self.error is not None:
            raise self.error


def test_all_are_told_in_order_and_points_only_to_those_who_want_them():
    heard = []
    both = ObserverList([Recorder("a", heard), Recorder("b", heard, wants_points=True)])
    both.on_rig_frame(FRAME)
    both.on_result(RESULT)
    both.on_points(5, PointCloud.empty())
    both.close()
    assert [(name, what) for name, what, _ in heard] == [
        ("a", "frame"), ("b", "frame"), ("a", "result"), ("b", "result"), ("b", "points"),
        ("a", "close"), ("b", "close"),
    ]  # fmt: skip
    assert heard[0][2] is FRAME
    assert heard[2][2] is RESULT


@pytest.mark.parametrize("wants", [(), (False,), (False, True)])
def test_points_are_wanted_when_anyone_wants_them(wants):
    listeners = ObserverList([Recorder("x", [], w) for w in wants])
    assert listeners.wants_points is any(wants)


def test_every_observer_is_closed_even_when_one_fails():
    heard = []
    first, second = RuntimeError("disk full"), RuntimeError("later")
    observers = ObserverList(
        [
            Recorder("a", heard, error=first),
            Recorder("b", heard, error=second),
            Recorder("c", heard),
        ]
    )
    with pytest.raises(RuntimeError, match="disk full"):
        observers.close()
    assert [name for name, *_ in heard] == ["a", "b", "c"]


def test_the_default_observer_hears_and_does_nothing():
    observer = Observer()
    assert not observer.wants_points
    observer.on_rig_frame(FRAME)
    observer.on_result(RESULT)
    observer.on_points(0, PointCloud.empty())
    observer.close()


def test_stage_times_add_up_and_start_anew(monkeypatch):
    now_s = iter([0.0, 0.010, 1.0, 1.005, 2.0, 2.5])
    monkeypatch.setattr("thermal_stereo_vo.observers.time.perf_counter", lambda: next(now_s))
    timer = StageTimer()
    with timer.stage("match"):
        pass
    with timer.stage("match"):
        pass
    with pytest.raises(ValueError, match="x"), timer.stage("fails"):
        raise ValueError("x")
    assert timer.take() == pytest.approx({"match": 15.0, "fails": 500.0})
    assert timer.take() == {}
