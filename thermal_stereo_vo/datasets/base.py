"""What every recording, read or simulated, offers to the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.frames import RawFrame
from thermal_stereo_vo.core.imu import ImuSample
from thermal_stereo_vo.core.trajectory import Trajectory


class Dataset(Protocol):
    """A recording of a camera rig.

    ``name`` is short and for people.  ``cameras`` are the roles that ``frames`` yields.
    """

    name: str
    cameras: tuple[str, ...]

    def calibration(self) -> RigCalibration | None:
        """The calibration that travels with the recording, or None."""

    def frames(self) -> Iterator[RawFrame]:
        """All frames of all cameras in order of their stamps; may be called again."""

    def ground_truth(self) -> Trajectory | None:
        """True poses of the rig, or None.  The first pose need not be the identity."""

    def instants(self) -> int | None:
        """How many instants (frames of the first camera) there are, or None when unknown."""


@runtime_checkable
class WithImu(Protocol):
    """A recording that may hold an inertial sensor too."""

    def imu(self) -> Iterator[ImuSample]:
        """All measurements in order of their stamps, none where there is no such sensor."""
