"""Figures of a bag from stamps alone, and the whole report of a real one."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.datasets.bag_report import count_messages, inspect_bag, skew_of, timing_of
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.outputs.bag_writer import BagWriter

MS = 1_000_000


def test_a_gap_is_a_long_step_not_a_late_frame():
    stamps = [0, 33 * MS, 67 * MS, 110 * MS, 200 * MS]  # 43 ms is late, 90 ms is a gap
    timing = timing_of(stamps)
    assert timing.gaps == 1
    assert timing.longest_step_ms == pytest.approx(90.0)
    assert timing.rate_hz == pytest.approx(1e3 / 38.5, rel=1e-6)


def test_stamps_that_fall_or_repeat_are_counted():
    assert timing_of([0, 10, 10, 5, 20]).backward == 2


@pytest.mark.parametrize("stamps", [[], [5]])
def test_too_few_stamps_have_no_rate(stamps):
    assert timing_of(stamps).rate_hz == 0.0


def test_skew_is_signed_and_lonely_images_are_counted():
    left = [0, 100 * MS, 200 * MS, 300 * MS]
    right = [-2 * MS, 98 * MS, 303 * MS]
    skew = skew_of(left, right)
    assert (skew.pairs, skew.unpaired) == (3, 1)
    assert skew.median_ms == pytest.approx(-2.0)
    assert skew.largest_ms == pytest.approx(3.0)


def test_far_images_are_no_pair():
    assert skew_of([0, 100 * MS], [49 * MS, 151 * MS]).pairs == 1
    assert skew_of([0, 100 * MS], [1000 * MS]).pairs == 0


@pytest.fixture
def bag(tmp_path, rng):
    path = tmp_path / "flight"
    with BagWriter(path) as writer:
        for i in range(6):
            if i != 3:  # a dropped right image
                image = rng.integers(0, 16384, (32, 48), dtype=np.uint16)
                writer.write_image("/right/image_raw", i * 100 * MS + MS, image, "right_optical")
            image = rng.integers(0, 16384, (32, 48), dtype=np.uint16)
            writer.write_image("/left/image_raw", i * 100 * MS + 1, image, "left_optical")
    return path


def test_report_tells_formats_gaps_and_pairing(bag):
    report = inspect_bag(bag, SourceOptions())
    rows = {line.split()[0]: line for line in report.splitlines() if line.startswith("/")}
    left, right = rows["/left/image_raw"].split(), rows["/right/image_raw"].split()
    assert left[1:5] == ["6", "10.00", "0", "100.0"]
    assert right[1:5] == ["5", "10.00", "1", "200.0"]
    assert "sensor_msgs/Image, 48x32 mono16" in rows["/left/image_raw"]
    assert "11 messages, 0.501 s" in report
    assert "5 pairs, 1 images alone, skew (left to right) median 1.000 ms" in report
    assert "calibration: none in the bag; give one with --calibration" in report


def test_report_says_why_replay_would_refuse(bag):
    report = inspect_bag(bag, SourceOptions(left_topic="/front"))
    assert "replay would refuse it: the bag has no image topic '/front'" in report


def test_an_empty_bag_is_refused(tmp_path):
    with BagWriter(tmp_path / "empty"):
        pass
    with pytest.raises(DatasetError, match="holds no messages: record again"):
        inspect_bag(tmp_path / "empty", SourceOptions())


def test_a_bag_that_is_not_there(tmp_path):
    with pytest.raises(DatasetError, match=r"there is no bag .*nowhere: correct the path"):
        inspect_bag(tmp_path / "nowhere", SourceOptions())


def test_each_message_is_counted_once(bag):
    calls = []
    inspect_bag(bag, SourceOptions(), lambda: calls.append(1))
    assert len(calls) == count_messages(bag) == 11
