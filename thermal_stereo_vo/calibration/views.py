"""What a detector says of one image, and the board as one camera saw it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class BoardView:
    """A board in one image.

    ``ids`` (K,) int index the points of the target, ``pixels`` (K, 2) float64.  ``sigma_px`` (K,)
    is the standard deviation of each pixel as its own fit sees it (image noise only).  ``blur_px``
    is the median width (standard deviation) of the edges and ``contrast`` the median step across
    them in units of the image noise; both are NaN where the detector does not measure them.
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    blur_px: float = float("nan")
    contrast: float = float("nan")

    def __post_init__(self) -> None:
        for array in (self.ids, self.pixels, self.sigma_px):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Detection:
    """A board view, or the reason why there is none.

    ``method`` says which attempt succeeded.  ``beyond`` is true where the board seems to go on
    beyond the points that were asked for.
    """

    view: BoardView | None
    reason: str = ""
    method: str = ""
    beyond: bool = False

    @property
    def found(self) -> bool:
        """True when there is a view."""
        return self.view is not None


@dataclass(frozen=True)
class BoardShot:
    """The board at one instant, in every camera that saw it: role -> view."""

    name: str
    views: Mapping[str, BoardView]


def camera_called(role: str) -> str:
    """How sentences call a camera.

    >>> camera_called("left"), camera_called("camera")
    ('the left camera', 'the camera')
    """
    return "the camera" if role == "camera" else f"the {role} camera"
