"""Embree: what rays hit first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Met:
    """First hits of N rays.

    ``triangle`` (N,) int32, -1 for none; ``u`` and ``v`` (N,) barycentric weights of its second and
    third vertex; ``distance`` (N,) in lengths of the direction.
    """

    triangle: NDArray[np.int32]
    u: Floats
    v: Floats
    distance: Floats


class RayCaster:
    """The triangles (N, 3, 3) float32 of one mesh, ready for rays."""

    def __init__(self, vertices: Floats) -> None:
        self._tree = EmbreeScene()
        TriangleMesh(self._tree, np.ascontiguousarray(vertices, dtype=np.float32))

    def cast(self, origins: Floats, directions: Floats) -> Met:
        """What (N, 3) rays meet first."""
        found = self._tree.run(origins, directions, output=True)
        return Met(found["primID"], found["u"], found["v"], found["tfar"])

    def blocked(self, origins: Floats, directions: Floats) -> NDArray[np.bool_]:
        """(N,) whether rays meet anything."""
        met = self._tree.run(origins, directions, query="OCCLUDED")
        return np.asarray(met >= 0)
