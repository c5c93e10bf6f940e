"""What the gates of a run held back, in sentences."""

from __future__ import annotations

from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.radiometry.gate import GateEvent


class GateEvents(Observer):
    """Keeps every event: ``sentences`` with camera, cause and duration."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def on_gate_event(self, event: GateEvent) -> None:
        self.sentences.append(str(event))
