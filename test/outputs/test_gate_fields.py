from __future__ import annotations

import pytest

from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame
from thermal_stereo_vo.outputs.gate_fields import gap_from_values, gate_fields
from thermal_stereo_vo.outputs.ros_fields import ERROR, OK, WARN, telemetry_from_values
from thermal_stereo_vo.radiometry.flat_field import FlatFieldStatus
from thermal_stereo_vo.radiometry.gate import Cause, GateDecision, GateState

GAP = Gap(533_000_000, GapReason.FFC, True)


@pytest.mark.parametrize("gap", [None, GAP, Gap(7, GapReason.DROPPED, False)])
def test_epoch_and_gap_come_back(gap):
    frame = RadiometricFrame(None, 5, "left", 9, epoch=3, gap=gap)
    fields = gate_fields(frame, GateDecision(GateState.TRACKING, 3, gap=gap), None)
    assert fields.stamp_ns == 5
    assert fields.level == OK
    assert gap_from_values(dict(fields.values)) == (3, gap)


def test_a_blind_camera_warns_and_a_fault_is_an_error():
    frame = RadiometricFrame(None, 5, "left", 9)
    blind = GateDecision(
        GateState.FFC, 0, blind=True, reason=GapReason.FROZEN, causes=(Cause.IDENTICAL,)
    )
    fields = gate_fields(frame, blind, None)
    assert (fields.level, fields.message) == (WARN, "blind: frozen")
    assert dict(fields.values)["causes"] == "identical frames"
    fault = GateDecision(GateState.FAULT, 0, blind=True, reason=GapReason.FAULT)
    assert gate_fields(frame, fault, None).level == ERROR


def test_a_flat_field_out_of_range_warns():
    frame = RadiometricFrame(None, 5, "left", 9)
    fields = gate_fields(
        frame, GateDecision(GateState.TRACKING, 0), FlatFieldStatus(False, "too warm")
    )
    assert (fields.level, fields.message) == (WARN, "tracking; too warm")
    assert dict(fields.values)["flat_field"] == "too warm"


def test_it_is_not_taken_for_telemetry():
    frame = RadiometricFrame(None, 5, "left", 9, epoch=3, gap=GAP)
    fields = gate_fields(frame, GateDecision(GateState.TRACKING, 3, gap=GAP), None)
    assert fields.hardware_id == ""
    assert fields.name.rpartition("/")[2] != "left"
    assert telemetry_from_values(dict(fields.values)) is None


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"epoch": "x"},
        {"epoch": "1", "gap_duration_ns": "5"},
        {"epoch": "1", "gap_duration_ns": "5", "gap_reason": "moon"},
    ],
)
def test_other_values_tell_of_no_gate(values):
    assert gap_from_values(values) is None
