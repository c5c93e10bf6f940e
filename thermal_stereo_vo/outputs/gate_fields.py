"""What the thermal front end says of a frame, as the fields of a status message."""

from __future__ import annotations

from collections.abc import Mapping

from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame
from thermal_stereo_vo.outputs.ros_fields import ERROR, OK, WARN, DiagnosticFields
from thermal_stereo_vo.radiometry.flat_field import FlatFieldStatus
from thermal_stereo_vo.radiometry.gate import GateDecision, GateState
from thermal_stereo_vo.radiometry.gate_reports import GateReport

NAME = "thermal correction"


def gate_fields(
    frame: RadiometricFrame, decision: GateDecision, flat_field: FlatFieldStatus | None
) -> DiagnosticFields:
    """State, epoch, gap and causes of a frame, with its own stamp."""
    level, message = OK, decision.state.value
    if decision.blind and decision.reason is not None:
        level, message = WARN, f"blind: {decision.reason.value}"
    if flat_field is not None and not flat_field.ok:
        level, message = WARN, f"{message}; {flat_field.text}"
    if decision.state is GateState.FAULT:
        level = ERROR
    values = {
        "camera": frame.camera,
        "sequence": str(frame.sequence),
        "gate": decision.state.value,
        "blind": str(decision.blind).lower(),
        "epoch": str(frame.epoch),
    }
    if frame.blind is not None:
        values["blind_reason"] = frame.blind.value
    if decision.causes:
        values["causes"] = ", ".join(cause.value for cause in decision.causes)
    if frame.gap is not None:
        values["gap_duration_ns"] = str(frame.gap.duration_ns)
        values["gap_reason"] = frame.gap.reason.value
        values["gap_epoch_changed"] = str(frame.gap.epoch_changed).lower()
    if flat_field is not None:
        values["flat_field"] = flat_field.text
    return DiagnosticFields(
        stamp_ns=frame.stamp_ns,
        level=level,
        name=f"{NAME} {frame.camera}",
        message=message,
        values=tuple(values.items()),
    )


def report_from_fields(fields: DiagnosticFields) -> tuple[str, GateReport] | None:
    """Camera and what its gate said of a frame; None for the status of anything else."""
    values = dict(fields.values)
    epoch_and_gap = gap_from_values(values)
    if epoch_and_gap is None or fields.name != f"{NAME} {values.get('camera')}":
        return None
    reason = values.get("blind_reason")
    try:
        blind = None if reason is None else GapReason(reason)
    except ValueError:
        return None
    return values["camera"], GateReport(fields.stamp_ns, *epoch_and_gap, blind)


def gap_from_values(values: Mapping[str, str]) -> tuple[int, Gap | None] | None:
    """Epoch and gap of the frame with this stamp; None when the values tell of no gate.

    >>> gap_from_values({"epoch": "1", "gap_duration_ns": "500", "gap_reason": "ffc",
    ...                  "gap_epoch_changed": "true"})
    (1, Gap(duration_ns=500, reason=<GapReason.FFC: 'ffc'>, epoch_changed=True))
    """
    try:
        epoch = int(values["epoch"])
        if "gap_duration_ns" not in values:
            return epoch, None
        duration_ns, reason = int(values["gap_duration_ns"]), GapReason(values["gap_reason"])
        return epoch, Gap(duration_ns, reason, values["gap_epoch_changed"] == "true")
    except (KeyError, ValueError):
        return None
