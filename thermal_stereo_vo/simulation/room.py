"""An office: the scene of the hand-held visible + thermal paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation import objects
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.objects import placed
from thermal_stereo_vo.simulation.scene import Scene

Floats = NDArray[np.float64]

_LENGTH_M, _WIDTH_M, _HEIGHT_M = 8.0, 6.4, 2.9


def build_room(seed: int, air_kelvin: float, *, person: bool) -> Scene:
    """A room about the origin; the rig looks along +x.  ``person`` seats somebody at the desk."""
    rng = np.random.default_rng([seed, 6])
    b = MeshBuilder()
    depth, w, h = _LENGTH_M / 2, _WIDTH_M / 2, _HEIGHT_M
    for corners, material, kelvin in (
        ([[depth, w, 0], [depth, -w, 0], [depth, -w, h], [depth, w, h]], Material.WALL, 0.0),
        ([[-depth, -w, 0], [-depth, w, 0], [-depth, w, h], [-depth, -w, h]], Material.WALL, 0.3),
        ([[-depth, w, 0], [depth, w, 0], [depth, w, h], [-depth, w, h]], Material.WALL, -1.2),
        ([[depth, -w, 0], [-depth, -w, 0], [-depth, -w, h], [depth, -w, h]], Material.WALL, 0.2),
        ([[-depth, -w, 0], [depth, -w, 0], [depth, w, 0], [-depth, w, 0]], Material.FLOOR, 0.0),
        ([[-depth, w, h], [depth, w, h], [depth, -w, h], [-depth, -w, h]], Material.WALL, 1.0),
    ):
        b.quads(np.array(corners, float), material, offset_kelvin=kelvin)
    _far_wall(b, depth, w, rng)
    _windows(b, depth, w, rng)
    _shelf(b, depth, w, rng)
    _desk(b, placed(depth - 1.3, 0.4, 0.0), rng)
    _desk(b, placed(depth - 1.2, -1.9, 0.0), rng)
    for x in (-1.5, 1.5):
        for y in (-1.5, 1.5):  # lamps
            b.box([x - 0.6, y - 0.15, h - 0.06], [x + 0.6, y + 0.15, h - 0.01], Material.LAMP,
                  offset_kelvin=9.0)  # fmt: skip
    plant = placed(depth - 0.6, w - 0.6, 0.0)
    b.cylinder(plant[:3, 3], plant[:3, 3] + np.array([0, 0, 0.4]), 0.18, Material.PLASTIC)
    leaves = plant[:3, 3] + np.array([0, 0, 0.95]) + rng.normal(0.0, 0.22, (220, 3))
    objects.leaf_cards(b, leaves, rng.uniform(0.03, 0.08, 220), rng.normal(-1.0, 0.5, 220),
                       Material.FOLIAGE, rng)  # fmt: skip
    if person:
        objects.person(b, placed(depth - 2.1, 0.2, -0.45, 0.3), rng, air_kelvin)
    return Scene(b.build())


def _at(T: Floats, points: Floats) -> Floats:
    return points @ T[:3, :3].T + T[:3, 3]


def _far_wall(b: MeshBuilder, depth: float, w: float, rng: np.random.Generator) -> None:
    x = depth - 0.012
    for _ in range(9):
        y, z = rng.uniform(-w + 0.5, w - 0.5), rng.uniform(1.2, 2.4)
        a, c = rng.uniform(0.15, 0.45), rng.uniform(0.15, 0.4)
        sheet = [[x, y + a, z - c], [x, y - a, z - c], [x, y - a, z + c], [x, y + a, z + c]]
        b.quads(np.array(sheet), Material.POSTER, offset_kelvin=rng.normal(0.0, 0.25))  # fmt: skip
    b.box(
        [depth - 0.07, -w + 0.3, 0.35], [depth, -w + 0.42, 2.2], Material.PLASTIC, offset_kelvin=4.0
    )
    for z in (0.3, 0.42):  # heating pipes, and sockets
        b.cylinder([depth - 0.05, -w, z], [depth - 0.05, w, z], 0.012, Material.HOT_METAL,
                   offset_kelvin=11.0)  # fmt: skip
    for y in np.arange(-w + 0.6, w, 0.9):
        b.box([depth - 0.02, y, 0.9], [depth, y + 0.1, 1.0], Material.PLASTIC,
              offset_kelvin=rng.uniform(0.0, 2.5))  # fmt: skip


def _windows(b: MeshBuilder, depth: float, w: float, rng: np.random.Generator) -> None:
    y = w - 0.02
    for x in (-2.4, -0.4, 1.6):
        for material, grow, out, kelvin in (
            (Material.FRAME, 0.08, 0.0, -3.0),
            (Material.GLASS, 0.0, 0.02, -6.0),
        ):
            x0, x1, z0, z1 = x - grow, x + 1.4 + grow, 0.9 - grow, 2.3 + grow
            b.quads(np.array([[x0, y - out, z0], [x1, y - out, z0], [x1, y - out, z1],
                              [x0, y - out, z1]]), material, offset_kelvin=kelvin)  # fmt: skip
        for k in range(14):  # radiator below
            b.box([x + 0.1 * k, y - 0.12, 0.15], [x + 0.1 * k + 0.07, y - 0.03, 0.75],
                  Material.HOT_METAL, offset_kelvin=18.0 + rng.normal(0.0, 1.0))  # fmt: skip


def _shelf(b: MeshBuilder, depth: float, w: float, rng: np.random.Generator) -> None:
    T = placed(depth - 0.25, -w + 1.3, 0.0)
    for z in (0.02, 0.45, 0.9, 1.35, 1.8):
        b.box([-0.2, -0.6, z], [0.2, 0.6, z + 0.03], Material.WOOD, T_map_object=T)
        y = -0.58
        while y < 0.5:
            thick, tall = rng.uniform(0.02, 0.09), rng.uniform(0.18, 0.34)
            b.box([-0.2, y, z + 0.03], [0.1, y + thick, z + 0.03 + tall], Material.POSTER,
                  T_map_object=T, offset_kelvin=rng.normal(0.0, 0.4))  # fmt: skip
            y += thick + 0.004
    for y in (-0.62, 0.6):
        b.box([-0.2, y, 0.0], [0.2, y + 0.03, 1.85], Material.WOOD, T_map_object=T)


def _desk(b: MeshBuilder, T: Floats, rng: np.random.Generator) -> None:
    b.box([-0.45, -0.85, 0.70], [0.45, 0.85, 0.74], Material.WOOD, T_map_object=T)
    for x in (-0.4, 0.36):
        for y in (-0.8, 0.76):
            b.box([x, y, 0.0], [x + 0.05, y + 0.05, 0.7], Material.WOOD, T_map_object=T)
    for y in (-0.4, 0.25):  # screens that face -x
        b.box([0.1, y - 0.3, 0.85], [0.14, y + 0.3, 1.22], Material.PLASTIC, T_map_object=T,
              offset_kelvin=4.0)  # fmt: skip
        pane = np.array([[0.095, y + 0.28, 0.88], [0.095, y - 0.28, 0.88],
                         [0.095, y - 0.28, 1.2], [0.095, y + 0.28, 1.2]])  # fmt: skip
        b.quads(_at(T, pane), Material.SCREEN,
                offset_kelvin=np.array([[2.0, -1.0, 1.0, 3.0]]))  # fmt: skip
        b.box([0.08, y - 0.04, 0.74], [0.13, y + 0.04, 0.86], Material.PLASTIC, T_map_object=T)
    for k in range(4):  # keys in rows, a mouse, cups
        b.box([-0.2 + 0.04 * k, -0.6, 0.74], [-0.17 + 0.04 * k, -0.15, 0.757], Material.PLASTIC,
              T_map_object=T, offset_kelvin=1.0)  # fmt: skip
    cup = _at(T, np.array([[-0.1, 0.55, 0.74], [-0.1, 0.55, 0.84]]))
    b.cylinder(cup[0], cup[1], 0.04, Material.PLASTIC, sides=12,
               offset_kelvin=float(rng.choice([0.0, 20.0])))  # fmt: skip
    b.box([-0.3, 0.6, 0.0], [0.15, 0.8, 0.45], Material.PLASTIC, T_map_object=T,
          offset_kelvin=[6.0, 1.5, 2.0, 2.0, 0.0, 4.0])  # fmt: skip
