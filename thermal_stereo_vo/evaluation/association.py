"""Which true pose belongs to which frame, by integer stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import EvaluationError
from thermal_stereo_vo.core.trajectory import Trajectory

Stamps = NDArray[np.int64]

DEFAULT_TOLERANCE_NS = 10_000_000
MOST_FRAMES = 10_000_000


def associate(
    stamps_a_ns: Stamps, stamps_b_ns: Stamps, tolerance_ns: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (K,) into a and (K,) into b of the stamps that are each other's nearest.

    Both inputs must increase strictly.  Each stamp is used once, order is kept, and pairs further
    apart than the tolerance are left out; of two equally near stamps the earlier one is taken.

    >>> a, b = associate(np.array([0, 100, 200]), np.array([98, 103, 190]), 5)
    >>> a.tolist(), b.tolist()
    ([1], [0])
    """
    if len(stamps_a_ns) == 0 or len(stamps_b_ns) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    b_of_a = _nearest(stamps_b_ns, stamps_a_ns)
    a_of_b = _nearest(stamps_a_ns, stamps_b_ns)
    a = np.arange(len(stamps_a_ns))
    mutual = a_of_b[b_of_a] == a
    close = np.abs(stamps_b_ns[b_of_a] - stamps_a_ns) <= tolerance_ns
    kept = mutual & close
    return a[kept], b_of_a[kept]


def expected_frames(estimate_stamps_ns: Stamps, truth_stamps_ns: Stamps) -> Stamps:
    """The stamps that the frames of a recording must have had, lost ones included.

    For trajectories that come without the list of frames: the period is the median step of the
    estimate; longer steps are filled evenly, and both ends are continued as far as the ground truth
    goes (half a period of grace).  Raises EvaluationError when that would be over ten million.

    >>> expected_frames(np.array([100, 200, 300, 500]), np.array([0, 600])).tolist()
    [0, 100, 200, 300, 400, 500, 600]
    """
    if len(estimate_stamps_ns) < 2:
        return estimate_stamps_ns
    steps = np.diff(estimate_stamps_ns)
    period = max(int(np.median(steps)), 1)
    first = min(int(estimate_stamps_ns[0]), int(truth_stamps_ns[0]))
    last = max(int(estimate_stamps_ns[-1]), int(truth_stamps_ns[-1]))
    if (last - first) // period > MOST_FRAMES:
        raise EvaluationError(
            f"frames {period / 1e6:g} ms apart cannot fill the {(last - first) / 1e9:.0f} s from "
            "the first to the last stamp: a stamp is wrong, or estimate and truth have different "
            "clocks"
        )
    parts = [estimate_stamps_ns]
    for i in np.flatnonzero(2 * steps > 3 * period):
        count = round(int(steps[i]) / period)
        parts.append(estimate_stamps_ns[i] + int(steps[i]) * np.arange(1, count) // count)
    before = (int(estimate_stamps_ns[0] - truth_stamps_ns[0]) + period // 2) // period
    after = (int(truth_stamps_ns[-1] - estimate_stamps_ns[-1]) + period // 2) // period
    parts.append(estimate_stamps_ns[0] - period * np.arange(1, before + 1))
    parts.append(estimate_stamps_ns[-1] + period * np.arange(1, after + 1))
    return np.unique(np.concatenate(parts).astype(np.int64))


@dataclass(frozen=True, eq=False)
class Comparison:
    """The frames whose true pose is known, from the first to the last one with an estimate.

    ``stamps_ns`` (N,) int64; ``T_world_true`` and ``T_world_est`` (N, 4, 4) float64, each in its
    own world, both of the same body; where ``has_pose`` (N,) is False the estimate is NaN (tracking
    was lost).  First and last frame have a pose.  ``frames`` counts all frames of the recording and
    ``poses`` those with an estimate, whether or not the truth is known there.
    """

    stamps_ns: Stamps
    T_world_true: NDArray[np.float64]
    T_world_est: NDArray[np.float64]
    has_pose: NDArray[np.bool_]
    frames: int
    poses: int

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def coverage_percent(self) -> float:
        """Poses estimated for each hundred frames."""
        return 100.0 * self.poses / self.frames

    @property
    def true_positions_m(self) -> NDArray[np.float64]:
        """(N, 3)."""
        return self.T_world_true[:, :3, 3]

    @property
    def estimated_positions_m(self) -> NDArray[np.float64]:
        """(N, 3), NaN where there is no pose."""
        return self.T_world_est[:, :3, 3]

    @property
    def distances_m(self) -> NDArray[np.float64]:
        """(N,) true distance travelled since the first frame, lost stretches included.

        Summed over frames, not over a denser ground truth, whose jitter would lengthen the way.
        """
        steps_m = np.linalg.norm(np.diff(self.true_positions_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps_m)])


def compare(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    frame_stamps_ns: Stamps | None = None,
    tolerance_ns: int = DEFAULT_TOLERANCE_NS,
) -> Comparison:
    """Lay an estimate beside the truth.

    ``frame_stamps_ns`` (M,) are the stamps of all frames, also of those without a pose; without
    them they are reconstructed (``expected_frames``).  Raises EvaluationError when a trajectory is
    empty or no stamps agree.
    """
    for name, trajectory in (("the estimate", estimate), ("the ground truth", truth)):
        if len(trajectory) == 0:
            raise EvaluationError(f"{name} holds no pose: there is nothing to compare")
    if len(associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)[0]) == 0:
        raise _nothing_in_common(estimate, truth, tolerance_ns)
    if frame_stamps_ns is None:
        frame_stamps_ns = expected_frames(estimate.stamps_ns, truth.stamps_ns)
    frames = np.union1d(np.asarray(frame_stamps_ns, np.int64), estimate.stamps_ns)
    in_frames, in_truth = associate(frames, truth.stamps_ns, tolerance_ns)
    stamps_ns = frames[in_frames]
    in_estimate = np.searchsorted(estimate.stamps_ns, stamps_ns)
    in_estimate = np.minimum(in_estimate, len(estimate) - 1)
    has_pose = estimate.stamps_ns[in_estimate] == stamps_ns
    if not np.any(has_pose):  # every true pose is nearer to a lost frame than to an estimate
        raise _nothing_in_common(estimate, truth, tolerance_ns)
    T_world_est = estimate.T_world_rig[in_estimate].copy()
    T_world_est[~has_pose] = np.nan
    posed = np.flatnonzero(has_pose)
    stretch = slice(posed[0], posed[-1] + 1)
    return Comparison(
        stamps_ns[stretch],
        truth.T_world_rig[in_truth][stretch],
        T_world_est[stretch],
        has_pose[stretch],
        frames=len(frames),
        poses=len(estimate),
    )


def _nearest(sorted_stamps: Stamps, stamps: Stamps) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(sorted_stamps, stamps), 1, max(len(sorted_stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(sorted_stamps) - 1)
    nearer = np.abs(sorted_stamps[right] - stamps) < np.abs(sorted_stamps[left] - stamps)
    return np.where(nearer, right, left)


def _nothing_in_common(
    estimate: Trajectory, truth: Trajectory, tolerance_ns: int
) -> EvaluationError:
    return EvaluationError(
        f"no stamp of the estimate ({_span(estimate)}) lies within {tolerance_ns / 1e6:g} ms of "
        f"one of the ground truth ({_span(truth)}): take both from the same recording and the "
        "same clock"
    )


def _span(trajectory: Trajectory) -> str:
    first, last = trajectory.stamps_ns[0] / 1e9, trajectory.stamps_ns[-1] / 1e9
    return f"{len(trajectory)} poses, {first:.3f} to {last:.3f} s"
