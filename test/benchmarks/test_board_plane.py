"""Planes through dense points, and a board of a simulated rig seen densely."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.benchmarks.board_plane import BoardPlane, fitted_plane, plane_report
from thermal_stereo_vo.benchmarks.true_surface import TrueSurface, triangle_distance
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder


@pytest.mark.parametrize("outliers", [0, 40])
def test_a_plane_is_found_through_noise_and_outliers(outliers):
    rng = np.random.default_rng(3)
    normal = np.array([0.1, -0.2, 0.97])
    normal /= np.linalg.norm(normal)
    xy = rng.uniform(-0.3, 0.3, (800, 2))
    z = (1.5 - xy @ normal[:2]) / normal[2]
    points = np.column_stack([xy, z]) + normal * rng.normal(0.0, 0.004, (800, 1))
    points[:outliers, 2] += 0.4
    found, offset = fitted_plane(points)
    assert abs(found @ normal) > 0.99995
    assert offset == pytest.approx(1.5, abs=0.001)


def test_the_report_has_a_row_for_each_pair():
    plane = BoardPlane("000000029", 1234, 0.5, 1.512, 1.51, 0.0042, 0.013, 0.31)
    lines = plane_report([plane, plane]).splitlines()
    assert len(lines) == 4
    for text in ("000000029", "1234", "50", "1.5120", "1.5100", "4.20", "1.3", "0.31"):
        assert text in lines[2]


def test_distances_to_triangles_by_hand():
    triangle = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 2, 0]]])
    cases = {
        (0.5, 0.5, 0.7): 0.7,  # above the inside
        (0.5, 0.5, -0.7): 0.7,
        (1.0, -3.0, 4.0): 5.0,  # beside an edge
        (-3.0, -4.0, 0.0): 5.0,  # before a corner
        (2.0, 2.0, 0.0): np.sqrt(2.0),  # beside the long edge
    }
    points = np.array(list(cases))
    found = triangle_distance(points, np.repeat(triangle, len(points), axis=0))
    np.testing.assert_allclose(found, list(cases.values()), atol=1e-12)


def test_the_nearest_surface_is_found_on_large_and_small_triangles():
    builder = MeshBuilder()
    ground = [[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]]
    builder.quads(np.array([ground]), Material.ASPHALT)
    builder.box([2, 2, 0], [3, 3, 2], Material.BRICK)
    surface = TrueSurface(builder.build(), np.zeros((1, 3)), 10.0, np.random.default_rng(0))
    points = np.array([[0.0, 0, 0.3], [1.9, 2.5, 1.0], [-8.0, -8.0, -0.2], [2.5, 2.5, 2.4]])
    distance, material = surface.nearest(points)
    np.testing.assert_allclose(distance, [0.3, 0.1, 0.2, 0.4], atol=1e-6)
    expected = [Material.ASPHALT, Material.BRICK, Material.ASPHALT, Material.BRICK]
    np.testing.assert_array_equal(material, expected)
