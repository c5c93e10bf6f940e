"""The things that stand in a street: houses, trees, cars, lamps, people.

Every function adds one thing to a MeshBuilder, standing at the origin of ``T`` (map from object),
z up, x forward.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder

Floats = NDArray[np.float64]


def placed(x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0) -> Floats:
    """(4, 4) pose of something that stands upright."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [[c, -s, 0.0, x_m], [s, c, 0.0, y_m], [0.0, 0.0, 1.0, z_m], [0.0, 0.0, 0.0, 1.0]]
    )


def _at(T: Floats, points: Floats) -> Floats:
    return points @ T[:3, :3].T + T[:3, 3]


def house(
    b: MeshBuilder,
    T: Floats,
    width_m: float,
    depth_m: float,
    storeys: int,
    wall: Material,
    gable: bool,
    rng: np.random.Generator,
) -> None:
    """A house whose front is its -y side; (0, 0) is the middle of its footprint."""
    storey_m = 2.9
    height = 0.3 + storeys * storey_m
    w, d = width_m / 2, depth_m / 2
    warmth = rng.normal(0.0, 1.2)
    b.box([-w, -d, -1.0], [w, d, height], wall, T_map_object=T,
          offset_kelvin=warmth + rng.normal(0.0, 0.6, 6))  # fmt: skip
    # Plinth, a little warmer than the wall.
    b.box([-w - 0.04, -d - 0.04, -1.0], [w + 0.04, d + 0.04, 0.35], Material.CONCRETE,
          T_map_object=T, offset_kelvin=1.2)  # fmt: skip
    _roof(b, T, w, d, height, gable, rng)
    sides = [(-d, 0.0, w), (d, np.pi, w), (-w, -np.pi / 2, d), (w, np.pi / 2, d)]
    for number, (_, turn, half) in enumerate(sides):
        out = d if number < 2 else w
        S = T @ placed(0, 0, 0, turn)
        for storey in range(storeys):
            _storey(b, S, half, out, 0.3 + storey * storey_m, number == 0 and storey == 0, rng)
    for x in (-w + 0.15, w - 0.15):
        b.cylinder(_at(T, np.array([x, -d - 0.08, 0.0])), _at(T, np.array([x, -d - 0.08, height])),
                   0.05, Material.POLE, sides=6, offset_kelvin=-1.0)  # fmt: skip


