"""Errors of relative motion: the KITTI average error and the RPE.  No alignment is needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.evaluation.association import Comparison

Array = NDArray[np.float64]

KITTI_LENGTHS_M = tuple(float(length) for length in range(100, 801, 100))
LONGEST_SEGMENT_FRACTION = 0.8
MOST_LENGTHS = 10


@dataclass(frozen=True)
class LengthError:
    """Mean error over the segments of one length; ``segments`` is how many there were."""

    length_m: float
    segments: int
    translation_percent: float
    rotation_deg_per_m: float


@dataclass(frozen=True, eq=False)
class SegmentErrors:
    """Errors of single segments, all arrays (K,).

    ``first`` and ``last`` are frame indices, ``length_m`` the nominal length,
    ``translation_percent`` and ``rotation_deg_per_m`` the error per nominal length.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    length_m: Array
    translation_percent: Array
    rotation_deg_per_m: Array

    def per_length(self) -> tuple[LengthError, ...]:
        """The mean for each length, shortest first."""
        errors = []
        for length in np.unique(self.length_m):
            of_length = self.length_m == length
            errors.append(
                LengthError(
                    float(length),
                    int(np.count_nonzero(of_length)),
                    float(np.mean(self.translation_percent[of_length])),
                    float(np.mean(self.rotation_deg_per_m[of_length])),
                )
            )
        return tuple(errors)


def segment_lengths(path_m: float, frame_step_m: float = 0.0) -> tuple[float, ...]:
    """KITTI's 100, 200 .. 800 m where they fit into 0.8 of the path; else lengths that do.

    Fitted lengths are multiples of a round step (1, 2, 2.5 or 5 times a power of ten): the smallest
    one that gives at most ten lengths up to 0.8 of the path.  Lengths under three frame steps are
    left out, because a segment ends at the first frame beyond its length.

    >>> segment_lengths(60.0)
    (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0)
    >>> segment_lengths(3700.0) == KITTI_LENGTHS_M
    True
    """
    longest_m = LONGEST_SEGMENT_FRACTION * path_m
    if longest_m >= KITTI_LENGTHS_M[-1]:
        lengths = KITTI_LENGTHS_M
    elif longest_m <= 0.0:
        return ()
    else:
        decade = 10.0 ** np.floor(np.log10(longest_m / MOST_LENGTHS))
        steps = [decade * factor for factor in (1.0, 2.0, 2.5, 5.0, 10.0)]
        step = next(step for step in steps if np.floor(longest_m / step + 1e-9) <= MOST_LENGTHS)
        count = int(np.floor(longest_m / step + 1e-9))
        lengths = tuple(float(f"{step * i:.6g}") for i in range(1, count + 1))
    return tuple(length for length in lengths if length >= 3.0 * frame_step_m)


def start_stride(comparison: Comparison) -> int:
    """Frames between the starts of segments: one second's worth, as in KITTI (10 at 10 Hz).

    Fewer in short recordings, a 25th of their frames, so that even the longest segment (0.8 of the
    path) has about five starts.
    """
    if len(comparison) < 2:
        return 1
    period_ns = float(np.median(np.diff(comparison.stamps_ns)))
    return max(1, min(round(1e9 / period_ns), len(comparison) // 25))


def segment_errors(
    comparison: Comparison, lengths_m: tuple[float, ...], stride: int
) -> SegmentErrors:
    """Errors of relative motion, as the KITTI development kit measures them.

    From each start frame to the first frame that lies further than the length along the true path:
    ``E = (T_est_f^-1 T_est_l)^-1 (T_true_f^-1 T_true_l)``, translation and angle of E over the
    nominal length.  A segment that begins or ends where tracking was lost is left out; one that
    only leads across such a stretch counts.
    """
    distances_m = comparison.distances_m
    firsts, lasts, nominal = [], [], []
    for length_m in lengths_m:
        first = np.arange(0, len(comparison), stride)
        last = np.searchsorted(distances_m, distances_m[first] + length_m, side="right")
        inside = last < len(comparison)
        first, last = first[inside], last[inside]
        usable = comparison.has_pose[first] & comparison.has_pose[last]
        firsts.append(first[usable])
        lasts.append(last[usable])
        nominal.append(np.full(np.count_nonzero(usable), length_m))
    first = np.concatenate([np.zeros(0, np.intp), *firsts])
    last = np.concatenate([np.zeros(0, np.intp), *lasts])
    length = np.concatenate([np.zeros(0), *nominal])
    E = relative_errors(comparison, first, last)
    translation_m = np.linalg.norm(E[:, :3, 3], axis=1)
    return SegmentErrors(
        first,
        last,
        length,
        translation_percent=100.0 * translation_m / length,
        rotation_deg_per_m=np.degrees(rotation_angles_rad(E)) / length,
    )


def relative_errors(
    comparison: Comparison, first: NDArray[np.intp], last: NDArray[np.intp]
) -> Array:
    """(K, 4, 4) E = (T_est_first^-1 T_est_last)^-1 (T_true_first^-1 T_true_last)."""
    T_est, T_true = comparison.T_world_est, comparison.T_world_true
    estimated = _inverses(T_est[first]) @ T_est[last]
    true = _inverses(T_true[first]) @ T_true[last]
    return np.asarray(_inverses(estimated) @ true)


def rotation_angles_rad(T: Array) -> Array:
    """(K,) angles of (K, 4, 4) motions, from |R - I|_F = 2 sqrt(2) sin(angle / 2).

    The arc cosine of the trace, as often used, loses all angles below 1e-8 rad to rounding and
    turns the rounding of printed matrices into degrees.
    """
    chord = np.linalg.norm(T[:, :3, :3] - np.eye(3), axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def relative_pose_rmse(
    comparison: Comparison, delta_frames: int = 1
) -> tuple[float | None, float | None]:
    """RPE over all pairs of frames ``delta_frames`` apart: rms translation (m), rms angle (deg)."""
    first = np.arange(0, len(comparison) - delta_frames)
    last = first + delta_frames
    usable = comparison.has_pose[first] & comparison.has_pose[last]
    if not np.any(usable):
        return None, None
    E = relative_errors(comparison, first[usable], last[usable])
    translation_m = np.linalg.norm(E[:, :3, 3], axis=1)
    return rms(translation_m), rms(np.degrees(rotation_angles_rad(E)))


def _inverses(T: Array) -> Array:
    inverse = np.zeros_like(T)
    rotation = np.swapaxes(T[:, :3, :3], 1, 2)
    inverse[:, :3, :3] = rotation
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, T[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def rms(values: Array) -> float:
    """Root mean square of (K,) values."""
    return float(np.sqrt(np.mean(values**2)))
