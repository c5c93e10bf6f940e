from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.transforms import exp_so3, make_transform
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.noise import value_noise_reference
from thermal_stereo_vo.simulation.render import Lens, Renderer
from thermal_stereo_vo.simulation.scene import Heating, Scene
from thermal_stereo_vo.simulation.shading import (
    Band,
    Light,
    sky_radiance,
    thermal_band,
    visible_band,
)
from thermal_stereo_vo.simulation.thermal_field import Column, Responsivity
from thermal_stereo_vo.simulation.weather import find_weather

from .small_worlds import LOOK_NORTH

IDEAL = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
POSE = (
    make_transform(np.eye(3), [0.4, 0.2, 3.0])
    @ LOOK_NORTH
    @ make_transform(exp_so3([-0.25, 0.2, 0.1]), [0.0, 0.0, 0.0])
)
SLOPE = 0.15
"""Rise of the ground towards the north."""


def ground(material: Material) -> Scene:
    far = 60.0
    corners = [[x, y, SLOPE * y] for x, y in ((-far, -far), (far, -far), (far, far), (-far, far))]
    builder = MeshBuilder()
    builder.quads(np.array([corners]), material, offset_kelvin=1.5)
    return Scene(builder.build(), heating=(Heating(material, lambda time_s: 0.3 * time_s),))


def light_maps(rng) -> Light:
    """Smooth heights of what casts shadows, about the ground, and smooth shares of open sky."""
    y, x = np.mgrid[0:120, 0:120] * 1.0 - 60.0
    height = SLOPE * y + 1.5 * np.sin(x / 5.0) * np.cos(y / 7.0)
    shadow = np.stack([height, height**2 + 0.2], axis=-1).astype(np.float32)
    share = 0.6 + 0.3 * np.sin(x / 9.0 + y / 11.0)
    openness = np.stack([share, SLOPE * y - 0.4], axis=-1).astype(np.float32)
    return Light(shadow, 1.0, openness, 1.0, np.array([-60.0, -60.0]))


def smooth(band: Band) -> Band:
    """Without texture."""
    table = band.table.copy()
    for column in ("OCTAVES", "CRACKS", "PATCHES", "CELL_ALONG"):
        table[:, Column[column]] = 0.0
    return band._replace(table=table)


def sky(band: Band, rays: np.ndarray) -> np.ndarray:
    """The sky in plain numpy: (N,) of unit directions (N, 3)."""
    sine = np.maximum(rays[:, 2], 0.03)
    if not band.thermal:
        return band.illumination * (0.9 - 0.35 * sine)
    emissivity = 1.0 - (1.0 - band.sky_emissivity) ** (1.0 / sine)
    x = 2.5 * rays[:, :2] / (sine[:, None] + 0.1)
    noise = np.zeros(len(rays))
    for octave in range(4):
        noise += 0.55**octave * value_noise_reference(band.lattice, x)
        x = x @ np.array([[1.6, 1.2], [-1.2, 1.6]]) + [9.1, 4.3]
    emissivity += band.cloud_variation * noise * np.sqrt(1.0 - emissivity)
    return np.clip(emissivity, 0.05, 1.0) * band.air


def reference(band: Band, light: Light, material: Material, rays, points, time_s) -> np.ndarray:
    """Radiance of points (N, 3) of the ground seen along rays (N, 3), in plain numpy."""
    row = band.table[material]
    normal = np.array([0.0, -SLOPE, 1.0]) / np.hypot(1.0, SLOPE)
    x, y, z = points.T

    def looked_up(grid, x, y, order=1):
        at = [y - light.origin[1], x - light.origin[0]]
        if order == 0:
            at = np.floor(at)
        return map_coordinates(grid.astype(float), at, order=order)

    share = looked_up(light.openness[..., 0], x, y)
    high = np.clip((z - looked_up(light.openness[..., 1], x, y, 0)) / 6.0, 0.0, 1.0)
    up = 0.5 * (1.0 + normal[2]) * (share + (1.0 - share) * high)
    sun = band.sun
    at = x - z * sun[0] / sun[2], y - z * sun[1] / sun[2]
    mean, square = (looked_up(light.shadow[..., k], *at) for k in (0, 1))
    below = mean - 0.12 - z
    variance = np.maximum(square - mean**2, 1e-3)
    lit = normal @ sun * np.where(below > 0.0, variance / (variance + below**2), 1.0)
    if not band.thermal:
        share = 0.7 * band.sunshine
        around = band.ambient + (1.0 - band.ambient) * up
        return band.illumination * row[Column.BASE] * ((1.0 - share) * around + share * lit)
    kelvin = row[Column.BASE] + row[Column.OFFSET] * (1.5 + 0.3 * time_s)
    kelvin = kelvin + (row[Column.SUN] * lit if band.sunshine > 0.0 else 0.0)
    kelvin = kelvin + row[Column.DAYLIGHT] * up - row[Column.SKY] * up**2
    emissivity = row[Column.EMISSIVITY]
    mirrored = rays - 2.0 * (rays @ normal)[:, None] * normal
    seen = np.where(mirrored[:, 2] > 0.0, sky(band, mirrored), band.air)
    if not row[Column.MIRROR]:
        seen = up * band.sky + (1.0 - up) * band.air
    value = emissivity * Responsivity(30.0).counts(kelvin) + (1.0 - emissivity) * seen
    distance = np.linalg.norm(points - POSE[:3, 3], axis=1)
    through = np.exp(-band.extinction_per_m * distance)
    return through * value + (1.0 - through) * band.air


@pytest.mark.parametrize("material", [Material.ASPHALT, Material.CAR_GLASS])
@pytest.mark.parametrize(
    ("weather", "thermal"),
    [("sunny_day", True), ("foggy_day", True), ("clear_cold_night", True), ("sunny_day", False)],
)
def test_the_kernels_agree_with_plain_numpy(lattice, rng, material, weather, thermal) -> None:
    conditions = find_weather(weather)
    if thermal:
        band = smooth(thermal_band(conditions, Responsivity(30.0), lattice))
    else:
        band = smooth(visible_band(conditions, lattice))
    light, time_s = light_maps(rng), 2.0
    seen = Renderer(ground(material), light).render(Lens(IDEAL), band, lambda _: POSE, time_s)
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    rays = IDEAL.unproject(np.column_stack([x.ravel(), y.ravel()]))
    depth = seen.depth_m.ravel()
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ POSE[:3, :3].T
    near = depth < 40.0
    assert near.sum() > 1500
    points = (rays[near] * depth[near, None]) @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(points[:, 2], SLOPE * points[:, 1], atol=0.01)
    expected = reference(band, light, material, directions[near], points, time_s)
    found = seen.radiance.ravel()[near]
    # Openness takes the ground of the nearest cell: points at its border may fall on either side.
    wrong = np.abs(found - expected) > 2e-4 * np.abs(expected)
    assert wrong.mean() < 0.005
    above = directions[:, 2] > SLOPE + 0.05
    assert np.all(np.isinf(depth[above]))
    assert above.sum() > 100
    np.testing.assert_allclose(
        seen.radiance.ravel()[above], sky(band, directions[above]), rtol=1e-5
    )
    assert sky_radiance(band, *directions[above][0], True) == pytest.approx(
        sky(band, directions[above][:1])[0], rel=1e-6
    )
