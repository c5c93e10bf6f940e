from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.calibration import (
    CalibrationCell,
    FlightCell,
    calibration_report,
    flight_report,
    range_error_percent,
)
from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.transforms import exp_so3, make_transform


def rig(yaw_rad: float = 0.0, baseline_m: float = 0.25) -> RigCalibration:
    camera = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)
    T_left_right = make_transform(exp_so3([0.0, yaw_rad, 0.0]), np.array([baseline_m, 0.0, 0.0]))
    return RigCalibration({"left": RigCamera(camera), "right": RigCamera(camera, T_left_right)})


def test_range_error_of_a_turned_and_of_a_stretched_rig():
    assert range_error_percent(rig(), rig()) < 1e-9
    assert range_error_percent(rig(baseline_m=0.25 * 1.01), rig()) == pytest.approx(1.0, rel=1e-6)
    # dz / z = z yaw / baseline in the middle of the picture, more towards its sides.
    assert range_error_percent(rig(1e-4), rig()) == pytest.approx(0.8, rel=0.3)
    assert range_error_percent(rig(1e-4), rig(), 40.0) == pytest.approx(1.6, rel=0.3)


def test_the_worst_of_each_figure_stands_below():
    cell = CalibrationCell(
        "board_mask", 0, 21, 22, 0.02, 0.3, -0.10, 0.2, 0.05, 0.04, 0.5, 1.5, 7.0
    )
    other = replace(cell, seed=1, focal_percent=0.01, baseline_mm=0.05, mre_px=0.06, seconds=9.0)
    lines = calibration_report([cell, other]).splitlines()
    assert lines[2].split()[:6] == ["board_mask", "0", "21", "of", "22", "0.020"]
    assert lines[4].split() == [
        "board_mask", "worst", "0.020", "0.30", "-0.100", "0.200", "0.060", "0.040", "0.500",
        "1.5", "9.0",
    ]  # fmt: skip


def test_flights_are_told_against_the_truth():
    cells = [
        FlightCell("truth", 0, 0.10, 0.3, 0.5),
        FlightCell("truth", 1, 0.30, 0.5, 0.7),
        FlightCell("board_mask 0", 0, 0.11, 0.4, 0.6),
        FlightCell("board_mask 0", 1, 0.31, 0.6, None),
    ]
    lines = flight_report(cells).splitlines()
    assert lines[2].split() == [
        "truth",
        "2",
        "0.2000",
        "1.000",
        "0.4000",
        "1.000",
        "0.6000",
        "1.000",
    ]
    assert lines[3].split() == [
        "board_mask",
        "0",
        "2",
        "0.2100",
        "1.050",
        "0.5000",
        "1.250",
        "-",
        "-",
    ]
