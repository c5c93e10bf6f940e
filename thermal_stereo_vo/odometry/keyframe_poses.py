"""World poses of a few keyframes with their covariances, the oldest held as the anchor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.transforms import adjoint, inverse
from thermal_stereo_vo.odometry.information import positive
from thermal_stereo_vo.odometry.pose_chain import PoseEstimate


class KeyframePoses:
    """Fixed room for keyframes; slots are used again.

    ``T_k_w`` (slots, 4, 4); ``order`` the slots in use, oldest keyframe first.  The covariance of
    each is that of its left perturbation given the oldest; the oldest carries that of the world
    behind it.
    """

    def __init__(self, room: int) -> None:
        self._room = room
        self.T_k_w = np.tile(np.eye(4), (room, 1, 1))
        self.order: list[int] = []
        self._oldest_covariance = np.zeros((6, 6))
        self._relative: dict[int, NDArray[np.float64]] = {}

    @property
    def newest(self) -> int:
        """Slot of the newest keyframe."""
        return self.order[-1]

    @property
    def is_full(self) -> bool:
        """Whether the oldest must go before another comes."""
        return len(self.order) == self._room

    def clear(self) -> None:
        """Forget all keyframes."""
        self.order.clear()
        self._relative.clear()

    def newest_pose(self) -> PoseEstimate:
        """World pose of the newest keyframe with its covariance."""
        return self._pose(self.newest)

    def append(self, pose: PoseEstimate, relative_covariance: NDArray[np.float64]) -> int:
        """Take a keyframe in, ``relative_covariance`` (6, 6) given the newest; returns its slot."""
        slot = next(i for i in range(self._room) if i not in self.order)
        if not self.order:
            self._oldest_covariance = pose.covariance
        elif len(self.order) == 1:
            self._relative[slot] = relative_covariance
        else:
            # Until the adjustment knows better: the newest keyframe, then the step from there.
            T_slot_newest = inverse(pose.T_world_rig) @ inverse(self.T_k_w[self.newest])
            Ad = adjoint(T_slot_newest)
            known = self._relative[self.newest]
            self._relative[slot] = Ad @ known @ Ad.T + relative_covariance
        self.T_k_w[slot] = inverse(pose.T_world_rig)
        self.order.append(slot)
        return slot

    def refine(self, T_k_w: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
        """Take over (K, 4, 4) poses and the (6 (K-1), 6 (K-1)) covariance given the oldest."""
        self.T_k_w[self.order] = T_k_w
        for i, slot in enumerate(self.order[1:]):
            block = slice(6 * i, 6 * i + 6)
            self._relative[slot] = covariance[block, block]

    def drop_oldest(self) -> int:
        """The second oldest becomes the anchor, as unsure as it is by now.  Returns the slot."""
        oldest = self.order[0]
        if len(self.order) > 1:
            heir = self.order[1]
            heir_given_oldest = self._relative[heir]
            self._oldest_covariance = self._pose(heir).covariance
            for slot in self.order[2:]:
                # Correlations are left to the next adjustment: a difference of covariances would
                # not stay positive.
                T_slot_heir = self.T_k_w[slot] @ inverse(self.T_k_w[heir])
                Ad = adjoint(T_slot_heir)
                rest = self._relative[slot] - Ad @ heir_given_oldest @ Ad.T
                self._relative[slot] = positive(rest)
            self._relative.pop(heir, None)
        self.order.pop(0)
        self._relative.pop(oldest, None)
        return oldest

    def drop(self, slot: int) -> None:
        """Forget one keyframe; those left keep their poses."""
        if slot == self.order[0]:
            self.drop_oldest()
        else:
            self.order.remove(slot)
            self._relative.pop(slot)

    def rescale(self, factor: float, about_m: NDArray[np.float64]) -> None:
        """Multiply all lengths, positions as seen from ``about_m`` (3,)."""
        lengths = np.array([factor] * 3 + [1.0] * 3)
        both = np.outer(lengths, lengths)
        for slot in self.order:
            T_world_slot = inverse(self.T_k_w[slot])
            T_world_slot[:3, 3] = about_m + factor * (T_world_slot[:3, 3] - about_m)
            self.T_k_w[slot] = inverse(T_world_slot)
        self._oldest_covariance = self._oldest_covariance * both
        self._relative = {slot: known * both for slot, known in self._relative.items()}

    def _pose(self, slot: int) -> PoseEstimate:
        oldest = self.order[0]
        T_world_oldest = inverse(self.T_k_w[oldest])
        start = PoseEstimate(T_world_oldest, self._oldest_covariance)
        if slot == oldest:
            return start
        return start.moved(self.T_k_w[slot] @ T_world_oldest, self._relative[slot])
