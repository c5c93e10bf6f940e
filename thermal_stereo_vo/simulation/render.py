"""What a perfect camera at a known pose would receive."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.transforms import inverse, transform_points
from thermal_stereo_vo.simulation import sampling
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import Mesh
from thermal_stereo_vo.simulation.ray_casting import RayCaster
from thermal_stereo_vo.simulation.sampling import Facets, Hits, Rays, Samples
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.shading import Band, Light, empty_points, shade_samples
from thermal_stereo_vo.simulation.slender import LensModel, mark_slender
from thermal_stereo_vo.simulation.texture import empty_patches

Poses = Callable[[float], NDArray[np.float64]]
"""Time (s) -> (4, 4) T_map_camera."""

_SLENDER_LIMITS_PX = (0.2, 1.0, 2.1)
_BATCH = 1024
"""Samples that are shaded together: few enough for the fast memory."""
_NEAREST_M = 0.02
_FARTHEST_MOVER_M = 200.0


class Lens:
    """The rays of a camera, through its distortion.

    ``grid`` (points, 2) and ``centres`` (H, W, 2) float32: x and y on the plane z = 1, see
    ``sampling``.  ``pixels_per_plane`` (H, W, 2, 2) float32: the Jacobian d(pixel) / d(plane).
    ``blocks`` are the grid points at the corners of blocks of 2x2 pixels; ``lowest`` and
    ``highest`` (2,) bound the grid.  ``inner_rays`` resolve a pixel that shows an edge.
    """

    def __init__(self, camera: Camera, inner_rays: int = 2) -> None:
        self.camera = camera
        self.inner_rays = inner_rays
        width, height = camera.size
        if width % 2 or height % 2:
            raise SimulationError(
                f"images of {width}x{height} pixels cannot be rendered: both must be even; choose "
                "another scale"
            )
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        corner_x, corner_y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
        black = (x + y) % 2 == 1
        parts = [(corner_x, corner_y)]
        parts += [
            (x + np.where(black, -dy, dx), y + np.where(black, dx, dy))
            for dx, dy in sampling.inner_rays_px(inner_rays)
        ]
        points = np.concatenate([np.column_stack([a.ravel(), b.ravel()]) for a, b in parts])
        self.grid = np.ascontiguousarray(camera.unproject(points)[:, :2], dtype=np.float32)
        centres = camera.unproject(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        self.centres = np.ascontiguousarray(
            centres[:, :2].reshape(height, width, 2), dtype=np.float32
        )
        self.blocks = sampling.block_points(height, width)
        self.lowest = self.grid.min(axis=0)
        self.highest = self.grid.max(axis=0)
        self.pixel_rad = float(1.0 / np.sqrt(camera.fx * camera.fy))
        corners = self.grid[: (width + 1) * (height + 1)].astype(np.float64)
        corners = corners.reshape(height + 1, width + 1, 2)
        along_x = (corners[:-1, 1:] + corners[1:, 1:] - corners[:-1, :-1] - corners[1:, :-1]) / 2
        along_y = (corners[1:, :-1] + corners[1:, 1:] - corners[:-1, :-1] - corners[:-1, 1:]) / 2
        jacobian = np.stack([along_x, along_y], axis=-1)
        self.pixels_per_plane = np.linalg.inv(jacobian).astype(np.float32)


@dataclass(frozen=True)
class Rendering:
    """Noise-free image of one camera.

    ``radiance`` (H, W) float32 in the unit of the band; ``depth_m`` (H, W) float32 along the
    optical axis at the pixel centre, inf for sky; ``owner`` (H, W) int32, -1 on what stands still,
    else the index of the mover.
    """

    radiance: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    owner: NDArray[np.int32]


class _Moving(NamedTuple):
    """Movers in view: their ray-casting tree, and the number of each triangle among all movers."""

    caster: RayCaster
    triangles: NDArray[np.int32]


class Renderer:
    """Renders one scene.  Keeps scratch memory: one thread at a time."""

    def __init__(self, scene: Scene, light: Light, static: RayCaster | None = None) -> None:
        """``static`` may be the ray-casting tree of what stands still, if there is one already."""
        self._scene = scene
        self._light = light
        self._static = static or RayCaster(scene.static.vertices)
        meshes = [scene.static, *(mover.mesh for mover in scene.movers)]
        shifts = np.cumsum([0, *(mesh.surfaces for mesh in meshes)])
        count = len(scene.static)
        mover = [np.full(len(m.mesh), n, np.int32) for n, m in enumerate(scene.movers)]
        self._facets = Facets(
            np.concatenate([_normals(mesh.vertices) for mesh in meshes]),
            np.concatenate([mesh.material for mesh in meshes]),
            np.concatenate(
                [mesh.surface + shift for mesh, shift in zip(meshes, shifts, strict=False)]
            ).astype(np.int32),
            np.ascontiguousarray(np.concatenate([mesh.offset_kelvin for mesh in meshes])),
            count,
            np.concatenate([np.zeros(0, np.int32), *mover]),
            np.tile(np.eye(4), (max(1, len(scene.movers)), 1, 1)),
        )
        self._rest_normals = self._facets.normals[count:].copy()
        self._mover_starts = np.cumsum([0, *(len(m.mesh) for m in scene.movers)])
        self._hits: dict[int, Hits] = {}
        self._samples: dict[int, Samples] = {}
        self._points, self._patches = empty_points(_BATCH), empty_patches(_BATCH)
        self._corners = [_box_corners(m.mesh) for m in scene.movers]

    def render(
        self, lens: Lens, band: Band, poses: Poses, time_s: float, *, row_time_s: float = 0.0
    ) -> Rendering:
        """What the camera sees at a time; the rows are read ``row_time_s`` after each other."""
        height, width = lens.centres.shape[:2]
        rays = _rays(lens, poses, time_s, row_time_s)
        movers = self.T_map_movers(time_s)
        views = [inverse(poses(time_s))]
        if row_time_s > 0.0:
            views.append(inverse(poses(time_s + row_time_s * height)))
        seen, frames = self._movers_in_view(lens, views, movers)
        moving = self._place_movers(movers, seen)
        thin = self._slender(lens.camera, views[0], movers, seen)
        hits = self._scratch(len(lens.grid))
        hits.triangle.fill(sampling.NOT_CAST)
        level = np.empty((height, width), np.uint8)

        self._cast(hits, rays, lens.blocks, moving, frames)
        sampling.refine_blocks(hits, level, thin)
        points = np.empty(len(lens.grid), np.int32)
        count = sampling.corner_points(hits, level, points)
        self._cast(hits, rays, points[:count], moving, frames)
        sampling.refine_pixels(hits, level)
        count = sampling.inner_points(level, lens.inner_rays, points)
        self._cast(hits, rays, points[:count], moving, frames)

        radiance = np.zeros((height, width), np.float32)
        depth = np.empty((height, width), np.float32)
        owner = np.empty((height, width), np.int32)
        samples = self._sample_scratch(height * width * (4 + lens.inner_rays))
        count = sampling.gather_samples(hits, rays, self._facets, level, samples, depth, owner)
        shade_samples(
            samples,
            count,
            rays,
            self._facets,
            band,
            self._light,
            self._heating(time_s),
            lens.pixel_rad,
            self._points,
            self._patches,
            radiance,
        )
        return Rendering(radiance, depth, owner)

    def T_map_movers(self, time_s: float) -> NDArray[np.float64]:
        """(M, 4, 4) poses of the movers."""
        poses = [mover.T_map_object(time_s) for mover in self._scene.movers]
        return np.array(poses).reshape(-1, 4, 4)

    def _heating(self, time_s: float) -> NDArray[np.float64]:
        kelvin = np.zeros(len(Material))
        for heating in self._scene.heating:
            kelvin[heating.material] += heating.kelvin(time_s)
        return kelvin

    def _scratch(self, points: int) -> Hits:
        if points not in self._hits:
            self._hits[points] = Hits(
                np.empty(points, np.int32),
                np.empty(points, np.int32),
                np.empty(points, np.int32),
                np.empty(points, np.float32),
                np.empty(points, np.float32),
            )
        return self._hits[points]

    def _sample_scratch(self, n: int) -> Samples:
        # Room for the worst case; untouched memory costs nothing.
        if n not in self._samples:
            self._samples[n] = Samples(
                np.empty(n, np.int32),
                np.empty(n, np.int32),
                np.empty((n, 2), np.float32),
                np.empty(n, np.float32),
                np.empty(n, np.float32),
                np.empty(n, np.float32),
            )
        return self._samples[n]

    def _place_movers(self, poses: NDArray[np.float64], seen: list[int]) -> _Moving | None:
        """Put the movers in view where they are now."""
        if not seen:
            return None
        vertices, triangles = [], []
        for n in seen:
            rotation, first = poses[n][:3, :3], self._mover_starts[n]
            mesh = self._scene.movers[n].mesh
            vertices.append(mesh.vertices @ rotation.T + poses[n][:3, 3])
            mine = slice(first, first + len(mesh))
            self._facets.normals[self._facets.first_moving :][mine] = (
                self._rest_normals[mine] @ rotation.T
            )
            self._facets.T_object_map[n] = inverse(poses[n])
            triangles.append(np.arange(first, first + len(mesh), dtype=np.int32))
        caster = RayCaster(np.concatenate(vertices).astype(np.float32))
        return _Moving(caster, np.concatenate(triangles))

    def _cast(
        self,
        hits: Hits,
        rays: Rays,
        points: NDArray[np.int32],
        moving: _Moving | None,
        frames: NDArray[np.float64],
    ) -> None:
        origins = np.empty((len(points), 3), np.float32)
        directions = np.empty((len(points), 3), np.float32)
        sampling.build_rays(rays, points, origins, directions)
        met = self._static.cast(origins, directions)
        sampling.store_hits(
            hits, self._facets, points, met.triangle, 0, met.u, met.v, met.distance, False
        )
        if moving is None:
            return
        inside = sampling.points_in_frames(rays.grid, points, frames)
        if np.any(inside):
            met = moving.caster.cast(origins[inside], directions[inside])
            # Number them among all movers, not only those in view.
            numbers = np.where(met.triangle >= 0, moving.triangles[met.triangle], -1)
            first = self._facets.first_moving
            sampling.store_hits(
                hits, self._facets, points[inside], numbers, first, met.u, met.v,
                met.distance, True,
            )  # fmt: skip

    def _movers_in_view(
        self, lens: Lens, views: list[NDArray[np.float64]], movers: NDArray[np.float64]
    ) -> tuple[list[int], NDArray[np.float64]]:
        """Which movers may be seen from one of the ``views`` (4, 4) T_camera_map.

        Returns their numbers and what holds each of them on the plane z = 1: (N, 4) lowest x and y,
        highest x and y.
        """
        seen, frames = [], []
        for n, (T_map_object, corners) in enumerate(zip(movers, self._corners, strict=True)):
            places = [
                transform_points(T_camera_map @ T_map_object, corners) for T_camera_map in views
            ]
            if np.linalg.norm(places[0], axis=1).min() > _FARTHEST_MOVER_M:
                continue
            frame = _frame_on_plane(places)
            if np.all(frame[:2] <= lens.highest) and np.all(frame[2:] >= lens.lowest):
                seen.append(n)
                frames.append(frame)
        return seen, np.array(frames).reshape(-1, 4)

    def _slender(
        self, camera: Camera, T_camera_map: NDArray[np.float64], movers: NDArray[np.float64],
        seen: list[int],
    ) -> NDArray[np.uint8]:  # fmt: skip
        """(H / 2, W / 2): levels that slender parts ask for."""
        mask = np.zeros((camera.height // 2, camera.width // 2), np.uint8)
        k1, k2, p1, p2, k3 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
        lens = LensModel(camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, p1, p2, k3)
        mark_slender(self._scene.static.thin, T_camera_map, lens, _SLENDER_LIMITS_PX, mask)
        for n in seen:
            thin = self._scene.movers[n].mesh.thin
            mark_slender(thin, T_camera_map @ movers[n], lens, _SLENDER_LIMITS_PX, mask)
        return mask


def _rays(lens: Lens, poses: Poses, time_s: float, row_time_s: float) -> Rays:
    rows = 2 * lens.centres.shape[0] + 1
    if row_time_s == 0.0:
        T = poses(time_s)
        rotations = np.ascontiguousarray(np.broadcast_to(T[:3, :3], (rows, 3, 3)))
        origins = np.ascontiguousarray(np.broadcast_to(T[:3, 3], (rows, 3)))
        return Rays(lens.grid, lens.centres, rotations, origins)
    each = np.array([poses(time_s + row_time_s * (i - 1) / 2) for i in range(rows)])
    return Rays(
        lens.grid,
        lens.centres,
        np.ascontiguousarray(each[:, :3, :3]),
        np.ascontiguousarray(each[:, :3, 3]),
    )


def _normals(vertices: NDArray[np.float32]) -> NDArray[np.float32]:
    normals = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.ascontiguousarray(normals, dtype=np.float32)


def _box_corners(mesh: Mesh) -> NDArray[np.float64]:
    """(8, 3) corners of the upright box that holds a mesh."""
    points = mesh.vertices.reshape(-1, 3).astype(np.float64)
    ends = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.array(list(itertools.product(*ends.T)))


def _frame_on_plane(places: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """(4,) lowest x and y, highest x and y on the plane z = 1 of convex bodies (8, 3).

    What lies behind the camera is cut off; lowest above highest where nothing is left.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for corners in places:
        front = corners[:, 2] > _NEAREST_M
        kept = [corners[front]]
        if not np.all(front):
            # Where lines between the corners pass the nearest plane; edges are among them.
            a, b = corners[front][:, None], corners[~front][None]
            f = (_NEAREST_M - a[..., 2:]) / (b[..., 2:] - a[..., 2:])
            kept.append((a + f * (b - a)).reshape(-1, 3))
        points = np.concatenate(kept)
        if len(points):
            plane = points[:, :2] / points[:, 2:]
            low, high = np.minimum(low, plane.min(axis=0)), np.maximum(high, plane.max(axis=0))
    return np.concatenate([low, high])
