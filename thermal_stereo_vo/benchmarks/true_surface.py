"""Distance of points to the triangles of a simulated world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thermal_stereo_vo.simulation.mesh import Mesh

Points = NDArray[np.float64]

SPACING_M = 0.08
NEIGHBOURS = 6
LARGE_M2 = 30.0


class TrueSurface:
    """The triangles of a mesh near a path, searched by samples on them.

    ``path_m`` (N, 3) in map coordinates; triangles farther from it than ``reach_m`` are left out.
    The few that are larger than ``LARGE_M2`` are all tried.
    """

    def __init__(
        self, mesh: Mesh, path_m: Points, reach_m: float, rng: np.random.Generator
    ) -> None:
        vertices = mesh.vertices.astype(np.float64)
        low, high = path_m.min(axis=0) - reach_m, path_m.max(axis=0) + reach_m
        near = np.all((vertices.max(axis=1) >= low) & (vertices.min(axis=1) <= high), axis=1)
        self._vertices = vertices[near]
        self._material = mesh.material[near]
        large = _area(self._vertices) > LARGE_M2
        self._large = np.nonzero(large)[0]
        small = np.nonzero(~large)[0]
        samples, owner = _sampled(self._vertices[small], rng)
        self._owner = small[owner]
        self._tree = cKDTree(samples)

    def nearest(self, points_m: Points) -> tuple[Points, NDArray[np.int32]]:
        """Distances (N,) in m of (N, 3) points to the surface, and the materials (N,) there."""
        _, found = self._tree.query(points_m, k=NEIGHBOURS)
        best = np.full(len(points_m), np.inf)
        whose = np.zeros(len(points_m), np.intp)
        candidates = [*self._owner[found].T, *(np.full(len(points_m), n) for n in self._large)]
        for owner in candidates:
            distance = triangle_distance(points_m, self._vertices[owner])
            nearer = distance < best
            best[nearer], whose[nearer] = distance[nearer], owner[nearer]
        return best, self._material[whose]


def triangle_distance(points: Points, triangles: Points) -> Points:
    """(N,) distance of each (N, 3) point to its (N, 3, 3) triangle.

    Inside the prism over the triangle that to its plane, else that to the nearest edge.
    """
    a, b, c = (triangles[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    height = np.sum((points - a) * normal, axis=1) / length
    inside = np.ones(len(points), np.bool_)
    edges = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        inside &= np.sum(np.cross(along, points - start) * normal, axis=1) >= 0.0
        square = np.maximum(np.sum(along * along, axis=1), 1e-300)
        part = np.clip(np.sum((points - start) * along, axis=1) / square, 0.0, 1.0)
        edges = np.minimum(edges, np.linalg.norm(points - start - part[:, None] * along, axis=1))
    return np.where(inside, np.abs(height), edges)


def _area(vertices: Points) -> Points:
    a, b, c = (vertices[:, k] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _sampled(vertices: Points, rng: np.random.Generator) -> tuple[Points, NDArray[np.intp]]:
    """Points spread over the triangles, and whose they are."""
    a, b, c = (vertices[:, k] for k in range(3))
    counts = np.ceil(_area(vertices) / SPACING_M**2).astype(np.intp)
    owner = np.repeat(np.arange(len(vertices)), counts)
    u, v = rng.random((2, len(owner)))
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    return a[owner] + u[:, None] * (b - a)[owner] + v[:, None] * (c - a)[owner], owner
