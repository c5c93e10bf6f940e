"""Triangles with a material, and the shapes the scenes are built of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


THIN_M = 0.35
"""Things narrower than this are announced to the renderer, lest a coarse ray grid misses them."""


@dataclass(frozen=True)
class Mesh:
    """N triangles.

    ``vertices`` (N, 3, 3) float32 metres, counter-clockwise seen from outside.  ``material`` (N,)
    int32 index.  ``surface`` (N,) int32: triangles of one surface have no visible edge between
    them.  ``offset_kelvin`` (N, 3) float32 temperature at each vertex relative to the material.
    ``thin`` (K, 7) float32 are the axes of slender parts: both ends (m) and the width (m).
    """

    vertices: NDArray[np.float32]
    material: NDArray[np.int32]
    surface: NDArray[np.int32]
    offset_kelvin: NDArray[np.float32]
    thin: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def surfaces(self) -> int:
        """How many surfaces there are."""
        return int(self.surface.max(initial=-1)) + 1


class MeshBuilder:
    """Collects shapes; ``build`` makes one mesh of them."""

    def __init__(self) -> None:
        self._vertices: list[Floats] = []
        self._material: list[NDArray[np.int32]] = []
        self._surface: list[NDArray[np.int32]] = []
        self._offset: list[Floats] = []
        self._thin: list[Floats] = []
        self._surfaces = 0

    def triangles(
        self,
        vertices_m: ArrayLike,
        material: int | NDArray[np.int32],
        *,
        offset_kelvin: ArrayLike = 0.0,
        surface: NDArray[np.int32] | None = None,
    ) -> None:
        """Add (N, 3, 3) triangles.

        ``offset_kelvin`` broadcasts to (N, 3).  ``surface`` (N,) groups them, from 0; by default
        all are one surface.
        """
        vertices = np.asarray(vertices_m, dtype=np.float64).reshape(-1, 3, 3)
        n = len(vertices)
        if surface is None:
            surface = np.zeros(n, np.int32)
        self._vertices.append(vertices)
        self._material.append(np.broadcast_to(np.asarray(material, np.int32), n))
        self._offset.append(np.broadcast_to(np.asarray(offset_kelvin, np.float64), (n, 3)))
        self._surface.append((surface + self._surfaces).astype(np.int32))
        self._surfaces += int(surface.max(initial=0)) + 1

    def quads(
        self,
        corners_m: ArrayLike,
        material: int | NDArray[np.int32],
        *,
        offset_kelvin: ArrayLike = 0.0,
        one_surface: bool = False,
    ) -> None:
        """Add (N, 4, 3) quads, corners counter-clockwise from outside; offsets as (N, 4)."""
        corners = np.asarray(corners_m, dtype=np.float64).reshape(-1, 4, 3)
        n = len(corners)
        offsets = np.broadcast_to(np.asarray(offset_kelvin, np.float64), (n, 4))
        if not one_surface:
            self._announce(corners)
        halves = [[0, 1, 2], [0, 2, 3]]
        materials = np.repeat(np.broadcast_to(np.asarray(material, np.int32), n), 2)
        surface = np.repeat(np.arange(n, dtype=np.int32) * (not one_surface), 2)
        self.triangles(
            corners[:, halves].reshape(-1, 3, 3),
            materials,
            offset_kelvin=offsets[:, halves].reshape(-1, 3),
            surface=surface.astype(np.int32),
        )

    def box(
        self,
        low_m: ArrayLike,
        high_m: ArrayLike,
        material: int,
        *,
        T_map_object: Floats | None = None,
        offset_kelvin: ArrayLike = 0.0,
        top_material: int | None = None,
    ) -> None:
        """Add a box; ``offset_kelvin`` broadcasts to (6,): -x, +x, -y, +y, -z, +z."""
        corners = box_faces(low_m, high_m)
        if T_map_object is not None:
            corners = corners @ T_map_object[:3, :3].T + T_map_object[:3, 3]
        offsets = np.broadcast_to(np.asarray(offset_kelvin, np.float64), 6)
        materials = np.full(6, material, np.int32)
        if top_material is not None:
            materials[5] = top_material
        self.quads(corners, materials, offset_kelvin=offsets[:, None])

    def cylinder(
        self,
        foot_m: ArrayLike,
        top_m: ArrayLike,
        radius_m: float,
        material: int,
        *,
        top_radius_m: float | None = None,
        sides: int = 8,
        offset_kelvin: float = 0.0,
    ) -> None:
        """Add an open tube (or cone) from foot to top as one smooth surface."""
        foot, top = np.asarray(foot_m, np.float64), np.asarray(top_m, np.float64)
        axis = (top - foot) / np.linalg.norm(top - foot)
        helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.8 else np.array([0.0, 1.0, 0.0])
        u = np.cross(axis, helper)
        u /= np.linalg.norm(u)
        v = np.cross(axis, u)
        angles = np.linspace(0.0, 2.0 * np.pi, sides + 1)
        ring = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
        low = foot + radius_m * ring
        high = top + (radius_m if top_radius_m is None else top_radius_m) * ring
        quads = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
        self.quads(quads, material, offset_kelvin=offset_kelvin, one_surface=True)
        width = radius_m + (radius_m if top_radius_m is None else top_radius_m)
        if width < THIN_M:
            self._thin.append(np.concatenate([foot, top, [width]])[None])

    def _announce(self, corners: Floats) -> None:
        """Note the quads that are slender."""
        a = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
        b = np.linalg.norm(corners[:, 2] - corners[:, 1], axis=1)
        slender = (np.minimum(a, b) < THIN_M) & (np.maximum(a, b) > 0.05)
        if not np.any(slender):
            return
        # The axis joins the middles of the short sides.
        upright = a < b
        first = np.where(upright[:, None], corners[:, :2].mean(1), corners[:, [0, 3]].mean(1))
        last = np.where(upright[:, None], corners[:, 2:].mean(1), corners[:, 1:3].mean(1))
        axes = np.column_stack([first, last, np.minimum(a, b)])
        self._thin.append(axes[slender])

    def build(self) -> Mesh:
        """Everything added so far as one mesh."""
        if not self._vertices:
            self.triangles(np.zeros((0, 3, 3)), 0)
        return Mesh(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._material).astype(np.int32),
            np.concatenate(self._surface).astype(np.int32),
            np.concatenate(self._offset).astype(np.float32),
            np.concatenate([np.zeros((0, 7)), *self._thin]).astype(np.float32),
        )


def box_faces(low_m: ArrayLike, high_m: ArrayLike) -> Floats:
    """(6, 4, 3) corners of the faces -x, +x, -y, +y, -z, +z, counter-clockwise from outside."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low_m, float), np.asarray(high_m, float)
    return np.array(
        [
            [[x0, y1, z0], [x0, y0, z0], [x0, y0, z1], [x0, y1, z1]],
            [[x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1]],
            [[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]],
            [[x1, y1, z0], [x0, y1, z0], [x0, y1, z1], [x1, y1, z1]],
            [[x0, y1, z0], [x1, y1, z0], [x1, y0, z0], [x0, y0, z0]],
            [[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]],
        ]
    )
