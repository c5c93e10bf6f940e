"""Which rays a picture needs, and how their hits become pixels.

First the corners of blocks of 2x2 pixels are cast; where they disagree about the surface, or
something slender passes, the corners of the pixels; where those disagree, some rays inside the
pixel as well, unless all show leaves.  Band-limited textures need no more inside one surface.

Grid points are numbered: first the (H + 1)(W + 1) pixel corners row by row, corner (0, 0) lying at
pixel (-0.5, -0.5); then one inner ray of each of the H W pixels, then the next, and so on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.materials import Material

NOT_CAST = -2
SKY = -1

SIMPLE, CORNERS, MIXED, DETAILED = 0, 1, 2, 3
"""How a pixel is resolved: as one surface from the corners of its block or from its own, as several
from its own corners (leaves before leaves), or from those and its inner rays."""


def inner_rays_px(count: int) -> NDArray[np.float64]:
    """(count, 2) inner rays (x, y) from the centre of the pixel, evenly spread.

    Two lie on a slanting line; more follow the R2 sequence (Roberts 2018), which fills the square
    evenly at any count.  Each has its opposite, so that no edge is shifted.
    """
    if count == 2:
        return np.array([[-1.0 / 6.0, -1.0 / 3.0], [1.0 / 6.0, 1.0 / 3.0]])
    n = np.arange(1, count // 2 + 1)
    half = np.column_stack([n * 0.7548776662466927, n * 0.5698402909980532]) % 1.0 - 0.5
    return np.concatenate([half, -half, np.zeros((count % 2, 2))])


_TILE_ROWS, _TILE_COLUMNS = 16, 64
"""Rays are cast tile by tile, so that those that meet the same triangles follow each other."""

_FOLIAGE, _HEDGE = int(Material.FOLIAGE), int(Material.HEDGE)


class Facets(NamedTuple):
    """All triangles, those of movers last, as the kernels read them.

    ``normals`` (N, 3) float32 unit, in map axes now.  ``mover`` (N - first_moving,) int32 index
    into ``T_object_map`` (M, 4, 4) float64.  ``offset_kelvin`` (N, 3) float32.
    """

    normals: NDArray[np.float32]
    material: NDArray[np.int32]
    surface: NDArray[np.int32]
    offset_kelvin: NDArray[np.float32]
    first_moving: int
    mover: NDArray[np.int32]
    T_object_map: NDArray[np.float64]


class Hits(NamedTuple):
    """What the rays met, one entry for each grid point.

    ``triangle`` int32 (NOT_CAST, SKY or an index), ``surface`` and ``material`` int32 (SKY or those
    of the triangle), ``depth`` float32 along the optical axis (inf for sky), ``offset_kelvin``
    float32 at the point.
    """

    triangle: NDArray[np.int32]
    surface: NDArray[np.int32]
    material: NDArray[np.int32]
    depth: NDArray[np.float32]
    offset_kelvin: NDArray[np.float32]


class Rays(NamedTuple):
    """Directions and origins.

    ``grid`` (points, 2) and ``centres`` (H, W, 2) float32 are x and y on the plane z = 1 of the
    camera.  ``rotations`` (2H + 1, 3, 3) and ``origins`` (2H + 1, 3) float64 are its pose in the
    map at every half row: even indices for the rows of corners, odd ones for those of centres.
    """

    grid: NDArray[np.float32]
    centres: NDArray[np.float32]
    rotations: NDArray[np.float64]
    origins: NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def build_rays(
    rays: Rays,
    points: NDArray[np.int32],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> None:
    """Fill (N, 3) origins and directions of the grid points (N,)."""
    height, width = rays.centres.shape[:2]
    grid, R, places = rays.grid, rays.rotations, rays.origins
    corners = (height + 1) * (width + 1)
    for n in range(len(points)):
        p = points[n]
        if p < corners:
            i = 2 * (p // (width + 1))
        else:
            i = 2 * (((p - corners) % (height * width)) // width) + 1
        x = grid[p, 0]
        y = grid[p, 1]
        for k in range(3):
            origins[n, k] = places[i, k]
            directions[n, k] = R[i, k, 0] * x + R[i, k, 1] * y + R[i, k, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def points_in_frames(
    grid: NDArray[np.float32], points: NDArray[np.int32], frames: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(N,) which grid points lie in any of the frames (K, 4): lowest x, y and highest x, y."""
    inside = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        x, y = grid[points[n], 0], grid[points[n], 1]
        for k in range(len(frames)):
            if frames[k, 0] <= x <= frames[k, 2] and frames[k, 1] <= y <= frames[k, 3]:
                inside[n] = True
                break
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def store_hits(
    hits: Hits,
    facets: Facets,
    points: NDArray[np.int32],
    triangle: NDArray[np.int32],
    first: int,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    depth: NDArray[np.float32],
    nearest_only: bool,
) -> None:
    """Enter the hits of the grid points; ``first`` is added to the triangles.

    With ``nearest_only`` a hit counts only where it lies before the one already there.
    """
    triangles, surfaces, materials = hits.triangle, hits.surface, hits.material
    depths, offsets = hits.depth, hits.offset_kelvin
    facet_surface, facet_material = facets.surface, facets.material
    corner_kelvin = facets.offset_kelvin
    for n in range(len(points)):
        p = points[n]
        t = triangle[n]
        if t < 0:
            if not nearest_only:
                triangles[p] = SKY
                surfaces[p] = SKY
                materials[p] = SKY
                depths[p] = np.inf
            continue
        if nearest_only and depth[n] >= depths[p]:
            continue
        t += first
        triangles[p] = t
        surfaces[p] = facet_surface[t]
        materials[p] = facet_material[t]
        depths[p] = depth[n]
        w = 1.0 - u[n] - v[n]
        offsets[p] = (
            w * corner_kelvin[t, 0] + u[n] * corner_kelvin[t, 1] + v[n] * corner_kelvin[t, 2]
        )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _agree(labels: NDArray[np.int32], p: int, right: int, down: int) -> bool:
    """Whether four corners, ``right`` and ``down`` from each other, bear one label."""
    s = labels[p]
    return bool(s == labels[p + right] and s == labels[p + down] and s == labels[p + down + right])


