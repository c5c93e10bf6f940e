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
from thermal_stereo_vo.simulation.shading import Band, Light, shade, sky_radiance

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
    corners = (height + 1) * (width + 1)
    for n in range(len(points)):
        p = points[n]
        if p < corners:
            i = 2 * (p // (width + 1))
        else:
            i = 2 * (((p - corners) % (height * width)) // width) + 1
        x = rays.grid[p, 0]
        y = rays.grid[p, 1]
        R = rays.rotations[i]
        for k in range(3):
            origins[n, k] = rays.origins[i, k]
            directions[n, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def points_in_boxes(
    points: NDArray[np.int32], height: int, width: int, boxes: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(N,) which grid points touch the pixels x0, y0, x1, y1 of any of the boxes (K, 4)."""
    inside = np.zeros(len(points), np.bool_)
    corners = (height + 1) * (width + 1)
    for n in range(len(points)):
        p = points[n]
        columns = width + 1
        if p >= corners:
            p = (p - corners) % (height * width)
            columns = width
        y = p // columns
        x = p - y * columns
        for k in range(len(boxes)):
            if boxes[k, 0] <= x <= boxes[k, 2] + 1 and boxes[k, 1] <= y <= boxes[k, 3] + 1:
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
    for n in range(len(points)):
        p = points[n]
        t = triangle[n]
        if t < 0:
            if not nearest_only:
                hits.triangle[p] = SKY
                hits.surface[p] = SKY
                hits.material[p] = SKY
                hits.depth[p] = np.inf
            continue
        if nearest_only and depth[n] >= hits.depth[p]:
            continue
        t += first
        hits.triangle[p] = t
        hits.surface[p] = facets.surface[t]
        hits.material[p] = facets.material[t]
        hits.depth[p] = depth[n]
        w = 1.0 - u[n] - v[n]
        hits.offset_kelvin[p] = (
            w * facets.offset_kelvin[t, 0]
            + u[n] * facets.offset_kelvin[t, 1]
            + v[n] * facets.offset_kelvin[t, 2]
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
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            wanted = thin[i // 2, j // 2]
            p = i * (width + 1) + j
            if wanted == SIMPLE and not _agree(hits.surface, p, 2, 2 * (width + 1)):
                wanted = CORNERS
            level[i, j] = wanted
            level[i, j + 1] = wanted
            level[i + 1, j] = wanted
            level[i + 1, j + 1] = wanted


@njit(cache=True, nogil=True, error_model="numpy")
def refine_pixels(hits: Hits, level: NDArray[np.uint8]) -> None:
    """Raise pixels whose own corners disagree to DETAILED, or to MIXED among leaves."""
    height, width = level.shape
    for y in range(height):
        for x in range(width):
            p = y * (width + 1) + x
            if level[y, x] == CORNERS and not _agree(hits.surface, p, 1, width + 1):
                leafy = hits.material[p] == _FOLIAGE or hits.material[p] == _HEDGE
                leaves = leafy and _agree(hits.material, p, 1, width + 1)
                level[y, x] = MIXED if leaves else DETAILED


@njit(cache=True, nogil=True, error_model="numpy")
def corner_points(hits: Hits, level: NDArray[np.uint8], out: NDArray[np.int32]) -> int:
    """Corners, not cast yet, of the pixels beyond SIMPLE.

    Writes their numbers to ``out``, marks them as taken and returns how many there are.
    """
    height, width = level.shape
    count = 0
    for y in range(height):
        for x in range(width):
            if level[y, x] == SIMPLE:
                continue
            p = y * (width + 1) + x
            for q in (p, p + 1, p + width + 1, p + width + 2):
                if hits.triangle[q] == NOT_CAST:
                    hits.triangle[q] = SKY
                    out[count] = q
                    count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def inner_points(level: NDArray[np.uint8], inner: int, out: NDArray[np.int32]) -> int:
    """The ``inner`` rays of the DETAILED pixels; like ``corner_points``."""
    height, width = level.shape
    first = (height + 1) * (width + 1)
    count = 0
    for y in range(height):
        for x in range(width):
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
                t = hits.triangle[p]
                samples.pixel[total] = pixel
                samples.triangle[total] = t
                samples.plane[total, 0] = rays.centres[y, x, 0]
                samples.plane[total, 1] = rays.centres[y, x, 1]
                samples.weight[total] = 1.0
                depth[y, x] = np.inf
                if t >= 0:
                    a, b, c, d = p, p + right, p + down, p + down + right
                    # The inverse depth of a plane is linear in the image.
                    rho = (1.0 - v) * ((1.0 - u) / hits.depth[a] + u / hits.depth[b]) + v * (
                        (1.0 - u) / hits.depth[c] + u / hits.depth[d]
                    )
                    samples.offset_kelvin[total] = (1.0 - v) * (
                        (1.0 - u) * hits.offset_kelvin[a] + u * hits.offset_kelvin[b]
                    ) + v * ((1.0 - u) * hits.offset_kelvin[c] + u * hits.offset_kelvin[d])
                    depth[y, x] = 1.0 / rho
                    samples.depth[total] = depth[y, x]
                owner[y, x] = _owner(facets, t)
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
                s = hits.surface[q]
                k = 0
                while k < count and surfaces[k] != s:
                    k += 1
                m = total + k
                if k == count:
                    surfaces[k] = s
                    samples.pixel[m] = pixel
                    samples.triangle[m] = hits.triangle[q]
                    samples.weight[m] = 0.0
                    samples.plane[m] = 0.0
                    samples.depth[m] = 0.0
                    samples.offset_kelvin[m] = 0.0
                    count += 1
                w = corner_weight if n < 4 else inner_weight
                samples.weight[m] += w
                samples.plane[m, 0] += w * rays.grid[q, 0]
                samples.plane[m, 1] += w * rays.grid[q, 1]
                if s >= 0:
                    samples.depth[m] += w / hits.depth[q]
                    samples.offset_kelvin[m] += w * hits.offset_kelvin[q]
            largest = total
            for m in range(total, total + count):
                w = samples.weight[m]
                samples.plane[m, 0] /= w
                samples.plane[m, 1] /= w
                samples.offset_kelvin[m] /= w
                samples.depth[m] = w / samples.depth[m]
                if w > samples.weight[largest]:
                    largest = m
            depth[y, x] = samples.depth[largest] if samples.triangle[largest] >= 0 else np.inf
            owner[y, x] = _owner(facets, samples.triangle[largest])
            total += count
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def shade_samples(
    samples: Samples,
    count: int,
    rays: Rays,
    facets: Facets,
    band: Band,
    light: Light,
    heating: NDArray[np.float64],
    pixel_rad: float,
    radiance: NDArray[np.float32],
) -> None:
    """Add up ``radiance`` (H, W), zero before; ``heating`` (materials,) K warms the surfaces."""
    width = radiance.shape[1]
    flat = radiance.reshape(-1)
    for n in range(count):
        pixel = samples.pixel[n]
        row = 2 * (pixel // width) + 1
        px = np.float64(samples.plane[n, 0])
        py = np.float64(samples.plane[n, 1])
        length = np.sqrt(1.0 + px * px + py * py)
        R = rays.rotations[row]
        dx = (R[0, 0] * px + R[0, 1] * py + R[0, 2]) / length
        dy = (R[1, 0] * px + R[1, 1] * py + R[1, 2]) / length
        dz = (R[2, 0] * px + R[2, 1] * py + R[2, 2]) / length
        t = samples.triangle[n]
        if t < 0:
            flat[pixel] += samples.weight[n] * sky_radiance(band, dx, dy, dz, True)
            continue
        distance = samples.depth[n] * length
        moved = t >= facets.first_moving
        mover = facets.mover[t - facets.first_moving] if moved else 0
        material = facets.material[t]
        value = shade(
            band,
            light,
            material,
            samples.offset_kelvin[n] + heating[material],
            rays.origins[row, 0] + distance * dx,
            rays.origins[row, 1] + distance * dy,
            rays.origins[row, 2] + distance * dz,
            np.float64(facets.normals[t, 0]),
            np.float64(facets.normals[t, 1]),
            np.float64(facets.normals[t, 2]),
            facets.T_object_map,
            mover,
            moved,
            dx,
            dy,
            dz,
            distance,
            pixel_rad,
        )
        flat[pixel] += samples.weight[n] * value


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _owner(facets: Facets, triangle: int) -> int:
    if triangle < facets.first_moving:
        return -1
    return int(facets.mover[triangle - facets.first_moving])


class LensModel(NamedTuple):
    """Pinhole with radial-tangential distortion, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float


@njit(cache=True, nogil=True, error_model="numpy")
def mark_slender(
    thin: NDArray[np.float32],
    T_camera_map: NDArray[np.float64],
    lens: LensModel,
    limits_px: tuple[float, float, float],
    mask: NDArray[np.uint8],
) -> None:
    """Raise the blocks of ``mask`` (H / 2, W / 2) that slender parts (K, 7) cross.

    ``limits_px``: parts narrower than the first are invisible, below the second they ask for
    DETAILED, below the third for CORNERS, and wider ones for nothing.
    """
    near_m, side = 0.3, 1.3
    rows, columns = mask.shape
    R = T_camera_map
    ends = np.empty((2, 3))
    for n in range(len(thin)):
        w = lens.fx * thin[n, 6]
        for e in range(2):
            for k in range(3):
                ends[e, k] = R[k, 3]
                for m in range(3):
                    ends[e, k] += R[k, m] * thin[n, 3 * e + m]
        far = max(ends[0, 2], ends[1, 2])
        near = max(min(ends[0, 2], ends[1, 2]), near_m)
        if far < near_m or w > limits_px[2] * far or w < limits_px[0] * near:
            continue
        for e in range(2):
            if ends[e, 2] < near_m:
                f = (near_m - ends[e, 2]) / (ends[1 - e, 2] - ends[e, 2])
                for k in range(3):
                    ends[e, k] += f * (ends[1 - e, k] - ends[e, k])
        ax, ay = ends[0, 0] / ends[0, 2], ends[0, 1] / ends[0, 2]
        bx, by = ends[1, 0] / ends[1, 2], ends[1, 1] / ends[1, 2]
        if min(ax, bx) > side or max(ax, bx) < -side or min(ay, by) > side or max(ay, by) < -side:
            continue
        steps = int(0.5 * max(abs(bx - ax) * lens.fx, abs(by - ay) * lens.fy)) + 1
        for i in range(steps + 1):
            # Straight on the plane z = 1; the width belongs to the depth there.
            f = i / steps
            x = ax + f * (bx - ax)
            y = ay + f * (by - ay)
            if abs(x) > side or abs(y) > side:
                continue
            z = 1.0 / ((1.0 - f) / ends[0, 2] + f / ends[1, 2])
            level = SIMPLE
            if w < limits_px[1] * z:
                level = DETAILED
            elif w < limits_px[2] * z:
                level = CORNERS
            if level == SIMPLE or w < limits_px[0] * z:
                continue
            r = x * x + y * y
            radial = 1.0 + r * (lens.k1 + r * (lens.k2 + r * lens.k3))
            u = lens.fx * (x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r + 2.0 * x * x))
            v = lens.fy * (y * radial + lens.p1 * (r + 2.0 * y * y) + 2.0 * lens.p2 * x * y)
            # The block that holds the point, and the nearest one in either direction.
            u = 0.5 * (u + lens.cx + 0.5)
            v = 0.5 * (v + lens.cy + 0.5)
            j, i0 = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            for row in range(max(i0, 0), min(i0 + 2, rows)):
                for column in range(max(j, 0), min(j + 2, columns)):
                    if mask[row, column] < level:
                        mask[row, column] = level
