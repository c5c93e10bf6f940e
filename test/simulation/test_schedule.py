from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.simulation.schedule import (
    START_NS,
    camera_times,
    corrections,
    in_order,
    instants_in,
    stamp_ns,
)
from thermal_stereo_vo.simulation.settings import (
    FfcConfig,
    SimulationConfig,
    ThermalCameraConfig,
    TimingConfig,
)
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature

FPA = FpaTemperature(290.0, ThermalCameraConfig(running_s=0.0), 0.0, wander_kelvin=0.0)


def both(**settings):
    timing = TimingConfig(**settings)
    return [camera_times(timing, 10.0, 400, camera, 3) for camera in (0, 1)]


def test_stamps_are_whole_nanoseconds_of_the_rate() -> None:
    left, right = both()
    assert [e.stamp_ns for e in left] == [START_NS + i * 100_000_000 for i in range(400)]
    assert [e.stamp_ns for e in right] == [e.stamp_ns for e in left]
    assert not any(e.dropped for e in left + right)


def test_skew_and_jitter_put_in_are_found_again() -> None:
    left, right = both(skew_ms=8.0, jitter_ms=2.0)
    delay = np.array([b.time_s - a.time_s for a, b in zip(left, right, strict=True)]) * 1e3
    assert 7.7 < delay.mean() < 8.3
    assert 1.8 < delay.std() < 2.2
    told = np.array([b.stamp_ns - a.stamp_ns for a, b in zip(left, right, strict=True)]) * 1e-6
    np.testing.assert_allclose(told, delay, atol=1e-3)


def test_hidden_skew_is_in_the_times_and_not_in_the_stamps() -> None:
    left, right = both(skew_ms=8.0, hidden=True)
    assert [e.stamp_ns for e in right] == [e.stamp_ns for e in left]
    assert right[7].time_s - left[7].time_s == pytest.approx(0.008)


def test_frames_get_lost_and_come_late_as_often_as_asked() -> None:
    left, right = both(dropped_percent=10.0, late_percent=20.0, late_ms=30.0)
    assert 20 < sum(e.dropped for e in left) < 65
    assert {e.index for e in left if e.dropped} != {e.index for e in right if e.dropped}
    late = [e.stamp_ns - stamp_ns(e.time_s) for e in right]
    assert set(late) == {0, 30_000_000}
    assert 50 < sum(delay > 0 for delay in late) < 115


def test_stamps_of_a_camera_always_grow() -> None:
    late = camera_times(TimingConfig(late_percent=50.0, late_ms=350.0), 10.0, 300, 0, 1)
    assert np.all(np.diff([e.stamp_ns for e in late]) > 0)


def test_frames_arrive_in_the_order_of_their_stamps() -> None:
    merged = in_order(both(skew_ms=-20.0, jitter_ms=5.0))
    stamps = [e.stamp_ns for e in merged]
    assert stamps == sorted(stamps)
    assert len(merged) == 800


def test_a_run_may_stop_early() -> None:
    assert instants_in(6.0, SimulationConfig(rate_hz=10.0)) == 61
    assert instants_in(6.0, SimulationConfig(rate_hz=10.0, duration_s=2.0)) == 21
    assert instants_in(6.0, SimulationConfig(rate_hz=30.0)) == 181


def test_cameras_correct_together_staggered_or_on_their_own() -> None:
    def starts(arrangement: str, camera: int) -> tuple[float, ...]:
        config = FfcConfig(
            mode="periodic", first_s=5.0, period_s=20.0, arrangement=arrangement, stagger_s=3.0
        )
        return corrections(config, FPA, 50.0, camera, 1)

    assert starts("together", 0) == (5.0, 25.0, 45.0) == starts("together", 1)
    assert starts("staggered", 1) == (8.0, 28.0, 48.0)
    alone = starts("independent", 1)
    assert starts("independent", 0) == (5.0, 25.0, 45.0)
    assert alone[0] not in (5.0, 8.0)
    assert np.allclose(np.diff(alone), 20.0)


def test_warm_up_triggers_corrections_that_grow_rarer() -> None:
    config = FfcConfig(mode="temperature", step_kelvin=1.0)
    starts = corrections(config, FPA, 600.0, 0, 1)
    assert 7 <= len(starts) <= 10  # 12 K (1 - exp(-1.5)) = 9.3 K
    assert np.all(np.diff(np.diff((0.0, *starts))) > 0)
    assert FPA.kelvin(starts[0]) - FPA.kelvin(0.0) == pytest.approx(1.0, abs=0.02)


def test_without_corrections_there_are_none() -> None:
    assert corrections(FfcConfig(), FPA, 1e4, 0, 1) == ()
