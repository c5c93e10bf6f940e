"""Radiance of what the rays met: temperature, texture, reflection, air; and of the sky."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.noise import value_noise
from thermal_stereo_vo.simulation.sampling import Facets, Rays, Samples
from thermal_stereo_vo.simulation.texture import Patches, vary
from thermal_stereo_vo.simulation.thermal_field import (
    PLANCK_B_KELVIN,
    PLANCK_F,
    Column,
    Responsivity,
    thermal_table,
    visible_table,
)
from thermal_stereo_vo.simulation.weather import Weather

# Plain numbers: older numba does not index with an enumeration.
_EMISSIVITY, _BASE, _SUN = int(Column.EMISSIVITY), int(Column.BASE), int(Column.SUN)
_DAYLIGHT, _SKY, _OFFSET = int(Column.DAYLIGHT), int(Column.SKY), int(Column.OFFSET)
_MIRROR = int(Column.MIRROR)

_SHADOW_BIAS_M = 0.12
_LOWEST_SINE = 0.03


class Band(NamedTuple):
    """How materials and sky look in one spectral band, as the kernels take it.

    ``table`` (materials, columns); ``lattice`` the noise; ``thermal`` chooses between radiance in
    counts and reflected light; the rest is weather.  ``air`` and ``sky`` are the radiance of the
    air
    and the mean of the sky over the hemisphere.
    """

    thermal: bool
    table: NDArray[np.float64]
    lattice: NDArray[np.float32]
    planck_r: float
    air: float
    sky: float
    sky_emissivity: float
    cloud_variation: float
    extinction_per_m: float
    illumination: float
    ambient: float
    sunshine: float
    sun: NDArray[np.float64]


class Light(NamedTuple):
    """What the sun and the sky reach, as maps over the ground.

    ``shadow`` (rows, columns, 2) float32: mean and mean square of the height (m) of what the sun
    meets first, for sun rays through the point (x, y, 0) of the grid.  ``openness`` (rows, columns,
    2) float32: part of the sky seen from the ground, and the height of the ground.  Grids start at
    ``origin`` (2,) m, rows along y.
    """

    shadow: NDArray[np.float32]
    shadow_cell_m: float
    openness: NDArray[np.float32]
    openness_cell_m: float
    origin: NDArray[np.float64]


def open_field() -> Light:
    """Light where nothing casts a shadow."""
    shadow = np.empty((1, 1, 2), np.float32)
    shadow[..., 0], shadow[..., 1] = -1e3, 1e6
    openness = np.ones((1, 1, 2), np.float32)
    return Light(shadow, 1.0, openness, 1.0, np.zeros(2))


def thermal_band(
    weather: Weather, responsivity: Responsivity, lattice: NDArray[np.float32]
) -> Band:
    """8-14 um: radiance in counts of an ideal sensor without offset."""
    air = float(responsivity.counts(weather.air_kelvin))
    band = Band(
        True,
        thermal_table(weather),
        lattice,
        responsivity.planck_r,
        air,
        air,
        weather.sky_emissivity,
        weather.cloud_variation,
        weather.extinction_per_m,
        weather.illumination,
        weather.ambient,
        weather.sun,
        weather.sun_direction,
    )
    # The mean over the hemisphere is close to the sky at 35 degrees.
    return band._replace(sky=sky_radiance(band, 0.8191, 0.0, 0.5736, False))


def visible_band(weather: Weather, lattice: NDArray[np.float32]) -> Band:
    """0.4-0.7 um: reflected light, 1 for a white surface in full daylight."""
    return thermal_band(weather, Responsivity(), lattice)._replace(
        thermal=False, table=visible_table()
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def planck(planck_r: float, kelvin: float) -> float:
    """Counts of a black body."""
    return float(planck_r / (np.exp(PLANCK_B_KELVIN / kelvin) - PLANCK_F))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sky_emissivity(zenith_emissivity: float, sine: float) -> float:
    # Plane-parallel air: the path, and so its optical depth, grows as 1 / sin(elevation).
    return float(1.0 - (1.0 - min(zenith_emissivity, 0.999)) ** (1.0 / sine))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cloud_noise(lattice: NDArray[np.float32], x: float, y: float) -> float:
    """Four octaves, written out: a loop would count references to the lattice."""
    total = value_noise(lattice, x, y)
    x, y = 1.6 * x - 1.2 * y + 9.1, 1.2 * x + 1.6 * y + 4.3
    total += 0.55 * value_noise(lattice, x, y)
    x, y = 1.6 * x - 1.2 * y + 9.1, 1.2 * x + 1.6 * y + 4.3
    total += 0.3025 * value_noise(lattice, x, y)
    x, y = 1.6 * x - 1.2 * y + 9.1, 1.2 * x + 1.6 * y + 4.3
    return float(total + 0.166375 * value_noise(lattice, x, y))


@njit(cache=True, nogil=True, error_model="numpy")
def sky_radiance(band: Band, dx: float, dy: float, dz: float, clouds: bool) -> float:
    """Radiance of the sky in a unit direction, in the unit of the band."""
    sine = max(dz, _LOWEST_SINE)
    if not band.thermal:
        return float(band.illumination * (0.9 - 0.35 * sine))
    emissivity = _sky_emissivity(band.sky_emissivity, sine)
    if clouds and band.cloud_variation > 0.0:
        high = 2.5 / (sine + 0.1)
        noise = _cloud_noise(band.lattice, high * dx, high * dy)
        emissivity += band.cloud_variation * noise * np.sqrt(1.0 - emissivity)
    return float(min(max(emissivity, 0.05), 1.0) * band.air)


class Points(NamedTuple):
    """A batch of samples on the way to their radiance; all float64 (N,), one for each sample.

    Unit direction (``dx``, ``dy``, ``dz``) of the ray, place and unit normal towards the camera in
    map axes, ``facing`` their cosine (negative), ``distance_m`` along the ray, ``up`` the share of
    open sky, ``towards_sun`` the cosine to the sun where it shines, ``variation`` the texture.
    """

    dx: NDArray[np.float64]
    dy: NDArray[np.float64]
    dz: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    nx: NDArray[np.float64]
    ny: NDArray[np.float64]
    nz: NDArray[np.float64]
    facing: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    up: NDArray[np.float64]
    towards_sun: NDArray[np.float64]
    variation: NDArray[np.float64]


def empty_points(count: int) -> Points:
    """Room for ``count`` samples."""
    return Points(*(np.empty(count) for _ in Points._fields))


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
    points: Points,
    patches: Patches,
    radiance: NDArray[np.float32],
) -> None:
    """Add up ``radiance`` (H, W), zero before; ``heating`` (materials,) K warms the surfaces.

    ``points`` and ``patches`` are scratch memory that decides how many samples make a batch.
    """
    # Each step is a loop over plain arrays.  Rows, fields of tuples and arguments of functions
    # with branches would count references at every sample, which takes longer than the sums.
    texture_shift = (0.0, 0.0) if band.thermal else (613.7, 271.3)  # bands share no texture
    batch = len(points.x)
    for first in range(0, count, batch):
        n = min(batch, count - first)
        _locate(samples, first, n, rays, facets, pixel_rad, texture_shift, points, patches)
        _look_up(light.openness, light.openness_cell_m, light.origin, points, n)
        if band.sunshine > 0.0:
            _look_at_sun(light.shadow, light.shadow_cell_m, light.origin, band.sun, points, n)
        vary(band.lattice, band.table, patches, n, points.variation)
        _radiate(samples, first, n, band, heating, points, patches.material, radiance)


@njit(cache=True, nogil=True, error_model="numpy")
def _locate(
    samples: Samples,
    first: int,
    count: int,
    rays: Rays,
    facets: Facets,
    pixel_rad: float,
    texture_shift: tuple[float, float],
    points: Points,
    patches: Patches,
) -> None:
    """Where the samples lie, in the map and on their surface; material -1 for the sky."""
    pixels, triangles, planes, depths = (
        samples.pixel, samples.triangle, samples.plane, samples.depth,
    )  # fmt: skip
    R, origins, width = rays.rotations, rays.origins, rays.centres.shape[1]
    normals, materials, movers = facets.normals, facets.material, facets.mover
    first_moving, T = facets.first_moving, facets.T_object_map
    dxs, dys, dzs, xs, ys, zs = points.dx, points.dy, points.dz, points.x, points.y, points.z
    nxs, nys, nzs, facings = points.nx, points.ny, points.nz, points.facing
    distances, ups = points.distance_m, points.up
    places_a, places_b, ways_a, ways_b = patches.a, patches.b, patches.way_a, patches.way_b
    acrosses, alongs, kinds = patches.across_m, patches.along_m, patches.material
    shift_a, shift_b = texture_shift
    for n in range(count):
        row = 2 * (pixels[first + n] // width) + 1
        px = np.float64(planes[first + n, 0])
        py = np.float64(planes[first + n, 1])
        length = np.sqrt(1.0 + px * px + py * py)
        shrink = 1.0 / length
        dx = shrink * (R[row, 0, 0] * px + R[row, 0, 1] * py + R[row, 0, 2])
        dy = shrink * (R[row, 1, 0] * px + R[row, 1, 1] * py + R[row, 1, 2])
        dz = shrink * (R[row, 2, 0] * px + R[row, 2, 1] * py + R[row, 2, 2])
        dxs[n], dys[n], dzs[n] = dx, dy, dz
        t = triangles[first + n]
        if t < 0:
            kinds[n] = -1
            continue
        distance = depths[first + n] * length
        x = origins[row, 0] + distance * dx
        y = origins[row, 1] + distance * dy
        z = origins[row, 2] + distance * dz
        nx = np.float64(normals[t, 0])
        ny = np.float64(normals[t, 1])
        nz = np.float64(normals[t, 2])
        facing = dx * nx + dy * ny + dz * nz
        if facing > 0.0:
            nx, ny, nz, facing = -nx, -ny, -nz, -facing
        xs[n], ys[n], zs[n] = x, y, z
        nxs[n], nys[n], nzs[n], facings[n] = nx, ny, nz, facing
        distances[n] = distance
        ups[n] = 0.5 * (1.0 + nz)

        across = distance * pixel_rad
        slant = 1.0 / np.sqrt(max(1.0 - facing * facing, 1e-12))
        ax = (dx - facing * nx) * slant
        ay = (dy - facing * ny) * slant
        az = (dz - facing * nz) * slant
        if t >= first_moving:  # texture clings to the axes of the mover
            m = movers[t - first_moving]
            x, y, z = (
                T[m, 0, 0] * x + T[m, 0, 1] * y + T[m, 0, 2] * z + T[m, 0, 3],
                T[m, 1, 0] * x + T[m, 1, 1] * y + T[m, 1, 2] * z + T[m, 1, 3],
                T[m, 2, 0] * x + T[m, 2, 1] * y + T[m, 2, 2] * z + T[m, 2, 3],
            )
            nx, ny, nz = (
                T[m, 0, 0] * nx + T[m, 0, 1] * ny + T[m, 0, 2] * nz,
                T[m, 1, 0] * nx + T[m, 1, 1] * ny + T[m, 1, 2] * nz,
                T[m, 2, 0] * nx + T[m, 2, 1] * ny + T[m, 2, 2] * nz,
            )
            ax, ay, az = (
                T[m, 0, 0] * ax + T[m, 0, 1] * ay + T[m, 0, 2] * az,
                T[m, 1, 0] * ax + T[m, 1, 1] * ay + T[m, 1, 2] * az,
                T[m, 2, 0] * ax + T[m, 2, 1] * ay + T[m, 2, 2] * az,
            )
        # Coordinates along the surface: level and up the slope, or east and north on level ground.
        if abs(nz) > 0.9:
            a, b, way_a, way_b = x, y, ax, ay
        else:
            level = 1.0 / np.sqrt(nx * nx + ny * ny)
            a = (-ny * x + nx * y) * level
            b = z * level
            way_a = (-ny * ax + nx * ay) * level
            way_b = az * level
        kinds[n] = materials[t]
        places_a[n] = a + shift_a
        places_b[n] = b + shift_b
        ways_a[n] = way_a
        ways_b[n] = way_b
        acrosses[n] = across
        alongs[n] = across / max(-facing, 0.02)


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up(
    openness: NDArray[np.float32],
    cell_m: float,
    origin: NDArray[np.float64],
    points: Points,
    count: int,
) -> None:
    """Scale ``up`` by the sky that a level surface sees; all of it 6 m above the ground."""
    rows, columns = openness.shape[:2]
    xs, ys, zs, ups = points.x, points.y, points.z, points.up
    x0, y0, per_m = origin[0], origin[1], 1.0 / cell_m
    if rows < 2:
        return
    for n in range(count):
        gx = (xs[n] - x0) * per_m
        gy = (ys[n] - y0) * per_m
        if not (0.0 <= gx < columns - 1 and 0.0 <= gy < rows - 1):
            continue
        j, i = int(gx), int(gy)
        u, v = gx - j, gy - i
        part = (1 - v) * ((1 - u) * openness[i, j, 0] + u * openness[i, j + 1, 0]) + v * (
            (1 - u) * openness[i + 1, j, 0] + u * openness[i + 1, j + 1, 0]
        )
        high = min(max((zs[n] - openness[i, j, 1]) / 6.0, 0.0), 1.0)
        ups[n] *= part + (1.0 - part) * high


@njit(cache=True, nogil=True, error_model="numpy")
def _look_at_sun(
    shadow: NDArray[np.float32],
    cell_m: float,
    origin: NDArray[np.float64],
    sun: NDArray[np.float64],
    points: Points,
    count: int,
) -> None:
    """Set ``towards_sun``, with shadows by variance shadow maps (Donnelly & Lauritzen 2006)."""
    rows, columns = shadow.shape[:2]
    xs, ys, zs, nxs, nys, nzs = points.x, points.y, points.z, points.nx, points.ny, points.nz
    lit = points.towards_sun
    x0, y0, per_m = origin[0], origin[1], 1.0 / cell_m
    sx, sy, sz = sun[0], sun[1], sun[2]
    shadows = rows > 1 and sz > 0.0
    for n in range(count):
        cosine = max(0.0, nxs[n] * sx + nys[n] * sy + nzs[n] * sz)
        lit[n] = cosine
        if cosine == 0.0 or not shadows:
            continue
        z = zs[n]
        gx = (xs[n] - z * sx / sz - x0) * per_m
        gy = (ys[n] - z * sy / sz - y0) * per_m
        if not (0.0 <= gx < columns - 1 and 0.0 <= gy < rows - 1):
            continue
        j, i = int(gx), int(gy)
        u, v = gx - j, gy - i
        mean = (1 - v) * ((1 - u) * shadow[i, j, 0] + u * shadow[i, j + 1, 0]) + v * (
            (1 - u) * shadow[i + 1, j, 0] + u * shadow[i + 1, j + 1, 0]
        )
        below = mean - _SHADOW_BIAS_M - z
        if below > 0.0:
            square = (1 - v) * ((1 - u) * shadow[i, j, 1] + u * shadow[i, j + 1, 1]) + v * (
                (1 - u) * shadow[i + 1, j, 1] + u * shadow[i + 1, j + 1, 1]
            )
            variance = max(square - mean * mean, 1e-3)
            lit[n] = cosine * variance / (variance + below * below)


@njit(cache=True, nogil=True, error_model="numpy")
def _radiate(
    samples: Samples,
    first: int,
    count: int,
    band: Band,
    heating: NDArray[np.float64],
    points: Points,
    materials: NDArray[np.int32],
    radiance: NDArray[np.float32],
) -> None:
    """What the samples send to the camera, added up."""
    pixels, offsets, weights = samples.pixel, samples.offset_kelvin, samples.weight
    dxs, dys, dzs = points.dx, points.dy, points.dz
    nxs, nys, nzs, facings = points.nx, points.ny, points.nz, points.facing
    ups, lit, variations, distances = (
        points.up, points.towards_sun, points.variation, points.distance_m,
    )  # fmt: skip
    thermal, table, lattice, planck_r = band.thermal, band.table, band.lattice, band.planck_r
    air, mean_sky, zenith, clouds = band.air, band.sky, band.sky_emissivity, band.cloud_variation
    extinction_per_m, illumination = band.extinction_per_m, band.illumination
    sunshine, ambient = band.sunshine, band.ambient
    share = 0.7 * sunshine
    flat = radiance.reshape(radiance.size)
    for n in range(count):
        m = materials[n]
        value = 0.0
        # The ray, or what a mirror makes of it, goes on to the sky.
        rx, ry, rz, seen = dxs[n], dys[n], dzs[n], 1.0
        if m >= 0:
            up = ups[n]
            towards_sun = lit[n] if sunshine > 0.0 else 0.0
            if thermal:
                kelvin = table[m, _BASE] + variations[n] + table[m, _SUN] * towards_sun
                kelvin += table[m, _OFFSET] * (offsets[first + n] + heating[m])
                kelvin += (table[m, _DAYLIGHT] - table[m, _SKY] * up) * up
                seen = 1.0 - table[m, _EMISSIVITY]
                value = (1.0 - seen) * planck(planck_r, kelvin)
                if table[m, _MIRROR] > 0.0:
                    double = 2.0 * facings[n]
                    rx -= double * nxs[n]
                    ry -= double * nys[n]
                    rz -= double * nzs[n]
                    if rz <= 0.0:
                        value += seen * air
                        seen = 0.0
                else:
                    value += seen * (up * mean_sky + (1.0 - up) * air)
                    seen = 0.0
            else:
                reflectance = min(max(table[m, _BASE] * (1.0 + variations[n]), 0.01), 0.95)
                diffuse = ambient + (1.0 - ambient) * up
                value = reflectance * ((1.0 - share) * diffuse + share * towards_sun)
                value *= illumination
                seen = 0.0
        if seen > 0.0:
            sine = max(rz, _LOWEST_SINE)
            if thermal:
                emissivity = _sky_emissivity(zenith, sine)
                if clouds > 0.0:
                    high = 2.5 / (sine + 0.1)
                    noise = _cloud_noise(lattice, high * rx, high * ry)
                    emissivity += clouds * noise * np.sqrt(1.0 - emissivity)
                value += seen * min(max(emissivity, 0.05), 1.0) * air
            else:
                value += seen * illumination * (0.9 - 0.35 * sine)
        if m >= 0 and thermal and extinction_per_m > 0.0:
            through = np.exp(-extinction_per_m * distances[n])
            value = through * value + (1.0 - through) * air
        flat[pixels[first + n]] += weights[first + n] * value
