"""What the command line may say about a source."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from thermal_stereo_vo.core.errors import DatasetError


@dataclass(frozen=True)
class SourceOptions:
    """Wishes about a recording; each reader heeds those that concern it.

    ``left_topic`` and ``right_topic``, or ``visible_topic`` and ``thermal_topic``, then
    ``imu_topic`` and ``ground_truth_topic`` name topics of a bag.
    ``calibration`` replaces the calibration that travels with the recording.  ``rate_hz`` gives
    stamps to images that have none, and the frame rate of a simulated run.  ``length_m``, ``seed``
    and ``overrides`` (``key=value`` texts) shape a simulated run.

    Raises DatasetError for a rate or length that is not positive.
    """

    left_topic: str | None = None
    right_topic: str | None = None
    visible_topic: str | None = None
    thermal_topic: str | None = None
    imu_topic: str | None = None
    ground_truth_topic: str | None = None
    calibration: Path | None = None
    rate_hz: float | None = None
    length_m: float | None = None
    seed: int = 0
    overrides: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for option, value in (("--rate", self.rate_hz), ("--length", self.length_m)):
            if value is not None and not 0 < value < float("inf"):
                raise DatasetError(f"{option} must be positive, got {value}")
