from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.simulation import objects
from thermal_stereo_vo.simulation.materials import SUBSTANCES, Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder


def normals_of(vertices: np.ndarray) -> np.ndarray:
    return np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])


def test_a_box_looks_outwards_and_has_its_size() -> None:
    builder = MeshBuilder()
    builder.box([-1, -2, -3], [1, 2, 3], Material.BRICK, offset_kelvin=[0, 1, 2, 3, 4, 5])
    mesh = builder.build()
    assert len(mesh) == 12
    assert mesh.surfaces == 6
    normals = normals_of(mesh.vertices)
    assert np.all(np.sum(normals * mesh.vertices.mean(axis=1), axis=1) > 0)
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(2 * (8 + 12 + 24))
    up = normals[:, 2] > 1
    assert np.all(mesh.offset_kelvin[up] == 5)


def test_a_closed_car_looks_outwards() -> None:
    """The volume enclosed by outward faces is positive; a face turned inside would take away."""
    builder = MeshBuilder()
    objects.car(builder, objects.placed(3.0, 4.0, 0.0, 0.7), np.random.default_rng(1))
    vertices = builder.build().vertices.astype(float) - [3.0, 4.0, 0.0]
    volume = np.sum(vertices[:, 0] * np.cross(vertices[:, 1], vertices[:, 2])) / 6.0
    assert 4.0 < volume < 9.0


def test_a_tube_is_one_smooth_surface_and_is_announced_as_slender() -> None:
    builder = MeshBuilder()
    builder.cylinder([0, 0, 0], [0, 0, 5], 0.05, Material.POLE)
    builder.cylinder([9, 0, 0], [9, 0, 5], 0.5, Material.POLE)
    mesh = builder.build()
    assert mesh.surfaces == 2
    assert len(mesh.thin) == 1
    np.testing.assert_allclose(mesh.thin[0], [0, 0, 0, 0, 0, 5, 0.1], atol=1e-6)


def test_a_narrow_quad_is_announced_along_its_length() -> None:
    builder = MeshBuilder()
    builder.quads([[0, 0, 0], [4, 0, 0], [4, 0.1, 0], [0, 0.1, 0]], Material.MARKING)
    thin = builder.build().thin
    assert len(thin) == 1
    assert thin[0, 6] == pytest.approx(0.1)
    assert abs(thin[0, 3] - thin[0, 0]) == pytest.approx(4.0)


def test_surfaces_stay_apart_whatever_they_are_made_of() -> None:
    builder = MeshBuilder()
    for shift in (0.0, 5.0):
        builder.quads(np.array([[0, 0, shift], [1, 0, shift], [1, 1, shift], [0, 1, shift]]),
                      Material.GRASS)  # fmt: skip
        builder.triangles([[[0, 0, shift], [1, 0, 0], [0, 1, 0]]] * 2, Material.FOLIAGE,
                          one_surface=False)  # fmt: skip
    mesh = builder.build()
    assert mesh.surfaces == 6
    assert len(np.unique(mesh.surface)) == 6


def test_an_empty_builder_gives_an_empty_mesh() -> None:
    mesh = MeshBuilder().build()
    assert len(mesh) == 0
    assert mesh.surfaces == 0


def test_every_material_has_a_substance_with_sane_figures() -> None:
    assert set(SUBSTANCES) == set(Material)
    for substance in SUBSTANCES.values():
        assert 0.0 < substance.emissivity <= 1.0
        assert 0.0 <= substance.albedo <= 1.0
