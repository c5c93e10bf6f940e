"""Radiance of a point that a ray hit: texture, temperature, reflection, air; and of the sky.

Kernels in numba, called for one point each.  Every octave finer than the pixel is faded out, so
that nothing aliases into noise that moves with the camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.noise import (
    LATTICE,
    NOISE_SIGMA,
    NOISE_SLOPE,
    OCTAVE_COS,
    OCTAVE_SIN,
    value_noise,
)
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
_MIRROR, _AMPLITUDE, _SPACING = int(Column.MIRROR), int(Column.AMPLITUDE), int(Column.SPACING)
_OCTAVES, _PERSISTENCE = int(Column.OCTAVES), int(Column.PERSISTENCE)
_CRACKS, _PATCHES = int(Column.CRACKS), int(Column.PATCHES)
_CELL_ALONG, _CELL_UP = int(Column.CELL_ALONG), int(Column.CELL_UP)
_CELLS, _JOINTS = int(Column.CELLS), int(Column.JOINTS)

_LINE_HALF_WIDTH_M = 0.015
_CRACKS_SEEN_M = 20 * _LINE_HALF_WIDTH_M
_CELLS_IN_LATTICE = LATTICE**2
_SHADOW_BIAS_M = 0.12


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
def texture(
    lattice: NDArray[np.float32],
    row: NDArray[np.float64],
    a: float,
    b: float,
    way_a: float,
    way_b: float,
    across_m: float,
    along_m: float,
) -> float:
    """Variation of a material at a point of a surface, in the unit of its amplitudes.

    (a, b) are metres along the surface.  The pixel covers ``along_m`` in the unit direction
    (way_a, way_b) and ``across_m`` in the other.  ``row`` is that of the material table.
    """
    value = 0.0
    spacing = row[_SPACING]
    pa = a / spacing
    pb = b / spacing
    if row[_CRACKS] != 0.0 and across_m < _CRACKS_SEEN_M:
        n = value_noise(lattice, pa + 7.7, pb + 40.9)
        width = max(_LINE_HALF_WIDTH_M, across_m)
        distance = abs(n) * spacing / NOISE_SLOPE
        if distance < width:
            value += row[_CRACKS] * _LINE_HALF_WIDTH_M / width * (1.0 - distance / width)
    if row[_PATCHES] != 0.0:
        n = value_noise(lattice, 0.4 * pa + 29.3, 0.4 * pb + 11.9)
        step = 0.5 + n * 2.5 * spacing / NOISE_SLOPE / max(2.0 * _LINE_HALF_WIDTH_M, across_m)
        value += row[_PATCHES] * (min(max(step, 0.0), 1.0) - 0.5)
    if row[_CELL_ALONG] > 0.0:
        value += _tiles(lattice, row, a, b, across_m)

    amplitude = row[_AMPLITUDE] / NOISE_SIGMA
    da = way_a * along_m / spacing
    db = way_b * along_m / spacing
    for _ in range(int(row[_OCTAVES])):
        samples = 1
        if along_m > 0.5 * spacing:
            samples = min(4, int(2.0 * along_m / spacing) + 1)
        footprint = max(across_m, along_m / samples)
        weight = min(max(spacing / footprint - 1.0, 0.0), 1.0)
        if weight <= 0.0:
            break
        weight = weight * weight * (3.0 - 2.0 * weight)
        if samples == 1:
            total = value_noise(lattice, pa, pb)
        else:
            total = 0.0
            for i in range(samples):
                f = (i + 0.5) / samples - 0.5
                total += value_noise(lattice, pa + f * da, pb + f * db)
            total /= samples
        value += weight * amplitude * total
        amplitude *= row[_PERSISTENCE]
        spacing *= 0.5
        pa, pb = (
            2.0 * (OCTAVE_COS * pa - OCTAVE_SIN * pb) + 17.31,
            2.0 * (OCTAVE_SIN * pa + OCTAVE_COS * pb) + 5.77,
        )
        da, db = (
            2.0 * (OCTAVE_COS * da - OCTAVE_SIN * db),
            2.0 * (OCTAVE_SIN * da + OCTAVE_COS * db),
        )
    return float(value)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _tiles(
    lattice: NDArray[np.float32], row: NDArray[np.float64], a: float, b: float, footprint_m: float
) -> float:
    """Tiles that differ from each other, and the joints between them."""
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
    return float(value)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def planck(planck_r: float, kelvin: float) -> float:
    """Counts of a black body."""
    return float(planck_r / (np.exp(PLANCK_B_KELVIN / kelvin) - PLANCK_F))


@njit(cache=True, nogil=True, error_model="numpy")
def sky_radiance(band: Band, dx: float, dy: float, dz: float, clouds: bool) -> float:
    """Radiance of the sky in a unit direction, in the unit of the band."""
    sine = max(dz, 0.03)
    if not band.thermal:
        return float(band.illumination * (0.9 - 0.35 * min(sine, 1.0)))
    # Plane-parallel air: the path, and so its optical depth, grows as 1 / sin(elevation).
    emissivity = 1.0 - (1.0 - min(band.sky_emissivity, 0.999)) ** (1.0 / sine)
    if clouds and band.cloud_variation > 0.0:
        x = 2.5 * dx / (sine + 0.1)
        y = 2.5 * dy / (sine + 0.1)
        n = 0.0
        amplitude = 1.0
        for _ in range(4):
            n += amplitude * value_noise(band.lattice, x, y)
            x, y = 1.6 * x - 1.2 * y + 9.1, 1.2 * x + 1.6 * y + 4.3
            amplitude *= 0.55
        emissivity += band.cloud_variation * n * (1.0 - emissivity) ** 0.5
    return float(min(max(emissivity, 0.05), 1.0) * band.air)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sunlit(light: Light, sun: NDArray[np.float64], x: float, y: float, z: float) -> float:
    """Part of the sun seen from a point, 0..1: variance shadow map (Donnelly & Lauritzen 2006)."""
    rows, columns = light.shadow.shape[:2]
    if rows < 2 or sun[2] <= 0.0:
        return 1.0
    gx = (x - z * sun[0] / sun[2] - light.origin[0]) / light.shadow_cell_m
    gy = (y - z * sun[1] / sun[2] - light.origin[1]) / light.shadow_cell_m
    if gx < 0.0 or gy < 0.0 or gx >= columns - 1 or gy >= rows - 1:
        return 1.0
    j, i = int(gx), int(gy)
    u, v = gx - j, gy - i
    s = light.shadow
    mean = (1 - v) * ((1 - u) * s[i, j, 0] + u * s[i, j + 1, 0]) + v * (
        (1 - u) * s[i + 1, j, 0] + u * s[i + 1, j + 1, 0]
    )
    below = mean - _SHADOW_BIAS_M - z
    if below <= 0.0:
        return 1.0
    square = (1 - v) * ((1 - u) * s[i, j, 1] + u * s[i, j + 1, 1]) + v * (
        (1 - u) * s[i + 1, j, 1] + u * s[i + 1, j + 1, 1]
    )
    variance = max(square - mean * mean, 1e-3)
    return float(variance / (variance + below * below))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _open_sky(light: Light, x: float, y: float, z: float) -> float:
    """Part of the sky seen by a level surface at a point, 0..1; full 6 m above the ground."""
    rows, columns = light.openness.shape[:2]
    if rows < 2:
        return 1.0
    gx = (x - light.origin[0]) / light.openness_cell_m
    gy = (y - light.origin[1]) / light.openness_cell_m
    if gx < 0.0 or gy < 0.0 or gx >= columns - 1 or gy >= rows - 1:
        return 1.0
    j, i = int(gx), int(gy)
    u, v = gx - j, gy - i
    s = light.openness
    part = (1 - v) * ((1 - u) * s[i, j, 0] + u * s[i, j + 1, 0]) + v * (
        (1 - u) * s[i + 1, j, 0] + u * s[i + 1, j + 1, 0]
    )
    high = min(max((z - s[i, j, 1]) / 6.0, 0.0), 1.0)
    return float(part + (1.0 - part) * high)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def shade(
    band: Band,
    light: Light,
    material: int,
    offset_kelvin: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    T_object_map: NDArray[np.float64],
    mover: int,
    moved: bool,
    dx: float,
    dy: float,
    dz: float,
    distance_m: float,
    pixel_rad: float,
) -> float:
    """Radiance that reaches the camera from a point (x, y, z) with unit normal, in map axes.

    (dx, dy, dz) is the unit direction of the ray.  Where ``moved`` is true, the texture clings to
    the axes of a mover: ``T_object_map[mover]`` takes map coordinates there.
    """
    facing = dx * nx + dy * ny + dz * nz
    if facing > 0.0:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    across = distance_m * pixel_rad
    along = across / max(-facing, 0.02)
    slant = np.sqrt(max(1.0 - facing * facing, 1e-12))
    ax = (dx - facing * nx) / slant
    ay = (dy - facing * ny) / slant
    az = (dz - facing * nz) / slant
    row = band.table[material]
    rest = T_object_map[mover]
    tx, ty, tz, mx, my, mz = x, y, z, nx, ny, nz
    if moved:
        tx = rest[0, 0] * x + rest[0, 1] * y + rest[0, 2] * z + rest[0, 3]
        ty = rest[1, 0] * x + rest[1, 1] * y + rest[1, 2] * z + rest[1, 3]
        tz = rest[2, 0] * x + rest[2, 1] * y + rest[2, 2] * z + rest[2, 3]
        mx = rest[0, 0] * nx + rest[0, 1] * ny + rest[0, 2] * nz
        my = rest[1, 0] * nx + rest[1, 1] * ny + rest[1, 2] * nz
        mz = rest[2, 0] * nx + rest[2, 1] * ny + rest[2, 2] * nz
        bx = rest[0, 0] * ax + rest[0, 1] * ay + rest[0, 2] * az
        by = rest[1, 0] * ax + rest[1, 1] * ay + rest[1, 2] * az
        bz = rest[2, 0] * ax + rest[2, 1] * ay + rest[2, 2] * az
        ax, ay, az = bx, by, bz
    towards_sun = 0.0
    if band.sunshine > 0.0:
        towards_sun = max(0.0, nx * band.sun[0] + ny * band.sun[1] + nz * band.sun[2])
        if towards_sun > 0.0:
            towards_sun *= _sunlit(light, band.sun, x, y, z)
    # Coordinates along the surface: level and up the slope, or east and north on level ground.
    if abs(mz) > 0.9:
        a, b, way_a, way_b = tx, ty, ax, ay
    else:
        level = np.sqrt(mx * mx + my * my)
        a = (-my * tx + mx * ty) / level
        b = tz / level
        way_a = (-my * ax + mx * ay) / level
        way_b = az / level
    up = 0.5 * (1.0 + nz)
    up *= _open_sky(light, x, y, z)

    if not band.thermal:  # another part of the lattice: the bands share no texture
        a += 613.7
        b += 271.3
    variation = texture(band.lattice, row, a, b, way_a, way_b, across, along)

    if not band.thermal:
        reflectance = min(max(row[_BASE] * (1.0 + variation), 0.01), 0.95)
        share = 0.7 * band.sunshine
        diffuse = band.ambient + (1.0 - band.ambient) * up
        light_here = (1.0 - share) * diffuse + share * towards_sun
        return float(band.illumination * reflectance * light_here)

    kelvin = row[_BASE] + row[_OFFSET] * offset_kelvin + variation
    kelvin += row[_SUN] * towards_sun + row[_DAYLIGHT] * up - row[_SKY] * up * up
    emissivity = row[_EMISSIVITY]
    radiance = emissivity * planck(band.planck_r, kelvin)
    if emissivity < 1.0:
        if row[_MIRROR] > 0.0:
            rx = dx - 2.0 * facing * nx
            ry = dy - 2.0 * facing * ny
            rz = dz - 2.0 * facing * nz
            reflected = sky_radiance(band, rx, ry, rz, True) if rz > 0.0 else band.air
        else:
            reflected = up * band.sky + (1.0 - up) * band.air
        radiance += (1.0 - emissivity) * reflected
    if band.extinction_per_m > 0.0:
        through = np.exp(-band.extinction_per_m * distance_m)
        radiance = through * radiance + (1.0 - through) * band.air
    return float(radiance)
