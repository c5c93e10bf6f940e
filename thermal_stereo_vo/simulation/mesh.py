"""Triangles with a material, and the shapes the scenes are built of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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
        self._triangles: list[_Chunk] = []
        self._quads: list[_Chunk] = []
        self._thin: list[Floats] = []

    def triangles(
        self,
        vertices_m: ArrayLike,
        material: int,
        *,
        offset_kelvin: ArrayLike = 0.0,
        one_surface: bool = True,
    ) -> None:
        """Add (N, 3, 3) triangles; ``offset_kelvin`` broadcasts to (N, 3)."""
        vertices = np.asarray(vertices_m, dtype=np.float64).reshape(-1, 3, 3)
        self._triangles.append(_Chunk(vertices, int(material), offset_kelvin, one_surface))

    def quads(
        self,
        corners_m: ArrayLike,
        material: int,
        *,
        offset_kelvin: ArrayLike = 0.0,
        one_surface: bool = False,
    ) -> None:
        """Add (N, 4, 3) quads, corners counter-clockwise from outside; offsets as (N, 4)."""
        corners = np.asarray(corners_m, dtype=np.float64).reshape(-1, 4, 3)
        self._quads.append(_Chunk(corners, int(material), offset_kelvin, one_surface))

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
        offsets = np.broadcast_to(np.asarray(offset_kelvin, np.float64), 6)[:, None]
        if top_material is None:
            self.quads(corners, material, offset_kelvin=offsets)
        else:
            self.quads(corners[:5], material, offset_kelvin=offsets[:5])
            self.quads(corners[5:], top_material, offset_kelvin=offsets[5:])

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
        ends = np.array([[foot_m, top_m]], dtype=np.float64)
        radii = np.array([radius_m, radius_m if top_radius_m is None else top_radius_m])
        self.tubes(ends, radii, material, sides=sides, offset_kelvin=offset_kelvin)

    def tubes(
        self,
        ends_m: Floats,
        radii_m: Floats,
        material: int,
        *,
        sides: int = 8,
        offset_kelvin: float = 0.0,
    ) -> None:
        """Add open tubes between the ends (N, 2, 3), all with the radii (2,) there."""
        foot, top = ends_m[:, 0], ends_m[:, 1]
        axis = (top - foot) / np.linalg.norm(top - foot, axis=1, keepdims=True)
        helper = np.where(np.abs(axis[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        u = _cross(axis, helper)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v = _cross(axis, u)
        angles = np.linspace(0.0, 2.0 * np.pi, sides + 1)[:, None]
        ring = np.cos(angles) * u[:, None] + np.sin(angles) * v[:, None]
        low = foot[:, None] + radii_m[0] * ring
        high = top[:, None] + radii_m[1] * ring
        quads = np.stack([low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]], axis=2)
        self.quads(quads, material, offset_kelvin=offset_kelvin, one_surface=True)
        width = float(radii_m.sum())
        if width < THIN_M:
            self._thin.append(np.column_stack([foot, top, np.full(len(foot), width)]))

    def build(self) -> Mesh:
        """Everything added so far as one mesh."""
        quads, quad_material, quad_surface, quad_offset = _joined(self._quads, 4, 0)
        first = int(quad_surface.max(initial=-1)) + 1
        triangles, material, surface, offset = _joined(self._triangles, 3, first)
        halves = [[0, 1, 2], [0, 2, 3]]
        vertices = np.concatenate([quads[:, halves].reshape(-1, 3, 3), triangles])
        separate = np.repeat(
            [not c.one_surface for c in self._quads], [len(c.corners) for c in self._quads]
        )
        thin = [*self._thin, _slender(quads[separate.astype(bool)])]
        return Mesh(
            vertices.astype(np.float32),
            np.concatenate([np.repeat(quad_material, 2), material]).astype(np.int32),
            np.concatenate([np.repeat(quad_surface, 2), surface]).astype(np.int32),
            np.concatenate([quad_offset[:, halves].reshape(-1, 3), offset]).astype(np.float32),
            np.concatenate(thin).astype(np.float32),
        )


class _Chunk(NamedTuple):
    """Polygons added by one call."""

    corners: Floats
    material: int
    offset_kelvin: ArrayLike
    one_surface: bool


def _joined(
    chunks: list[_Chunk], corners: int, first_surface: int
) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64], Floats]:
    """Corners (N, k, 3), material (N,), surface (N,) and offsets (N, k) of all chunks."""
    if not chunks:
        none = np.zeros(0, np.int64)
        return np.zeros((0, corners, 3)), none, none, np.zeros((0, corners))
    counts = np.array([len(chunk.corners) for chunk in chunks])
    offsets = np.empty((int(counts.sum()), corners))
    # Polygons that share a surface do not raise the number; the first of a chunk always does.
    step = np.ones(len(offsets), np.int64)
    at = 0
    for chunk, count in zip(chunks, counts, strict=True):
        offsets[at : at + count] = chunk.offset_kelvin
        if chunk.one_surface:
            step[at + 1 : at + count] = 0
        at += count
    return (
        np.concatenate([chunk.corners for chunk in chunks]),
        np.repeat([chunk.material for chunk in chunks], counts),
        first_surface + np.cumsum(step) - 1,
        offsets,
    )


def _slender(corners: Floats) -> Floats:
    """(K, 7) axes and widths of the quads (N, 4, 3) that are narrow."""
    a = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    b = np.linalg.norm(corners[:, 2] - corners[:, 1], axis=1)
    narrow = (np.minimum(a, b) < THIN_M) & (np.maximum(a, b) > 0.05)
    corners, a, b = corners[narrow], a[narrow], b[narrow]
    # The axis joins the middles of the short sides.
    upright = (a < b)[:, None]
    first = np.where(upright, corners[:, :2].mean(axis=1), corners[:, [0, 3]].mean(axis=1))
    last = np.where(upright, corners[:, 2:].mean(axis=1), corners[:, 1:3].mean(axis=1))
    return np.column_stack([first, last, np.minimum(a, b)])


def _cross(a: Floats, b: Floats) -> Floats:
    """(N, 3) cross products; far quicker than numpy's for a few vectors."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
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