@njit(cache=True, nogil=True, error_model="numpy")
def refine_blocks(hits: Hits, level: NDArray[np.uint8], thin: NDArray[np.uint8]) -> None:
    """Set ``level`` (H, W): blocks whose corners disagree, or with something slender, go on.

    ``thin`` (H / 2, W / 2) holds the least level of each block.
    """
    height, width = level.shape
    surfaces = hits.surface
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            wanted = thin[i // 2, j // 2]
            p = i * (width + 1) + j
            if wanted == SIMPLE and not _agree(surfaces, p, 2, 2 * (width + 1)):
                wanted = CORNERS
            level[i, j] = wanted
            level[i, j + 1] = wanted
            level[i + 1, j] = wanted
            level[i + 1, j + 1] = wanted


@njit(cache=True, nogil=True, error_model="numpy")
def refine_pixels(hits: Hits, level: NDArray[np.uint8]) -> None:
    """Raise pixels whose own corners disagree to DETAILED, or to MIXED among leaves."""
    height, width = level.shape
    surfaces, materials = hits.surface, hits.material
    for y in range(height):
        for x in range(width):
            p = y * (width + 1) + x
            if level[y, x] == CORNERS and not _agree(surfaces, p, 1, width + 1):
                leafy = materials[p] == _FOLIAGE or materials[p] == _HEDGE
                leaves = leafy and _agree(materials, p, 1, width + 1)
                level[y, x] = MIXED if leaves else DETAILED


@njit(cache=True, nogil=True, error_model="numpy")
def block_points(height: int, width: int) -> NDArray[np.int32]:
    """The corners of all blocks of 2x2 pixels."""
    out = np.empty((height // 2 + 1) * (width // 2 + 1), np.int32)
    count = 0
    for y0 in range(0, height + 1, _TILE_ROWS):
        for x0 in range(0, width + 1, _TILE_COLUMNS):
            for y in range(y0, min(y0 + _TILE_ROWS, height + 1), 2):
                for x in range(x0, min(x0 + _TILE_COLUMNS, width + 1), 2):
                    out[count] = y * (width + 1) + x
                    count += 1
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def corner_points(hits: Hits, level: NDArray[np.uint8], out: NDArray[np.int32]) -> int:
    """Corners, not cast yet, of the pixels beyond SIMPLE.

    Writes their numbers to ``out``, marks them as taken and returns how many there are.
    """
    height, width = level.shape
    triangles = hits.triangle
    count = 0
    for y0 in range(0, height, _TILE_ROWS):
        for x0 in range(0, width, _TILE_COLUMNS):
            for y in range(y0, min(y0 + _TILE_ROWS, height)):
                for x in range(x0, min(x0 + _TILE_COLUMNS, width)):
                    if level[y, x] == SIMPLE:
                        continue
                    p = y * (width + 1) + x
                    for q in (p, p + 1, p + width + 1, p + width + 2):
                        if triangles[q] == NOT_CAST:
                            triangles[q] = SKY
                            out[count] = q
                            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def inner_points(level: NDArray[np.uint8], inner: int, out: NDArray[np.int32]) -> int:
    """The ``inner`` rays of the DETAILED pixels; like ``corner_points``."""
    height, width = level.shape
    first = (height + 1) * (width + 1)
    count = 0
    for y0 in range(0, height, _TILE_ROWS):
        for x0 in range(0, width, _TILE_COLUMNS):
            for y in range(y0, min(y0 + _TILE_ROWS, height)):
                for x in range(x0, min(x0 + _TILE_COLUMNS, width)):
                    if level[y, x] == DETAILED:
                        for n in range(inner):
                            out[count] = first + (n * height + y) * width + x
                            count += 1
    return count


class Samples(NamedTuple):
    """Points to shade, in the order of their pixels; a pixel is the weighted sum of its samples.

    ``pixel`` int32 flat index, ``triangle`` int32 or SKY, ``plane`` (N, 2) float32 on z = 1,
    ``depth``, ``offset_kelvin`` and ``weight`` float32.
    """

    pixel: NDArray[np.int32]
    triangle: NDArray[np.int32]
    plane: NDArray[np.float32]
    depth: NDArray[np.float32]
    offset_kelvin: NDArray[np.float32]
    weight: NDArray[np.float32]


@njit(cache=True, nogil=True, error_model="numpy")
def gather_samples(
    hits: Hits,
    rays: Rays,
    facets: Facets,
    level: NDArray[np.uint8],
    samples: Samples,
    depth: NDArray[np.float32],
    owner: NDArray[np.int32],
) -> int:
    """Fill ``samples`` from the hits, and ``depth`` (inf for sky) and ``owner`` (H, W).

    Each surface in a pixel is one sample, in the middle of the rays that met it.  ``owner`` is -1
    for what stands still, else the index of the mover.  Returns the number of samples.
    """
    height, width = level.shape
    across = width + 1
    inner = (len(rays.grid) - (height + 1) * across) // (height * width)
    # Each corner counts for four pixels, and half as much as an inner ray for each of them.
    inner_weight = 1.0 / (inner + 2.0)
    surfaces = np.empty(4 + inner, np.int64)
    points = np.empty(4 + inner, np.int64)
    hit_triangle, hit_surface = hits.triangle, hits.surface
    hit_depth, hit_offset = hits.depth, hits.offset_kelvin
    grid, centres = rays.grid, rays.centres
    pixels, triangles, planes = samples.pixel, samples.triangle, samples.plane
    depths, offsets, weights = samples.depth, samples.offset_kelvin, samples.weight
    first_moving, movers = facets.first_moving, facets.mover
    total = 0
    for y in range(height):
        for x in range(width):
            pixel = y * width + x
            if level[y, x] < MIXED:
                if level[y, x] == SIMPLE:
                    p = (y & ~1) * across + (x & ~1)
                    right, down = 2, 2 * across
                    u = 0.25 + 0.5 * (x & 1)
                    v = 0.25 + 0.5 * (y & 1)
                else:
                    p = y * across + x
                    right, down = 1, across
                    u = v = 0.5
                t = hit_triangle[p]
                pixels[total] = pixel
                triangles[total] = t
                planes[total, 0] = centres[y, x, 0]
                planes[total, 1] = centres[y, x, 1]
                weights[total] = 1.0
                depth[y, x] = np.inf
                if t >= 0:
                    a, b, c, d = p, p + right, p + down, p + down + right
                    # The inverse depth of a plane is linear in the image.
                    rho = (1.0 - v) * ((1.0 - u) / hit_depth[a] + u / hit_depth[b]) + v * (
                        (1.0 - u) / hit_depth[c] + u / hit_depth[d]
                    )
                    offsets[total] = (1.0 - v) * (
                        (1.0 - u) * hit_offset[a] + u * hit_offset[b]
                    ) + v * ((1.0 - u) * hit_offset[c] + u * hit_offset[d])
                    depth[y, x] = 1.0 / rho
                    depths[total] = depth[y, x]
                owner[y, x] = movers[t - first_moving] if t >= first_moving else -1
                total += 1
                continue

            p = y * across + x
            points[0], points[1] = p, p + 1
            points[2], points[3] = p + across, p + across + 1
            rays_here = 4
            corner_weight = 0.25
            if level[y, x] == DETAILED:
                rays_here += inner
                corner_weight = 0.5 * inner_weight
                for n in range(inner):
                    points[4 + n] = (height + 1) * across + n * height * width + pixel
            count = 0
            for n in range(rays_here):
                q = points[n]
                s = hit_surface[q]
                k = 0
                while k < count and surfaces[k] != s:
                    k += 1
                m = total + k
                if k == count:
                    surfaces[k] = s
                    pixels[m] = pixel
                    triangles[m] = hit_triangle[q]
                    weights[m] = 0.0
                    planes[m, 0] = planes[m, 1] = 0.0
                    depths[m] = 0.0
                    offsets[m] = 0.0
                    count += 1
                w = corner_weight if n < 4 else inner_weight
                weights[m] += w
                planes[m, 0] += w * grid[q, 0]
                planes[m, 1] += w * grid[q, 1]
                if s >= 0:
                    depths[m] += w / hit_depth[q]
                    offsets[m] += w * hit_offset[q]
            largest = total
            for m in range(total, total + count):
                w = weights[m]
                planes[m, 0] /= w
                planes[m, 1] /= w
                offsets[m] /= w
                depths[m] = w / depths[m]
                if w > weights[largest]:
                    largest = m
            depth[y, x] = depths[largest] if triangles[largest] >= 0 else np.inf
            t = triangles[largest]
            owner[y, x] = movers[t - first_moving] if t >= first_moving else -1
            total += count
    return total
