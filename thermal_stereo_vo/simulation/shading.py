"""Radiance of the points that rays hit: textures, temperatures, reflections, air.

Kernels in numba; every octave finer than the pixel is faded out, so that nothing aliases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.mesh import Mesh
from thermal_stereo_vo.simulation.noise import LATTICE, ROTATION, SHIFT, value_noise
from thermal_stereo_vo.simulation.thermal_field import (
    PLANCK_B_KELVIN,
    PLANCK_F,
    Column,
    Responsivity,
    thermal_table,
    visible_table,
)
from thermal_stereo_vo.simulation.weather import Weather

Floats = NDArray[np.float32]

_EMISSIVITY, _BASE, _SUN, _SKY = Column.EMISSIVITY, Column.BASE, Column.SUN, Column.SKY
_OFFSET, _MIRROR, _AMPLITUDE = Column.OFFSET, Column.MIRROR, Column.AMPLITUDE
_SPACING, _OCTAVES, _PERSISTENCE = Column.SPACING, Column.OCTAVES, Column.PERSISTENCE
_CRACKS, _PATCHES, _CELLS, _JOINTS = Column.CRACKS, Column.PATCHES, Column.CELLS, Column.JOINTS
_CELL_ALONG, _CELL_UP = Column.CELL_ALONG, Column.CELL_UP

# Value noise of a lattice uniform in -1..1 has this standard deviation (measured on 1e6 points).
_NOISE_SIGMA = 0.33
# Mean slope of that noise where it crosses zero, per lattice cell.
_NOISE_SLOPE = 1.1
_LINE_HALF_WIDTH_M = 0.015
_CELLS_IN_LATTICE = LATTICE**3


@dataclass(frozen=True)
class Surfaces:
    """A mesh in the form the kernels read: contiguous arrays, with unit normals (N, 3)."""

    rest: Floats
    normals: Floats
    material: NDArray[np.int32]
    offset_kelvin: Floats
    turned: bool
    """True when the mesh was moved, so that rest axes are not map axes."""

    @classmethod
    def of(cls, mesh: Mesh) -> Surfaces:
        edge_1 = mesh.vertices[:, 1] - mesh.vertices[:, 0]
        edge_2 = mesh.vertices[:, 2] - mesh.vertices[:, 0]
        normals = np.cross(edge_1, edge_2)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return cls(
            np.ascontiguousarray(mesh.rest),
            np.ascontiguousarray(normals, dtype=np.float32),
            mesh.material,
            np.ascontiguousarray(mesh.offset_kelvin),
            mesh.rest is not mesh.vertices,
        )


@dataclass(frozen=True)
class Hits:
    """Where N rays ended: triangle, barycentric u and v, depth along the ray (in ray lengths).

    ``directions`` (N, 3) float32 in map axes, of any length.  ``pixel_rad`` is the angle between
    neighbouring rays.
    """

    triangle: NDArray[np.int32]
    u: Floats
    v: Floats
    depth: Floats
    directions: Floats
    pixel_rad: float


class ThermalBand:
    """8-14 um: radiance in counts of an ideal sensor without offset."""

    def __init__(
        self, weather: Weather, responsivity: Responsivity, lattice: NDArray[np.float32]
    ) -> None:
        self._table = thermal_table(weather)
        self._lattice = lattice
        self._planck_r = responsivity.planck_r
        self._weather = weather

    def surfaces(self, hits: Hits, surfaces: Surfaces) -> Floats:
        """(N,) radiance of the points hit."""
        out = np.empty(len(hits.triangle), np.float32)
        weather = self._weather
        _shade_thermal(
            hits.triangle,
            hits.u,
            hits.v,
            hits.depth,
            hits.directions,
            hits.pixel_rad,
            surfaces.rest,
            surfaces.normals,
            surfaces.material,
            surfaces.offset_kelvin,
            surfaces.turned,
            self._table,
            self._lattice,
            self._planck_r,
            weather.air_kelvin,
            weather.sky_emissivity,
            weather.cloud_variation,
            weather.extinction_per_m,
            _sun_direction(weather),
            out,
        )
        return out

    def sky(self, directions: Floats) -> Floats:
        """(N,) radiance of the sky in these directions."""
        out = np.empty(len(directions), np.float32)
        weather = self._weather
        _shade_sky(
            directions,
            self._lattice,
            self._planck_r,
            weather.air_kelvin,
            weather.sky_emissivity,
            weather.cloud_variation,
            out,
        )
        return out


class VisibleBand:
    """0.4-0.7 um: reflected light, 1 for a white surface in full daylight."""

    def __init__(self, weather: Weather, lattice: NDArray[np.float32]) -> None:
        self._table = visible_table()
        self._lattice = lattice
        self._weather = weather

    def surfaces(self, hits: Hits, surfaces: Surfaces) -> Floats:
        """(N,) light from the points hit."""
        out = np.empty(len(hits.triangle), np.float32)
        _shade_visible(
            hits.triangle,
            hits.u,
            hits.v,
            hits.depth,
            hits.directions,
            hits.pixel_rad,
            surfaces.rest,
            surfaces.normals,
            surfaces.material,
            surfaces.turned,
            self._table,
            self._lattice,
            self._weather.illumination,
            self._weather.sun,
            _sun_direction(self._weather),
            out,
        )
        return out

    def sky(self, directions: Floats) -> Floats:
        """(N,) light of the sky in these directions."""
        z = directions[:, 2] / np.linalg.norm(directions, axis=1)
        glow = 0.55 + 0.35 * (1.0 - np.clip(z, 0.0, 1.0))
        return np.asarray(glow * self._weather.illumination, dtype=np.float32)


def _sun_direction(weather: Weather) -> NDArray[np.float64]:
    elevation = np.radians(weather.sun_elevation_deg)
    azimuth = np.radians(weather.sun_azimuth_deg)
    return np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )


_R = ROTATION
_C = SHIFT


@njit(cache=True, nogil=True)
def texture(
    lattice: NDArray[np.float32],
    row: NDArray[np.float64],
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    ax: float,
    ay: float,
    az: float,
    across_m: float,
    along_m: float,
) -> float:
    """Variation of a material at a point, in the unit of its amplitudes.

    (x, y, z) and normal (nx, ny, nz) in rest axes (m); (ax, ay, az) is the unit direction in which
    the pixel is stretched over the surface: ``along_m`` that way, ``across_m`` the other.
    """
    value = 0.0
    spacing = row[_SPACING]
    amplitude = row[_AMPLITUDE] / _NOISE_SIGMA
    px = x / spacing
    py = y / spacing
    pz = z / spacing
    if row[_CRACKS] != 0.0:
        n = value_noise(lattice, px + 7.7, py + 3.1, pz + 40.9)
        width = max(_LINE_HALF_WIDTH_M, across_m)
        distance = abs(n) * spacing / _NOISE_SLOPE
        if distance < width:
            value += row[_CRACKS] * _LINE_HALF_WIDTH_M / width * (1.0 - distance / width)
    if row[_PATCHES] != 0.0:
        n = value_noise(lattice, 0.4 * px + 29.3, 0.4 * py + 11.9, 0.4 * pz + 2.2)
        step = 0.5 + n * 2.5 * spacing / _NOISE_SLOPE / max(2.0 * _LINE_HALF_WIDTH_M, across_m)
        value += row[_PATCHES] * (min(max(step, 0.0), 1.0) - 0.5)
    if row[_CELL_ALONG] > 0.0:
        value += _tiles(lattice, row, x, y, z, nx, ny, nz, across_m)

    dx = ax * along_m / spacing
    dy = ay * along_m / spacing
    dz = az * along_m / spacing
    for _ in range(int(row[_OCTAVES])):
        samples = 1
        if along_m > 0.5 * spacing:
            samples = min(4, int(2.0 * along_m / spacing) + 1)
        footprint = max(across_m, along_m / samples)
        weight = min(max(spacing / footprint - 1.0, 0.0), 1.0)
        if weight <= 0.0:
            break
        weight = weight * weight * (3.0 - 2.0 * weight)
        total = 0.0
        for i in range(samples):
            f = (i + 0.5) / samples - 0.5
            total += value_noise(lattice, px + f * dx, py + f * dy, pz + f * dz)
        value += weight * amplitude * total / samples
        amplitude *= row[_PERSISTENCE]
        spacing *= 0.5
        qx = 2.0 * (_R[0, 0] * px + _R[0, 1] * py + _R[0, 2] * pz) + _C[0]
        qy = 2.0 * (_R[1, 0] * px + _R[1, 1] * py + _R[1, 2] * pz) + _C[1]
        qz = 2.0 * (_R[2, 0] * px + _R[2, 1] * py + _R[2, 2] * pz) + _C[2]
        px, py, pz = qx, qy, qz
        qx = 2.0 * (_R[0, 0] * dx + _R[0, 1] * dy + _R[0, 2] * dz)
        qy = 2.0 * (_R[1, 0] * dx + _R[1, 1] * dy + _R[1, 2] * dz)
        qz = 2.0 * (_R[2, 0] * dx + _R[2, 1] * dy + _R[2, 2] * dz)
        dx, dy, dz = qx, qy, qz
    return value


@njit(cache=True, nogil=True)
def _tiles(
    lattice: NDArray[np.float32],
    row: NDArray[np.float64],
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    footprint_m: float,
) -> float:
    if abs(nz) > 0.9:
        a, b = x, y
    else:
        level = np.sqrt(nx * nx + ny * ny)
        a = (-ny * x + nx * y) / level
        b = z / level
    along = row[_CELL_ALONG]
    up = row[_CELL_UP]
    ib = 0.0
    edge_m = 1e9
    size = along
    if up > 0.0:
        b /= up
        ib = np.floor(b)
        edge_m = min(b - ib, ib + 1.0 - b) * up
        size = min(size, up)
    fade = min(max(size / footprint_m - 1.0, 0.0), 1.0)
    if fade <= 0.0:
        return 0.0
    a = a / along + 0.5 * (int(ib) & 1)
    ia = np.floor(a)
    edge_m = min(edge_m, min(a - ia, ia + 1.0 - a) * along)
    h = (int(ia) * 73856093) ^ (int(ib) * 19349663)
    value = row[_CELLS] * lattice[h % _CELLS_IN_LATTICE] * fade
    width = max(_LINE_HALF_WIDTH_M, footprint_m)
    if edge_m < width:
        value += row[_JOINTS] * _LINE_HALF_WIDTH_M / width * (1.0 - edge_m / width) * fade
    return value


@njit(cache=True, nogil=True, inline="always")
def _planck(planck_r: float, kelvin: float) -> float:
    return planck_r / (np.exp(PLANCK_B_KELVIN / kelvin) - PLANCK_F)


@njit(cache=True, nogil=True)
def _sky_radiance(
    lattice: NDArray[np.float32],
    planck_r: float,
    air_kelvin: float,
    zenith_emissivity: float,
    cloud_variation: float,
    dx: float,
    dy: float,
    dz: float,
) -> float:
    # Plane-parallel air: the path, and so its optical depth, grows as 1 / sin(elevation).
    sine = max(dz, 0.03)
    emissivity = 1.0 - (1.0 - min(zenith_emissivity, 0.999)) ** (1.0 / sine)
    if cloud_variation > 0.0:
        x = 2.5 * dx / (sine + 0.1)
        y = 2.5 * dy / (sine + 0.1)
        n = 0.0
        amplitude = 1.0
        for _ in range(4):
            n += amplitude * value_noise(lattice, x, y, 3.3)
            x, y = 1.6 * x - 1.2 * y + 9.1, 1.2 * x + 1.6 * y + 4.3
            amplitude *= 0.55
        emissivity += cloud_variation * n * (1.0 - emissivity) ** 0.5
    emissivity = min(max(emissivity, 0.05), 1.0)
    return emissivity * _planck(planck_r, air_kelvin)


@njit(cache=True, nogil=True)
def _shade_sky(
    directions: Floats,
    lattice: NDArray[np.float32],
    planck_r: float,
    air_kelvin: float,
    zenith_emissivity: float,
    cloud_variation: float,
    out: Floats,
) -> None:
    for i in range(len(directions)):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        out[i] = _sky_radiance(
            lattice,
            planck_r,
            air_kelvin,
            zenith_emissivity,
            cloud_variation,
            dx / length,
            dy / length,
            dz / length,
        )


@njit(cache=True, nogil=True)
def _shade_thermal(
    triangle: NDArray[np.int32],
    us: Floats,
    vs: Floats,
    depth: Floats,
    directions: Floats,
    pixel_rad: float,
    rest: Floats,
    normals: Floats,
    material: NDArray[np.int32],
    offsets: Floats,
    turned: bool,
    table: NDArray[np.float64],
    lattice: NDArray[np.float32],
    planck_r: float,
    air_kelvin: float,
    zenith_emissivity: float,
    cloud_variation: float,
    extinction_per_m: float,
    sun: NDArray[np.float64],
    out: Floats,
) -> None:
    air = _planck(planck_r, air_kelvin)
    # Mean over the hemisphere, for surfaces that do not mirror: close to the sky at 35 degrees.
    sky_mean = _sky_radiance(
        lattice, planck_r, air_kelvin, zenith_emissivity, 0.0, 0.8191, 0.0, 0.5736
    )
    for i in range(len(triangle)):
        k = triangle[i]
        u = us[i]
        v = vs[i]
        w = 1.0 - u - v
        x = w * rest[k, 0, 0] + u * rest[k, 1, 0] + v * rest[k, 2, 0]
        y = w * rest[k, 0, 1] + u * rest[k, 1, 1] + v * rest[k, 2, 1]
        z = w * rest[k, 0, 2] + u * rest[k, 1, 2] + v * rest[k, 2, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        distance = depth[i] * length
        dx /= length
        dy /= length
        dz /= length
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        facing = dx * nx + dy * ny + dz * nz
        if facing > 0.0:
            nx, ny, nz, facing = -nx, -ny, -nz, -facing
        across = distance * pixel_rad
        along = across
        ax = 0.0
        ay = 0.0
        az = 0.0
        if not turned:
            slant = np.sqrt(max(1.0 - facing * facing, 1e-12))
            along = across / max(-facing, 0.02)
            ax = (dx - facing * nx) / slant
            ay = (dy - facing * ny) / slant
            az = (dz - facing * nz) / slant
        row = table[material[k]]
        kelvin = row[_BASE]
        kelvin += row[_OFFSET] * (w * offsets[k, 0] + u * offsets[k, 1] + v * offsets[k, 2])
        kelvin += texture(lattice, row, x, y, z, nx, ny, nz, ax, ay, az, across, along)
        if row[_SUN] != 0.0:
            kelvin += row[_SUN] * max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])
        up = 0.5 * (1.0 + nz)
        kelvin -= row[_SKY] * up * up
        emissivity = row[_EMISSIVITY]
        radiance = emissivity * _planck(planck_r, kelvin)
        if emissivity < 1.0:
            if row[_MIRROR] > 0.0:
                mz = dz - 2.0 * facing * nz
                if mz > 0.0:
                    reflected = _sky_radiance(
                        lattice,
                        planck_r,
                        air_kelvin,
                        zenith_emissivity,
                        cloud_variation,
                        dx - 2.0 * facing * nx,
                        dy - 2.0 * facing * ny,
                        mz,
                    )
                else:
                    reflected = air
            else:
                reflected = up * sky_mean + (1.0 - up) * air
            radiance += (1.0 - emissivity) * reflected
        if extinction_per_m > 0.0:
            through = np.exp(-extinction_per_m * distance)
            radiance = through * radiance + (1.0 - through) * air
        out[i] = radiance


@njit(cache=True, nogil=True)
def _shade_visible(
    triangle: NDArray[np.int32],
    us: Floats,
    vs: Floats,
    depth: Floats,
    directions: Floats,
    pixel_rad: float,
    rest: Floats,
    normals: Floats,
    material: NDArray[np.int32],
    turned: bool,
    table: NDArray[np.float64],
    lattice: NDArray[np.float32],
    illumination: float,
    sunshine: float,
    sun: NDArray[np.float64],
    out: Floats,
) -> None:
    for i in range(len(triangle)):
        k = triangle[i]
        u = us[i]
        v = vs[i]
        w = 1.0 - u - v
        # Another part of the lattice than the thermal texture.
        x = w * rest[k, 0, 0] + u * rest[k, 1, 0] + v * rest[k, 2, 0] + 613.7
        y = w * rest[k, 0, 1] + u * rest[k, 1, 1] + v * rest[k, 2, 1] + 271.3
        z = w * rest[k, 0, 2] + u * rest[k, 1, 2] + v * rest[k, 2, 2] + 118.9
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        across = depth[i] * length * pixel_rad
        dx /= length
        dy /= length
        dz /= length
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        facing = dx * nx + dy * ny + dz * nz
        if facing > 0.0:
            nx, ny, nz, facing = -nx, -ny, -nz, -facing
        along = across
        ax = 0.0
        ay = 0.0
        az = 0.0
        if not turned:
            slant = np.sqrt(max(1.0 - facing * facing, 1e-12))
            along = across / max(-facing, 0.02)
            ax = (dx - facing * nx) / slant
            ay = (dy - facing * ny) / slant
            az = (dz - facing * nz) / slant
        row = table[material[k]]
        variation = texture(lattice, row, x, y, z, nx, ny, nz, ax, ay, az, across, along)
        reflectance = min(max(row[_BASE] * (1.0 + variation), 0.01), 0.95)
        diffuse = 0.5 * (1.0 + 0.6 * nz + 0.15 * nx)
        direct = max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])
        light = (1.0 - 0.7 * sunshine) * diffuse + 0.7 * sunshine * direct
        out[i] = illumination * reflectance * light
