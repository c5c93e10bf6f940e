"""A small town on a grid of streets, built around a flight.

Streets run east (x) and north (y); houses, gardens, trees, lamps, cars and people fill the blocks
between them.  Each block and street piece draws from its own generator, so the world does not
depend on how much of it is built.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation import objects
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import MeshBuilder
from thermal_stereo_vo.simulation.objects import placed
from thermal_stereo_vo.simulation.scene import Mover, Scene
from thermal_stereo_vo.simulation.weather import Weather

Floats = NDArray[np.float64]

PITCH_X_M, PITCH_Y_M = 90.0, 70.0
ROAD_HALF_M, PAVEMENT_M = 4.5, 2.0
_BORDER_M = ROAD_HALF_M + PAVEMENT_M
_KERB_M = 0.12
_REACH_M = 110.0
_NEAR_M, _MIDDLE_M = 14.0, 40.0


@dataclass(frozen=True)
class TownOptions:
    """What the streets are full of.  ``density`` scales the number of leaves."""

    seed: int = 1
    traffic: bool = True
    density: float = 1.0


def crossing(i: float, j: float, z_m: float = 0.0) -> tuple[float, float, float]:
    """Where the i-th street going north meets the j-th going east."""
    return (i * PITCH_X_M, j * PITCH_Y_M, z_m + float(height_m(i * PITCH_X_M, j * PITCH_Y_M)))


def height_m(x_m: Floats | float, y_m: Floats | float) -> Floats:
    """Gentle hills: height of the road surface."""
    x, y = np.asarray(x_m, float), np.asarray(y_m, float)
    return np.asarray(
        0.9 * np.sin(x / 47.0 + 0.6) * np.cos(y / 61.0) + 0.5 * np.sin((x + 2 * y) / 83.0)
    )


def build_town(path_m: Floats, options: TownOptions, weather: Weather) -> Scene:
    """The town around a path of (N, 3) points."""
    return _Town(path_m[:, :2], options, weather).build()


class _Town:
    def __init__(self, path: Floats, options: TownOptions, weather: Weather) -> None:
        self._path = path[:: max(1, len(path) // 400)]
        self._options = options
        self._weather = weather
        self._b = MeshBuilder()
        self._movers: list[Mover] = []

    def build(self) -> Scene:
        low, high = self._path.min(axis=0) - _REACH_M, self._path.max(axis=0) + _REACH_M
        self._ground(low, high)
        first = np.floor(low / [PITCH_X_M, PITCH_Y_M]).astype(int)
        last = np.ceil(high / [PITCH_X_M, PITCH_Y_M]).astype(int)
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                self._block(i, j)
                self._street(i, j, along_x=True)
                self._street(i, j, along_x=False)
        self._horizon((low + high) / 2)
        if self._options.traffic:
            self._traffic(low, high)
        return Scene(
            self._b.build(), tuple(self._movers), outdoors=True, extent_m=np.stack([low, high])
        )

    def _distance(self, x: float, y: float) -> float:
        return float(np.min(np.hypot(self._path[:, 0] - x, self._path[:, 1] - y)))

    def _T(self, x: float, y: float, yaw: float = 0.0, raised: bool = True) -> Floats:
        return placed(x, y, float(height_m(x, y)) + raised * _KERB_M, yaw)

    def _ground(self, low: Floats, high: Floats) -> None:
        xs = _grid_lines(low[0], high[0], PITCH_X_M)
        ys = _grid_lines(low[1], high[1], PITCH_Y_M)
        x, y = np.meshgrid(xs, ys, indexing="ij")
        z = height_m(x, y)
        cx = (xs[:-1] + xs[1:]) / 2
        cy = (ys[:-1] + ys[1:]) / 2
        to_x = np.abs(cx - PITCH_X_M * np.round(cx / PITCH_X_M))[:, None]
        to_y = np.abs(cy - PITCH_Y_M * np.round(cy / PITCH_Y_M))[None, :]
        nearest = np.minimum(to_x, to_y)
        material = np.full(nearest.shape, Material.GRASS, np.int32)
        material[nearest < _BORDER_M] = Material.PAVING
        material[nearest < ROAD_HALF_M] = Material.ASPHALT
        raised = _KERB_M * (material != Material.ASPHALT)
        corners = np.stack(
            [
                np.stack([x[a, b], y[a, b], z[a, b] + raised], axis=-1)
                for a, b in (
                    (slice(None, -1), slice(None, -1)),
                    (slice(1, None), slice(None, -1)),
                    (slice(1, None), slice(1, None)),
                    (slice(None, -1), slice(1, None)),
                )
            ],
            axis=2,
        )
        tracks = _wheel_tracks(corners[..., :2])
        for kind in np.unique(material):
            here = material == kind
            self._b.quads(corners[here], int(kind), one_surface=True, offset_kelvin=tracks[here])
        for axis in (0, 1):
            self._kerbs(corners, raised, axis)

    def _kerbs(self, corners: Floats, raised: Floats, axis: int) -> None:
        step = np.diff(raised, axis=axis)
        for sign in (1, -1):
            i, j = np.nonzero(step * sign > 0)
            if len(i) == 0:
                continue
            a, b = (1, 2) if axis == 0 else (3, 2)
            lower_top = corners[i, j][:, [a, b]]
            base = np.where(sign > 0, 0.0, -_KERB_M)
            foot, head = lower_top.copy(), lower_top.copy()
            foot[..., 2] += base
            head[..., 2] += base + _KERB_M
            quads = np.stack([foot[:, 0], foot[:, 1], head[:, 1], head[:, 0]], axis=1)
            flip = (axis == 0) == (sign > 0)
            self._b.quads(quads[:, ::-1] if flip else quads, Material.KERB, one_surface=True)

    def _block(self, i: int, j: int) -> None:
        """The block north-east of crossing (i, j)."""
        rng = np.random.default_rng([self._options.seed, 1, i + 1000, j + 1000])
        x0, y0 = i * PITCH_X_M + _BORDER_M, j * PITCH_Y_M + _BORDER_M
        x1, y1 = (i + 1) * PITCH_X_M - _BORDER_M, (j + 1) * PITCH_Y_M - _BORDER_M
        style = rng.random()
        lots = 4
        width = (x1 - x0) / lots
        for side in (-1, 1):
            for lot in range(lots):
                state = np.random.default_rng(
                    [self._options.seed, 2, i + 1000, j + 1000, lot, side + 1]
                )
                x = x0 + (lot + 0.5) * width
                y = y0 if side < 0 else y1
                if self._distance(x, y) > _REACH_M:
                    continue
                if style < 0.18:
                    self._park(x, y, side, width, state)
                else:
                    self._lot(x, y, side, width, style > 0.8, state)
        for end in (0, 1):  # the short sides
            x = x0 if end == 0 else x1
            for k in range(3):
                y = y0 + 16 + k * 12.0
                state = np.random.default_rng([self._options.seed, 3, i + 1000, j + 1000, k, end])
                if self._distance(x, y) > _REACH_M:
                    continue
                inward = 1 if end == 0 else -1
                if state.random() < 0.6:
                    self._tree(
                        x + inward * state.uniform(2.0, 4.0), y + state.uniform(-3, 3), state
                    )
                if state.random() < 0.5:
                    objects.hedge(self._b, self._T(x + 0.6 * inward, y, np.pi / 2), 10.0,
                                  state.uniform(0.9, 1.6), state)  # fmt: skip
                elif state.random() < 0.6:
                    self._fence(x + 0.4 * inward, y, np.pi / 2, 11.0, state)

    def _tree(self, x: float, y: float, rng: np.random.Generator) -> None:
        away = self._distance(x, y)
        fine = 2400 if away < _NEAR_M else 900 if away < _MIDDLE_M else 300
        leaves = int(self._options.density * fine)
        # Crowns (up to 0.46 of the height) keep clear of the flight.
        tallest = min(11.0, (away - 1.5) / 0.46)
        if tallest > 4.0:
            height = rng.uniform(min(5.5, 0.8 * tallest), tallest)
            objects.tree(self._b, self._T(x, y, rng.uniform(0, 6)), height, leaves, rng)

    def _fence(
        self, x: float, y: float, yaw: float, length: float, rng: np.random.Generator
    ) -> None:
        T = self._T(x, y, yaw)
        high = rng.uniform(0.9, 1.7)
        kind = Material.FENCE if rng.random() < 0.6 else Material.BRICK
        self._b.box([-length / 2, -0.06, -0.4], [length / 2, 0.06, high], kind, T_map_object=T)
        posts = np.arange(-length / 2, length / 2 + 0.1, 2.0)
        for post in posts:
            self._b.box([post - 0.07, -0.1, -0.4], [post + 0.07, 0.1, high + 0.12], Material.BARK,
                        T_map_object=T, offset_kelvin=rng.normal(0.0, 0.7))  # fmt: skip

    def _lot(
        self, x: float, y: float, side: int, width: float, flats: bool, rng: np.random.Generator
    ) -> None:
        """A house with its garden; ``side`` -1 faces south."""
        yaw = 0.0 if side < 0 else np.pi
        back = -side
        set_back = rng.uniform(4.0, 7.0)
        w = rng.uniform(8.0, 12.0) if not flats else width - 1.5
        d = rng.uniform(7.0, 9.0)
        shift = rng.uniform(-1.0, 1.0) if not flats else 0.0
        wall = rng.choice([Material.BRICK, Material.BRICK, Material.PLASTER, Material.CONCRETE])
        T = self._T(x + shift, y + back * (set_back + d / 2), yaw)
        objects.house(self._b, T, w, d, int(rng.integers(1, 3)) + 2 * flats, Material(int(wall)),
                      not flats and rng.random() < 0.85, rng)  # fmt: skip
        drive = x + (w / 2 + 1.4) * (1 if rng.random() < 0.5 else -1) + shift
        half = np.array([1.3, set_back / 2 + 1.0])
        self._carpet(drive, y + back * half[1], half, Material.PAVING, 0.012)
        if rng.random() < 0.6:
            objects.car(
                self._b,
                self._T(drive, y + back * (set_back - 0.5), np.pi / 2),
                rng,
                engine_kelvin=float(rng.choice([0.0, 0.0, 12.0])),
            )
        border = rng.random()
        for part in (-1, 1):
            centre = x + part * width / 4
            if abs(centre - drive) < 3.0:
                continue
            if border < 0.4:
                objects.hedge(self._b, self._T(centre, y + 0.5 * back), width / 2 - 1.0,
                              rng.uniform(0.7, 1.5), rng)  # fmt: skip
            elif border < 0.75:
                self._fence(centre, y + 0.4 * back, 0.0, width / 2 - 0.6, rng)
        for _ in range(int(rng.integers(1, 4))):
            tx, ty = x + rng.uniform(-0.5, 0.5) * width, y + back * rng.uniform(1.5, set_back - 1.0)
            if abs(tx - drive) > 2.5:
                if rng.random() < 0.45:
                    self._tree(tx, ty, rng)
                else:
                    n = 160
                    centres = np.array([tx, ty, height_m(tx, ty) + 0.5])
                    centres = centres + rng.normal(0.0, 0.35, (n, 3))
                    objects.leaf_cards(self._b, centres, rng.uniform(0.08, 0.2, n),
                                       rng.normal(0.0, 0.8, n), Material.HEDGE, rng)  # fmt: skip
        if rng.random() < 0.5:
            bx = drive + rng.choice([-1.8, 1.8])
            objects.bin_(self._b, self._T(bx, y + 0.8 * back, rng.uniform(0, 6)), rng)
        for _ in range(2):
            tx, ty = (
                x + rng.uniform(-0.5, 0.5) * width,
                y + back * (set_back + d + rng.uniform(3, 9)),
            )
            if rng.random() < 0.7:
                self._tree(tx, ty, rng)

    def _park(self, x: float, y: float, side: int, width: float, rng: np.random.Generator) -> None:
        back = -side
        for _ in range(4):
            self._tree(x + rng.uniform(-0.5, 0.5) * width, y + back * rng.uniform(2.0, 20.0), rng)
        objects.bench(self._b, self._T(x + rng.uniform(-5, 5), y + 1.5 * back, side * np.pi / 2))
        self._carpet(x, y + back * 6.0, np.array([width / 2, 1.0]), Material.SOIL, 0.015)

    def _carpet(self, x: float, y: float, half: Floats, material: Material, above: float,
                raised: bool = True, yaw: float = 0.0, offset: float = 0.0) -> None:  # fmt: skip
        """A thin covering that follows the ground."""
        nx, ny = (max(1, int(np.ceil(2 * h / 2.0))) for h in half)
        gx, gy = np.linspace(-half[0], half[0], nx + 1), np.linspace(-half[1], half[1], ny + 1)
        u, v = np.meshgrid(gx, gy, indexing="ij")
        px = x + np.cos(yaw) * u - np.sin(yaw) * v
        py = y + np.sin(yaw) * u + np.cos(yaw) * v
        points = np.stack([px, py, height_m(px, py) + above + raised * _KERB_M], axis=-1)
        cells = np.stack(
            [points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2
        )
        self._b.quads(cells, material, one_surface=True, offset_kelvin=offset)

    def _street(self, i: int, j: int, *, along_x: bool) -> None:
        """The piece of street that leaves crossing (i, j) to the east or north."""
        rng = np.random.default_rng([self._options.seed, 4, i + 1000, j + 1000, int(along_x)])
        length = PITCH_X_M if along_x else PITCH_Y_M
        origin = np.array([i * PITCH_X_M, j * PITCH_Y_M])
        way = np.array([1.0, 0.0]) if along_x else np.array([0.0, 1.0])
        left = np.array([-way[1], way[0]])
        yaw = 0.0 if along_x else np.pi / 2
        middle = origin + way * length / 2
        if self._distance(middle[0], middle[1]) > _REACH_M + length / 2:
            return

        def at(s: float, offset: float) -> tuple[float, float]:
            x, y = origin + s * way + offset * left
            return float(x), float(y)

        def paint(s: float, offset: float, half_along: float, half_across: float,
                  material: Material = Material.MARKING, kelvin: float = 0.0) -> None:  # fmt: skip
            x, y = at(s, offset)
            self._carpet(x, y, np.array([half_along, half_across]), material, 0.012,
                         raised=False, yaw=yaw, offset=kelvin)  # fmt: skip

        start, stop = _BORDER_M + 4.0, length - _BORDER_M - 4.0
        for s in np.arange(start + 1.5, stop - 1.5, 6.0):
            paint(s, 0.0, 1.5, 0.07)
        for s in (start - 1.5, stop + 1.5):
            for stripe in np.arange(-3.8, 4.0, 1.1):
                paint(s, stripe, 1.3, 0.27)
        for _ in range(7):
            paint(rng.uniform(start, stop), rng.uniform(-3.2, 3.2), rng.uniform(0.4, 2.5),
                  rng.uniform(0.3, 0.9), Material.PATCH, rng.normal(0.0, 0.8))  # fmt: skip
        for side in (-1, 1):  # tarred seams
            paint((start + stop) / 2, side * rng.uniform(2.9, 3.4), (stop - start) / 2, 0.03,
                  Material.PATCH, -1.5)  # fmt: skip
        for _ in range(5):
            self._tar(at, rng.uniform(start, stop), rng.uniform(-3.5, 3.5), rng)
        for _ in range(3):  # manhole covers
            paint(rng.uniform(start, stop), rng.uniform(-2.5, 2.5), 0.32, 0.32, Material.POLE,
                  rng.uniform(0.0, 4.0))  # fmt: skip
        for s in np.arange(start, stop, 14.0):  # drains at the kerb
            paint(s, ROAD_HALF_M - 0.25, 0.3, 0.2, Material.POLE, rng.uniform(-2.0, 2.0))
        for side in (-1, 1):
            for s in np.arange(start + 5, stop - 4, 6.5):
                if rng.random() < 0.45:
                    x, y = at(s, side * (ROAD_HALF_M - 1.0))
                    warm = float(rng.choice([0.0, 0.0, 0.0, 8.0, 16.0]))
                    objects.car(self._b, self._T(x, y, yaw + (side > 0) * np.pi, raised=False), rng,
                                engine_kelvin=warm)  # fmt: skip
                    if warm > 0.0:
                        paint(s + 1.2 * (1 if side < 0 else -1), side * (ROAD_HALF_M - 1.0), 0.8,
                              0.6, Material.HOT_METAL, 0.25 * warm)  # fmt: skip
            for s in np.arange(start, stop, 27.0):
                x, y = at(s + (13.0 if side > 0 else 0.0), side * (ROAD_HALF_M + 0.35))
                lit = 12.0 if self._weather.lamps else 0.0
                objects.lamp_post(self._b, self._T(x, y, yaw - side * np.pi / 2), 5.5,
                                  warm_kelvin=lit)  # fmt: skip
            for _ in range(2):
                x, y = at(rng.uniform(start, stop), side * (ROAD_HALF_M + 0.3))
                objects.sign(self._b, self._T(x, y, yaw + (side > 0) * np.pi), rng)
            if rng.random() < 0.6:
                x, y = at(rng.uniform(start, stop), side * (ROAD_HALF_M + 1.2))
                objects.person(
                    self._b, self._T(x, y, rng.uniform(0, 6)), rng, self._weather.air_kelvin
                )
            if rng.random() < 0.6:
                for s in np.arange(start + 3, stop, 12.0):
                    x, y = at(s, side * (ROAD_HALF_M + 1.5))
                    if rng.random() < 0.6:
                        self._tree(x, y, rng)
        self._wires(at, length, rng)

    def _tar(
        self, at: Callable[[float, float], tuple[float, float]], s: float, offset: float,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """A crack filled with tar, wandering over the road."""
        heading = rng.uniform(0.0, np.pi)
        for _ in range(int(rng.integers(4, 12))):
            heading += rng.normal(0.0, 0.5)
            t, other = s + 0.7 * np.cos(heading), offset + 0.7 * np.sin(heading)
            if abs(other) > ROAD_HALF_M - 0.1:
                return
            a, c = np.array(at(s, offset)), np.array(at(t, other))
            across = np.array([a[1] - c[1], c[0] - a[0]])
            across *= 0.025 / np.linalg.norm(across)
            flat = np.array([a - across, c - across, c + across, a + across])
            z = height_m(flat[:, 0], flat[:, 1]) + 0.014
            corners = np.column_stack([flat, z])
            if np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] < 0.0:
                corners = corners[::-1]
            self._b.quads(corners, Material.PATCH, offset_kelvin=-2.0)
            s, offset = t, other

    def _wires(self, at: object, length: float, rng: np.random.Generator) -> None:
        """Telegraph poles and sagging wires along one side."""
        if rng.random() > 0.5 or not callable(at):
            return
        stations = np.arange(6.0, length, 26.0)
        heads = []
        for s in stations:
            x, y = at(s, -(_BORDER_M + 0.3))
            T = self._T(x, y)
            top = T[:3, 3] + [0.0, 0.0, 7.5]
            self._b.cylinder(T[:3, 3] - [0, 0, 0.3], top, 0.12, Material.BARK, top_radius_m=0.09)
            heads.append(top)
        for a, c in itertools.pairwise(heads):
            for drop in (0.1, 0.5):
                f = np.linspace(0.0, 1.0, 9)[:, None]
                line = a + f * (c - a) - np.array([0, 0, 1.0]) * (drop + 1.6 * f * (1 - f))
                pieces = np.stack([line[:-1], line[1:]], axis=1)
                self._b.tubes(pieces, np.array([0.012, 0.012]), Material.CABLE, sides=3)

    def _traffic(self, low: Floats, high: Floats) -> None:
        """Cars in the lanes and people on the pavements, to and fro without end."""
        rng = np.random.default_rng([self._options.seed, 8])
        for along in (0, 1):
            pitch = (PITCH_X_M, PITCH_Y_M)[1 - along]
            first = int(np.ceil(low[1 - along] / pitch))
            last = int(np.floor(high[1 - along] / pitch))
            for street in range(first, last + 1):
                for side in (-1, 1):
                    lane = street * pitch - side * 1.7 * (1 if along == 0 else -1)
                    walk = street * pitch - side * (ROAD_HALF_M + 1.0)
                    car = MeshBuilder()
                    objects.car(car, np.eye(4), rng, engine_kelvin=rng.uniform(14.0, 24.0))
                    speed = side * rng.uniform(7.0, 11.0)
                    self._movers.append(
                        Mover(car.build(), _shuttle(low, high, along, lane, speed, 0.0, rng))
                    )
                    someone = MeshBuilder()
                    objects.person(someone, np.eye(4), rng, self._weather.air_kelvin)
                    speed = side * rng.uniform(1.0, 1.6)
                    self._movers.append(
                        Mover(
                            someone.build(), _shuttle(low, high, along, walk, speed, _KERB_M, rng)
                        )
                    )

    def _horizon(self, centre: Floats) -> None:
        """Fields and hills to close the view."""
        rng = np.random.default_rng([self._options.seed, 5])
        angles = np.linspace(0.0, 2 * np.pi, 121)
        for radius, low, high in ((320.0, 9.0, 15.0), (700.0, 18.0, 45.0), (1500.0, 40.0, 140.0)):
            wave = np.zeros(len(angles) - 1)
            for k in (1, 2, 3, 5, 9, 17, 31):
                wave += rng.normal() / np.sqrt(k) * np.sin(k * angles[:-1] + rng.uniform(0, 6))
            wave = (wave - wave.min()) / np.ptp(wave)
            tops = np.append(low + (high - low) * wave, 0.0)
            tops[-1] = tops[0]
            ring = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
            foot = np.column_stack([ring, np.full(len(ring), -6.0)])
            head = np.column_stack([ring, tops])
            quads = np.stack([foot[1:], foot[:-1], head[:-1], head[1:]], axis=1)
            self._b.quads(quads, Material.HILL, one_surface=True)
        far = 2500.0
        corners = np.array([[-far, -far], [far, -far], [far, far], [-far, far]]) + centre
        self._b.quads(np.column_stack([corners, np.full(4, -2.0)]), Material.HILL)


def _grid_lines(low: float, high: float, pitch: float) -> Floats:
    """Lines at every border of road and pavement, and at most 4 m apart."""
    first, last = int(np.floor(low / pitch)), int(np.ceil(high / pitch))
    lines = []
    for i in range(first, last + 1):
        edges = [
            -_BORDER_M, -ROAD_HALF_M, -3.2, -2.45, -1.7, -0.95, -0.2, 0.2, 0.95, 1.7, 2.45, 3.2,
            ROAD_HALF_M, _BORDER_M, pitch - _BORDER_M,
        ]  # fmt: skip
        for a, c in itertools.pairwise(edges):
            count = max(1, int(np.ceil((c - a) / 4.0)))
            lines.append(i * pitch + a + (c - a) * np.arange(count) / count)
    return np.concatenate(lines)


def _shuttle(
    low: Floats, high: Floats, along: int, across_m: float, speed_m_s: float, above_m: float,
    rng: np.random.Generator,
) -> Callable[[float], Floats]:  # fmt: skip
    """Straight along a street, and again from its beginning once out of the town."""
    length = high[along] - low[along]
    start = rng.uniform(0.0, length)
    yaw = (np.pi / 2 if along else 0.0) + (np.pi if speed_m_s < 0 else 0.0)

    def pose(time_s: float) -> Floats:
        s = low[along] + (start + speed_m_s * time_s) % length
        x, y = (across_m, s) if along else (s, across_m)
        return placed(x, y, float(height_m(x, y)) + above_m, yaw)

    return pose


def _wheel_tracks(xy: Floats) -> Floats:
    """Temperature along the lanes of a road: tyres keep two tracks of each lane warmer."""
    along = []
    for axis, pitch in ((0, PITCH_X_M), (1, PITCH_Y_M)):
        off = np.abs(xy[..., axis] - pitch * np.round(xy[..., axis] / pitch))
        along.append(np.interp(off, [0.0, 0.2, 0.95, 1.7, 2.45, 3.2], [0, 0, 1.6, 0.4, 1.6, 0]))
        along.append((off > ROAD_HALF_M).astype(float))
    # Only one of the two streets counts; none does on their crossing.
    return np.asarray(along[0] * along[3] + along[2] * along[1])
