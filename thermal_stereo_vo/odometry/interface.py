"""The plug: what the pipeline asks of an odometry method, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud


@dataclass(frozen=True)
class Requirements:
    """What a method needs of its frames: camera roles, rectified pair or not, 8-bit view or not."""

    roles: tuple[str, str]
    rectified_pair: bool
    display: bool


class Odometry(Protocol):
    """A method of visual odometry.

    ``process`` accepts frames of strictly increasing stamp (else OutOfOrderError), never raises for
    bad image content, changes nothing in the frame, is deterministic for a seed, reads no file and
    prints nothing.  A frame without views asks for a prediction.
    """

    requirements: Requirements

    def warm_up(self) -> None:
        """Load or compile every kernel, so that the first frame is not late."""

    def reset(self, T_world_rig: NDArray[np.float64]) -> None:
        """Forget all images and go on from this pose."""

    def process(self, frame: RigFrame) -> OdometryResult:
        """Estimate the pose of the rig at this frame."""

    def local_map(self) -> PointCloud:
        """The points that the last frame was tracked against, in world coordinates."""