def _roof(
    b: MeshBuilder, T: Floats, w: float, d: float, height: float, gable: bool,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    if not gable:
        b.box([-w - 0.1, -d - 0.1, height], [w + 0.1, d + 0.1, height + 0.45], Material.CONCRETE,
              T_map_object=T, top_material=Material.METAL_ROOF)  # fmt: skip
        for _ in range(int(rng.integers(1, 4))):
            x, y = rng.uniform(-w + 1, w - 1), rng.uniform(-d + 1, d - 1)
            b.box([x, y, height + 0.4], [x + 0.9, y + 0.7, height + 1.3], Material.POLE,
                  T_map_object=T, offset_kelvin=rng.uniform(0.0, 8.0))  # fmt: skip
        return
    rise, over = 0.54 * d, 0.45
    ridge = height + rise
    eaves = height - over * rise / d
    x0, x1 = -w - over, w + over
    slopes = np.array(
        [
            [[x0, -d - over, eaves], [x1, -d - over, eaves], [x1, 0, ridge], [x0, 0, ridge]],
            [[x1, d + over, eaves], [x0, d + over, eaves], [x0, 0, ridge], [x1, 0, ridge]],
        ]
    )
    b.quads(_at(T, slopes), Material.ROOF_TILE, offset_kelvin=rng.normal(0.0, 1.0, (2, 1)))
    b.quads(_at(T, slopes[:, ::-1] - [0, 0, 0.12]), Material.FRAME, offset_kelvin=1.5)
    ends = np.array(
        [
            [[-w, d, height], [-w, -d, height], [-w, 0, ridge - 0.1]],
            [[w, -d, height], [w, d, height], [w, 0, ridge - 0.1]],
        ]
    )
    b.triangles(_at(T, ends), Material.PLASTER, one_surface=False)
    x = rng.uniform(-0.6, 0.6) * w
    warm = rng.uniform(2.0, 14.0)
    b.box([x, -0.4, ridge - 1.0], [x + 0.8, 0.4, ridge + 1.1], Material.BRICK, T_map_object=T,
          offset_kelvin=[warm, warm, warm, warm, warm, warm + 6.0])  # fmt: skip
    for side in (-1, 1):
        if rng.random() < 0.6:
            xs = rng.uniform(-0.7, 0.4) * w
            f = np.array([[0.35, 0.0], [0.35, 1.0], [0.6, 1.0], [0.6, 0.0]])
            out = side * (d + over) * (1 - f[:, 0])
            up = eaves + (ridge - eaves) * f[:, 0] + 0.06
            window = np.column_stack([xs + f[:, 1] * 0.9, out, up])
            if side > 0:
                window = window[::-1]
            b.quads(_at(T, window[::-1]), Material.GLASS, offset_kelvin=rng.normal(0.0, 2.0))


def _storey(
    b: MeshBuilder, S: Floats, half: float, out: float, base: float, door: bool,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Windows (and a door) of one storey on the -y side of ``S``."""
    count = max(1, int(2 * half / 2.7))
    centres = (np.arange(count) + 0.5) * 2 * half / count - half
    door_at = int(rng.integers(count)) if door else -1
    for number, x in enumerate(centres):
        if number == door_at:
            _panel(b, S, x, 0.5, base, base + 2.1, out + 0.05, Material.DOOR, rng.normal(0.8, 1.0))
            _panel(b, S, x, 0.3, base + 1.4, base + 1.8, out + 0.07, Material.GLASS, 1.0)
            continue
        if rng.random() < 0.08:
            continue
        wide = rng.choice([0.45, 0.6, 0.9])
        sill, top = base + 0.9, base + 2.2
        leak = abs(rng.normal(0.0, 1.2))
        _panel(b, S, x, wide + 0.09, sill - 0.09, top + 0.09, out + 0.03, Material.FRAME, leak)
        panes = 2 if wide > 0.5 else 1
        for pane in range(panes):
            centre = x - wide + (2 * pane + 1) * wide / panes
            _panel(b, S, centre, wide / panes - 0.03, sill, top, out + 0.05, Material.GLASS,
                   rng.normal(0.0, 1.0))  # fmt: skip
        sill_box = np.array([[x - wide - 0.15, -out - 0.16, sill - 0.16],
                             [x + wide + 0.15, -out, sill - 0.09]])  # fmt: skip
        b.box(sill_box[0], sill_box[1], Material.CONCRETE, T_map_object=S, offset_kelvin=-0.8)
        if rng.random() < 0.25:  # radiator behind the wall below the window
            _panel(b, S, x, wide, sill - 0.75, sill - 0.2, out + 0.004, Material.PLASTER,
                   rng.uniform(1.5, 4.0))  # fmt: skip


def _panel(
    b: MeshBuilder, S: Floats, x: float, half: float, low: float, high: float, out: float,
    material: Material, offset: float,
) -> None:  # fmt: skip
    corners = np.array(
        [
            [x - half, -out, low],
            [x + half, -out, low],
            [x + half, -out, high],
            [x - half, -out, high],
        ]
    )
    b.quads(_at(S, corners), material, offset_kelvin=offset)


def tree(b: MeshBuilder, T: Floats, height_m: float, leaves: int, rng: np.random.Generator) -> None:
    """A broad-leaved tree: trunk, branches and a crown of leaf clusters with gaps."""
    crown = height_m * rng.uniform(0.28, 0.4)
    middle = height_m - crown * rng.uniform(0.85, 1.0)
    lean = rng.normal(0.0, 0.25, 2)
    top = np.array([lean[0], lean[1], middle])
    radius = 0.022 * height_m
    b.cylinder(_at(T, np.array([0, 0, -0.3])), _at(T, top), radius, Material.BARK,
               top_radius_m=0.5 * radius, offset_kelvin=1.0)  # fmt: skip
    clumps = rng.normal(0.0, 1.0, (9, 3))
    clumps *= crown * 0.55 * np.array([1.0, 1.0, 0.75]) / np.linalg.norm(clumps, axis=1)[:, None]
    clumps += top
    for clump in clumps[:6]:
        start = top * rng.uniform(0.6, 0.95)
        b.cylinder(_at(T, start), _at(T, clump), 0.35 * radius, Material.BARK,
                   top_radius_m=0.12 * radius, sides=5, offset_kelvin=0.6)  # fmt: skip
    which = rng.integers(len(clumps), size=leaves)
    way = rng.normal(0.0, 1.0, (leaves, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    far = crown * 0.6 * rng.random((leaves, 1)) ** 0.45
    centres = clumps[which] + way * far
    # Fewer leaves are larger ones: the crown stays as dense.
    size = crown * rng.uniform(0.7, 1.4, leaves) * 3.0 / np.sqrt(leaves) * 0.9
    heat = rng.normal(0.0, 1.0, 9)[which] + rng.normal(0.0, 0.8, leaves)
    leaf_cards(b, _at(T, centres), size, heat, Material.FOLIAGE, rng)


def leaf_cards(
    b: MeshBuilder, centres_m: Floats, size_m: Floats, offset_kelvin: Floats, material: Material,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """(N, 3) clusters of leaves as triangles turned at random."""
    n = len(centres_m)
    u = rng.normal(0.0, 1.0, (n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.normal(0.0, 1.0, (n, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    s = size_m[:, None]
    cards = np.stack(
        [centres_m - s * u - 0.6 * s * v, centres_m + s * u - 0.6 * s * v, centres_m + 1.2 * s * v],
        axis=1,
    )
    b.triangles(cards, material, offset_kelvin=offset_kelvin[:, None],
                one_surface=False)  # fmt: skip


def hedge(
    b: MeshBuilder, T: Floats, length_m: float, height_m: float, rng: np.random.Generator
) -> None:
    """A clipped hedge along x."""
    half = length_m / 2
    b.box([-half, -0.3, -0.3], [half, 0.3, height_m], Material.HEDGE, T_map_object=T)
    n = int(25 * length_m)
    centres = np.column_stack(
        [
            rng.uniform(-half, half, n),
            rng.choice([-0.3, 0.3], n) + rng.normal(0.0, 0.05, n),
            rng.uniform(0.0, height_m + 0.1, n),
        ]
    )
    leaf_cards(b, _at(T, centres), rng.uniform(0.06, 0.14, n), rng.normal(0.0, 1.0, n),
               Material.HEDGE, rng)  # fmt: skip


def car(b: MeshBuilder, T: Floats, rng: np.random.Generator, *, engine_kelvin: float = 0.0) -> None:
    """A car along x.  ``engine_kelvin`` is how warm a recent drive has left it."""
    length, width = rng.uniform(3.9, 4.8), rng.uniform(1.68, 1.85)
    x, y = length / 2, width / 2
    low, belt, top = 0.32, 0.88, rng.uniform(1.42, 1.65)
    warm = engine_kelvin
    offset = rng.normal(0.0, 1.0)
    # Lower body: nose and tail slope a little.
    side = np.array([[-x, low], [x, low], [x, 0.62], [0.93 * x, 0.78], [0.45 * x, belt],
                     [-0.95 * x, belt], [-x, 0.7]])  # fmt: skip
    heat = np.array([0.0, 0.5, 0.6, 0.7, 0.3, 0.0, 0.1]) * warm + offset
    _prism(b, T, side, y, Material.CAR_PAINT, heat)
    cabin = np.array([[0.45 * x, belt], [0.18 * x, top], [-0.55 * x, top], [-0.9 * x, belt]])
    _prism(b, T, cabin, 0.86 * y, Material.CAR_PAINT, np.full(4, offset))
    glass = np.array([[0.40 * x, belt + 0.04], [0.17 * x, top - 0.07],
                      [-0.53 * x, top - 0.07], [-0.82 * x, belt + 0.04]])  # fmt: skip
    for s in (-1.0, 1.0):
        for first, last in ((0.02, 0.45), (0.5, 0.97)):
            low_edge = glass[0] + (glass[3] - glass[0]) * np.array([[first], [last]])
            high_edge = glass[1] + (glass[2] - glass[1]) * np.array([[first], [last]])
            xz = np.array([low_edge[0], low_edge[1], high_edge[1], high_edge[0]])
            pane = np.column_stack([xz[:, 0], np.full(4, s * (0.86 * y + 0.012)), xz[:, 1]])
            b.quads(_at(T, pane if s > 0 else pane[::-1]), Material.CAR_GLASS,
                    offset_kelvin=rng.normal(0.0, 0.6))  # fmt: skip
    for a, c, sign in ((cabin[0], cabin[1], 1.0), (cabin[3], cabin[2], -1.0)):
        ends = np.stack([a + 0.1 * (c - a), a + 0.92 * (c - a)])
        w = 0.78 * y
        pane = np.array(
            [[ends[0, 0], -w, ends[0, 1]], [ends[0, 0], w, ends[0, 1]],
             [ends[1, 0], w, ends[1, 1]], [ends[1, 0], -w, ends[1, 1]]]
        )  # fmt: skip
        pane[:, 0] += 0.012 * sign
        pane[:, 2] += 0.012
        b.quads(_at(T, pane if sign > 0 else pane[::-1]), Material.CAR_GLASS,
                offset_kelvin=rng.normal(0.0, 0.6))  # fmt: skip
    for wheel_x in (-0.62 * x, 0.62 * x):
        for s in (-1.0, 1.0):
            _wheel(b, T, wheel_x, s * y, s, 0.35 * warm + rng.normal(0.0, 0.4))
    # Grille, plates and lamps.
    for sign in (-1.0, 1.0):
        xs = sign * (x + 0.012)
        for y0, y1, z0, z1, material, kelvin in (
            (-0.26, 0.26, 0.42, 0.53, Material.FRAME, -1.0),
            (-0.55, 0.55, 0.55, 0.64, Material.HOT_METAL, 0.9 * warm * (sign > 0)),
            (0.6, 0.82, 0.55, 0.68, Material.GLASS, 0.0),
            (-0.82, -0.6, 0.55, 0.68, Material.GLASS, 0.0),
        ):
            pane = np.array([[xs, y0, z0], [xs, y1, z0], [xs, y1, z1], [xs, y0, z1]])
            b.quads(_at(T, pane if sign > 0 else pane[::-1]), material, offset_kelvin=kelvin)
    if warm > 0.0:
        exhaust = np.array([-x - 0.03, 0.5, 0.3])
        b.box(exhaust - 0.05, exhaust + 0.05, Material.HOT_METAL, T_map_object=T,
              offset_kelvin=1.5 * warm)  # fmt: skip


def _prism(
    b: MeshBuilder, T: Floats, outline_xz: Floats, half_y: float, material: Material, heat: Floats
) -> None:
    """The outline (N, 2), clockwise or not, drawn out along y; ``heat`` (N,) at its corners."""
    area = np.sum(
        outline_xz[:, 0] * np.roll(outline_xz[:, 1], -1)
        - np.roll(outline_xz[:, 0], -1) * outline_xz[:, 1]
    )
    if area > 0:  # make it clockwise in (x, z), which is counter-clockwise seen from -y
        outline_xz, heat = outline_xz[::-1], heat[::-1]
    n = len(outline_xz)
    near = np.column_stack([outline_xz[:, 0], np.full(n, -half_y), outline_xz[:, 1]])
    far = near * [1.0, -1.0, 1.0]
    following = np.roll(np.arange(n), -1)
    sides = np.stack([near, near[following], far[following], far], axis=1)
    offsets = np.stack([heat, heat[following], heat[following], heat], axis=1)
    b.quads(_at(T, sides), material, offset_kelvin=offsets)
    for ring in (near[::-1], far):
        fan = np.stack([np.repeat(ring[:1], n - 2, axis=0), ring[1:-1], ring[2:]], axis=1)
        values = heat[::-1] if ring is not far else heat
        fan_heat = np.stack([np.repeat(values[:1], n - 2), values[1:-1], values[2:]], axis=1)
        b.triangles(_at(T, fan), material, offset_kelvin=fan_heat)


def _wheel(b: MeshBuilder, T: Floats, x: float, y: float, s: float, warm: float) -> None:
    angles = np.linspace(0.0, 2 * np.pi, 13)[:-1]
    for radius, out, material, kelvin in (
        (0.32, 0.01, Material.TYRE, warm),
        (0.19, 0.025, Material.POLE, 1.6 * warm - 1.5),
    ):
        ring = np.column_stack(
            [x + radius * np.cos(angles), np.full(12, y + s * out), 0.32 + radius * np.sin(angles)]
        )
        fan = np.stack([np.repeat(ring[:1], 10, axis=0), ring[1:-1], ring[2:]], axis=1)
        b.triangles(_at(T, fan), material, offset_kelvin=kelvin)


def person(b: MeshBuilder, T: Floats, rng: np.random.Generator, air_kelvin: float) -> None:
    """A standing person; clothes lie between air and skin."""
    skin = 305.5 - air_kelvin
    clothes = 0.22 * skin
    tall = rng.uniform(1.6, 1.9)
    hip, shoulder = 0.48 * tall, 0.82 * tall

    def tube(foot: list[float], top: list[float], radius: float, kind: Material, k: float) -> None:
        b.cylinder(_at(T, np.array(foot)), _at(T, np.array(top)), radius, kind,
                   top_radius_m=radius * 0.85, offset_kelvin=k)  # fmt: skip

    step = rng.uniform(-0.15, 0.15)
    for s in (-1, 1):
        tube([s * step, 0.1 * s, 0.0], [0, 0.09 * s, hip], 0.075, Material.CLOTHES, clothes)
        tube([-s * step, 0.25 * s, hip], [0, 0.2 * s, shoulder], 0.05, Material.CLOTHES, clothes)
        tube([-s * step, 0.25 * s, hip - 0.1], [-s * step, 0.25 * s, hip], 0.045, Material.SKIN,
             0.8 * skin)  # fmt: skip
    tube([0, 0, hip], [0, 0, shoulder], 0.17, Material.CLOTHES, clothes + 1.0)
    tube([0, 0, shoulder], [0, 0, shoulder + 0.06], 0.17, Material.CLOTHES, clothes + 2.0)
    b.box([-0.09, -0.08, shoulder + 0.06], [0.1, 0.08, tall], Material.SKIN, T_map_object=T,
          offset_kelvin=skin)  # fmt: skip


def lamp_post(b: MeshBuilder, T: Floats, height_m: float, *, warm_kelvin: float = 0.0) -> None:
    """A post whose arm reaches out along x."""
    b.cylinder(_at(T, np.zeros(3)), _at(T, np.array([0.0, 0.0, height_m])), 0.09, Material.POLE,
               top_radius_m=0.05)  # fmt: skip
    b.cylinder(_at(T, np.array([0.0, 0.0, height_m])), _at(T, np.array([1.5, 0.0, height_m + 0.2])),
               0.045, Material.POLE, sides=6)  # fmt: skip
    b.box([1.2, -0.14, height_m + 0.1], [1.9, 0.14, height_m + 0.26], Material.POLE,
          T_map_object=T, offset_kelvin=warm_kelvin)  # fmt: skip


def sign(b: MeshBuilder, T: Floats, rng: np.random.Generator) -> None:
    """A traffic sign that faces -x."""
    b.cylinder(_at(T, np.zeros(3)), _at(T, np.array([0.0, 0.0, 2.7])), 0.035, Material.POLE,
               sides=6)  # fmt: skip
    sides = int(rng.choice([3, 4, 8, 12]))
    angles = np.linspace(0.0, 2 * np.pi, sides + 1)[:-1] + (np.pi / 2 if sides == 3 else 0.3)
    ring = np.column_stack(
        [np.full(sides, -0.05), 0.36 * np.cos(angles), 2.45 + 0.36 * np.sin(angles)]
    )
    for plate, shift, kelvin in ((ring[::-1], 0.0, -2.0), (ring, 0.08, -1.0)):
        plate = plate + np.array([shift, 0.0, 0.0])
        fan = np.stack([np.repeat(plate[:1], sides - 2, axis=0), plate[1:-1], plate[2:]], axis=1)
        b.triangles(_at(T, fan), Material.CAR_PAINT, offset_kelvin=kelvin)


def bench(b: MeshBuilder, T: Floats) -> None:
    """A park bench along x."""
    for y in (-0.2, 0.0, 0.2):
        b.box([-0.9, y - 0.07, 0.42], [0.9, y + 0.07, 0.46], Material.FENCE, T_map_object=T)
    b.box([-0.9, 0.25, 0.5], [0.9, 0.29, 0.85], Material.FENCE, T_map_object=T)
    for x in (-0.75, 0.75):
        b.box([x - 0.05, -0.22, 0.0], [x + 0.05, 0.28, 0.45], Material.CONCRETE, T_map_object=T)


def bin_(b: MeshBuilder, T: Floats, rng: np.random.Generator) -> None:
    """A wheeled rubbish bin."""
    kelvin = rng.normal(0.0, 1.5)
    b.box([-0.28, -0.3, 0.05], [0.28, 0.3, 1.0], Material.FENCE, T_map_object=T,
          offset_kelvin=kelvin)  # fmt: skip
    b.box([-0.3, -0.34, 1.0], [0.3, 0.34, 1.08], Material.CAR_PAINT, T_map_object=T,
          offset_kelvin=kelvin - 1.0)  # fmt: skip
