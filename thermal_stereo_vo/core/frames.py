"""Images on their way from the sensor to the odometry.  Immutable; arrays are read-only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import FrameError
from thermal_stereo_vo.core.transforms import identity

Image = NDArray[Any]
"""(H, W) uint8 or uint16 (linear counts), or float32 linear counts."""


class FfcState(Enum):
    """What a camera says of its own flat-field correction."""

    NONE = "none"
    IMMINENT = "imminent"
    IN_PROGRESS = "in_progress"
    COMPLETE = "complete"


class GapReason(Enum):
    """Why good images were missing."""

    FFC = "ffc"
    FROZEN = "frozen"
    DROPPED = "dropped"
    CORRUPT = "corrupt"
    FAULT = "fault"
    DARK = "dark"
    GLARE = "glare"


@dataclass(frozen=True)
class Telemetry:
    """What the camera reports beside the image; None where it says nothing.

    ``frames_since_ffc`` and ``time_since_ffc_ns`` count from the end of the last correction.
    """

    fpa_temperature_kelvin: float | None = None
    housing_temperature_kelvin: float | None = None
    ffc_state: FfcState | None = None
    frames_since_ffc: int | None = None
    time_since_ffc_ns: int | None = None


@dataclass(frozen=True)
class Gap:
    """A stretch without good images, told by the first good frame after it.

    ``epoch_changed`` is true when the offsets of the sensor jumped (an FFC took place), so that
    photometric state from before must be estimated again.
    """

    duration_ns: int
    reason: GapReason
    epoch_changed: bool


@dataclass(frozen=True)
class RawFrame:
    """One image as the grabber or the recording delivered it.

    ``image`` is (H, W) uint16 or uint8.  ``sequence`` counts the frames of this camera, gaps
    included.
    """

    image: Image
    stamp_ns: int
    camera: str
    sequence: int = 0
    telemetry: Telemetry | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype not in (np.uint8, np.uint16):
            raise FrameError(
                f"camera '{self.camera}' gave an image of shape {self.image.shape} and type "
                f"{self.image.dtype}: give a single-channel 8- or 16-bit image"
            )
        _freeze(self.image)


@dataclass(frozen=True)
class RadiometricFrame:
    """One camera's linear counts after gating and flat-field correction.

    ``image`` is (H, W) uint16 or uint8 counts, or None while the gate holds the camera blind (FFC,
    frozen, corrupt), which ``blind`` then gives a reason for: stamp and sequence still go on.
    ``mask`` is (H, W) bool, True where a pixel
    may be used; None means all.  ``epoch`` counts the flat-field corrections seen so far.  ``gap``
    is set on the first good frame after a gap.
    """

    image: Image | None
    stamp_ns: int
    camera: str
    sequence: int = 0
    mask: NDArray[np.bool_] | None = None
    epoch: int = 0
    gap: Gap | None = None
    telemetry: Telemetry | None = None
    blind: GapReason | None = None

    def __post_init__(self) -> None:
        _freeze(self.image, self.mask)


@dataclass(frozen=True)
class CameraView:
    """One camera's part of a rig frame.

    ``image`` holds linear counts (H, W); ``display`` is the 8-bit view made from it with one
    mapping for all cameras of a band, for people and descriptors, or None when nobody asked for it.
    ``camera`` is the model the pixels obey now (distortion-free once rectified).
    """

    image: Image
    camera: Camera
    T_rig_camera: NDArray[np.float64] = field(default_factory=identity)
    mask: NDArray[np.bool_] | None = None
    display: NDArray[np.uint8] | None = None
    epoch: int = 0
    gap: Gap | None = None

    def __post_init__(self) -> None:
        _freeze(self.image, self.mask, self.display, self.T_rig_camera)


@dataclass(frozen=True)
class RigFrame:
    """What the rig saw at one instant.

    ``views`` maps role (``left``, ``right``, ``visible``, ``thermal``) to view.  A camera that is
    blind at this instant has no view; ``blind`` says why.  ``skew_ns`` is the measured stamp
    difference of the two cameras (second minus first role).
    """

    stamp_ns: int
    views: Mapping[str, CameraView]
    blind: Mapping[str, GapReason] = field(default_factory=dict)
    skew_ns: int = 0

    @property
    def has_counts(self) -> bool | None:
        """Whether the images are linear counts of more than 8 bits; None without any image."""
        for view in self.views.values():
            return bool(view.image.dtype != np.uint8)
        return None


def _freeze(*arrays: NDArray[Any] | None) -> None:
    for array in arrays:
        if array is not None:
            array.flags.writeable = False
