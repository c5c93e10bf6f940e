"""Ray casting: what a perfect camera at a known pose would receive.

Embree finds what each ray hits; a pixel whose neighbourhood shows more than one surface is cast
again with 2x2 rays, the others need one because their texture is already limited to the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.simulation.mesh import Mesh
from thermal_stereo_vo.simulation.scene import Scene
from thermal_stereo_vo.simulation.shading import Hits, Surfaces

Floats = NDArray[np.float32]
SKY = -1


class Band(Protocol):
    """How points and sky look in one spectral band."""

    def surfaces(self, hits: Hits, surfaces: Surfaces) -> Floats:
        """(N,) radiance of the points hit."""

    def sky(self, directions: Floats) -> Floats:
        """(N,) radiance of the sky."""


class Lens:
    """Rays of a camera: (H, W, 3) float32 with z = 1 in camera axes, so that depth is along z.

    ``sub`` (4, H, W, 3) are the 2x2 rays of each pixel.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.centre = self._rays(0.0, 0.0)
        offsets = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]
        self.sub = np.stack([self._rays(dx, dy) for dx, dy in offsets])
        self.pixel_rad = 1.0 / np.sqrt(camera.fx * camera.fy)

    def _rays(self, dx: float, dy: float) -> Floats:
        x, y = np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height))
        pixels = np.column_stack([x.ravel() + dx, y.ravel() + dy]).astype(np.float64)
        rays = self.camera.unproject(pixels)
        return rays.reshape(self.camera.height, self.camera.width, 3).astype(np.float32)


@dataclass(frozen=True)
class Rendering:
    """Noise-free image of one camera.

    ``radiance`` (H, W) float32 in the unit of the band; ``depth_m`` (H, W) float32 along the
    optical axis at the pixel centre, inf for sky; ``moving`` (H, W) bool, True on moving objects.
    """

    radiance: Floats
    depth_m: Floats
    moving: NDArray[np.bool_]


class _Solid:
    """A mesh with its ray-casting tree."""

    def __init__(self, mesh: Mesh) -> None:
        self.surfaces = Surfaces.of(mesh)
        self.surface_of = mesh.surface
        self._tree = EmbreeScene()
        TriangleMesh(self._tree, np.ascontiguousarray(mesh.vertices, dtype=np.float32))

    def cast(self, origin: Floats, directions: Floats, pixel_rad: float) -> Hits:
        """First hits; triangle is SKY and depth huge where there is none."""
        origins = np.ascontiguousarray(np.broadcast_to(origin, directions.shape), dtype=np.float32)
        found = self._tree.run(origins, directions, output=True)
        return Hits(found["primID"], found["u"], found["v"], found["tfar"], directions, pixel_rad)


class Renderer:
    """Renders one scene in one band.  Not shared between threads or processes."""

    def __init__(self, scene: Scene, band: Band) -> None:
        self._scene = scene
        self._band = band
        self._static = _Solid(scene.static)

    def render(self, lens: Lens, T_map_camera: NDArray[np.float64], time_s: float) -> Rendering:
        """What the camera sees from ``T_map_camera`` (4, 4) at this time."""
        height, width = lens.centre.shape[:2]
        moving = self._scene.moving(time_s)
        solids = [self._static] if moving is None else [self._static, _Solid(moving)]
        radiance, depth, surface = self._cast(
            solids, lens.centre.reshape(-1, 3), T_map_camera, lens.pixel_rad
        )
        surface = surface.reshape(height, width)
        radiance = radiance.reshape(height, width)
        edge = _edges(surface)
        rays = lens.sub[:, edge].reshape(-1, 3)
        samples, _, _ = self._cast(solids, rays, T_map_camera, 0.5 * lens.pixel_rad)
        radiance[edge] = samples.reshape(4, -1).mean(axis=0)
        return Rendering(
            radiance, depth.reshape(height, width), surface >= self._first_moving_surface()
        )

    def _first_moving_surface(self) -> int:
        return int(self._static.surface_of.max(initial=0)) + 1

    def _cast(
        self,
        solids: list[_Solid],
        rays: Floats,
        T_map_camera: NDArray[np.float64],
        pixel_rad: float,
    ) -> tuple[Floats, Floats, NDArray[np.int32]]:
        directions = rays @ T_map_camera[:3, :3].T.astype(np.float32)
        origin = T_map_camera[:3, 3].astype(np.float32)
        radiance = np.empty(len(rays), np.float32)
        depth = np.full(len(rays), np.inf, np.float32)
        surface = np.full(len(rays), SKY, np.int32)
        owner = np.full(len(rays), SKY, np.int8)
        casts = []
        for number, solid in enumerate(solids):
            hits = solid.cast(origin, directions, pixel_rad)
            casts.append(hits)
            nearer = (hits.triangle >= 0) & (hits.depth < depth)
            depth[nearer] = hits.depth[nearer]
            owner[nearer] = number
            shift = 0 if number == 0 else self._first_moving_surface()
            surface[nearer] = solid.surface_of[hits.triangle[nearer]] + shift
        for number, (solid, hits) in enumerate(zip(solids, casts, strict=True)):
            mine = np.flatnonzero(owner == number)
            if len(mine):
                part = Hits(
                    hits.triangle[mine],
                    hits.u[mine],
                    hits.v[mine],
                    hits.depth[mine],
                    directions[mine],
                    pixel_rad,
                )
                radiance[mine] = self._band.surfaces(part, solid.surfaces)
        sky = np.flatnonzero(owner == SKY)
        if len(sky):
            radiance[sky] = self._band.sky(directions[sky])
        return radiance, depth, surface


def _edges(surface: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(H, W) True where one of the eight neighbours shows another surface."""
    edge = np.zeros(surface.shape, bool)
    right = surface[:, 1:] != surface[:, :-1]
    down = surface[1:] != surface[:-1]
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    edge[1:] |= down
    edge[:-1] |= down
    return edge
