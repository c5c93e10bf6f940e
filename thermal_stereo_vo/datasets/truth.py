"""True poses of a recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermal_stereo_vo.core.errors import DatasetError, EvaluationError
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import Matrix


def true_poses(stamps_ns: Sequence[int], poses: Sequence[Matrix], origin: str) -> Trajectory:
    """A trajectory from N stamps and N (4, 4) T_world_rig; ``origin`` names file or topic.

    Raises DatasetError for no poses and for stamps out of order.
    """
    if not stamps_ns:
        raise DatasetError(f"{origin} holds no poses: remove it, or put in the true ones")
    try:
        return Trajectory(np.array(stamps_ns, dtype=np.int64), np.array(poses, dtype=np.float64))
    except EvaluationError as error:
        raise DatasetError(f"the true poses of {origin} cannot be used: {error}") from None
