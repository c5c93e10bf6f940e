"""Scenes for calibration: uniform sources, and boards that thermal cameras can see.

The aluminium board is that of Mouats et al.: polished squares mirror the cold sky, painted ones
radiate their own warmth.  The mask board is that of Vidas et al.: square holes before a warm panel.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.transforms import (
    exp_so3,
    inverse,
    make_transform,
    transform_points,
)
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import Mesh, MeshBuilder
from thermal_stereo_vo.simulation.scene import Heating, Mover, Scene

Floats = NDArray[np.float64]

_THICK_M = 0.006


@dataclass(frozen=True)
class Board:
    """A flat target; its axes are x right, y down, z away from the viewer, origin in the middle.

    A chessboard has ``columns`` x ``rows`` squares of ``square_m``; a mask has so many holes of
    ``square_m``, two sides apart.
    """

    columns: int
    rows: int
    square_m: float

    def corners_m(self) -> Floats:
        """(N, 3) inner corners of the chessboard, row by row, in board axes."""
        x = (np.arange(1, self.columns) - self.columns / 2) * self.square_m
        y = (np.arange(1, self.rows) - self.rows / 2) * self.square_m
        gx, gy = np.meshgrid(x, y)
        return np.column_stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)])

    def holes_m(self) -> Floats:
        """(N, 4, 3) corners of the holes of the mask, row by row, in board axes."""
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * 2 * self.square_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * 2 * self.square_m
        half = self.square_m / 2
        corner = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
        flat = centres + corner
        return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2)


CHESSBOARD = Board(columns=9, rows=7, square_m=0.06)
MASK = Board(columns=6, rows=4, square_m=0.04)


def aluminium_chessboard(board: Board, frame_m: float = 0.04) -> Mesh:
    """Squares of polished aluminium and black paint, in board axes."""
    b = MeshBuilder()
    s = board.square_m
    for i in range(board.rows):
        for j in range(board.columns):
            x, y = (j - board.columns / 2) * s, (i - board.rows / 2) * s
            kind = Material.PAINTED_BOARD if (i + j) % 2 else Material.ALUMINIUM
            b.quads(_facing(x, y, x + s, y + s, 0.0), kind)
    half = np.array([board.columns, board.rows]) * s / 2
    outer = half + frame_m
    for x0, y0, x1, y1 in (
        (-outer[0], -outer[1], outer[0], -half[1]),
        (-outer[0], half[1], outer[0], outer[1]),
        (-outer[0], -half[1], -half[0], half[1]),
        (half[0], -half[1], outer[0], half[1]),
    ):
        b.quads(_facing(x0, y0, x1, y1, 0.0), Material.ALUMINIUM)
    back = _facing(-outer[0], -outer[1], outer[0], outer[1], _THICK_M)
    b.quads(back[:, ::-1], Material.PAINTED_BOARD)
    return b.build()


def heated_mask(board: Board, warm_kelvin: float, frame_m: float = 0.08) -> Mesh:
    """A fibreboard with holes before a panel ``warm_kelvin`` above the air; a corner is cut."""
    b = MeshBuilder()
    s = board.square_m
    half = np.array([board.columns - 0.5, board.rows - 0.5]) * s + frame_m
    # The board as bars between the holes: whole rows, then the pieces between neighbours.
    holes = board.holes_m()
    tops = np.unique(np.round(holes[:, 0, 1], 9))
    lefts = np.unique(np.round(holes[:, 0, 0], 9))
    rows = [-half[1], *(edge for top in tops for edge in (top, top + s)), half[1]]
    columns = [-half[0], *(edge for left in lefts for edge in (left, left + s)), half[0]]
    faces = []
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            if not (i % 2 and j % 2):
                piece = _facing(columns[j], rows[i], columns[j + 1], rows[i + 1], 0.0)
                faces.append(piece)
    b.quads(np.concatenate(faces), Material.MDF, one_surface=True)
    cut = 0.6 * s
    mark = np.array([-half[0] + 0.75 * frame_m, -half[1] + 0.75 * frame_m, -0.0005])
    b.triangles(
        mark + np.array([[[0.0, 0.0, 0.0], [0.0, cut, 0.0], [cut, 0.0, 0.0]]]),
        Material.HEATED_PANEL,
        offset_kelvin=warm_kelvin,
    )
    edges = []
    for hole in holes:  # the walls of the holes
        deep = hole + np.array([0.0, 0.0, _THICK_M])
        edges += [
            np.array([hole[k], deep[k], deep[(k + 1) % 4], hole[(k + 1) % 4]]) for k in range(4)
        ]
    b.quads(np.array(edges), Material.MDF, offset_kelvin=0.3 * warm_kelvin)
    panel = half + 0.05
    hot = np.array([[0.8, 0.9, 1.0, 0.9]]) * warm_kelvin  # radiators are never quite even
    b.quads(
        _facing(-panel[0], -panel[1], panel[0], panel[1], _THICK_M + 0.02),
        Material.HEATED_PANEL,
        offset_kelvin=hot,
    )
    return b.build()


def board_scene(mesh: Mesh, T_map_boards: Sequence[Floats], hold_s: float) -> Scene:
    """The board in each pose (4, 4) for ``hold_s``, over a lawn before distant trees."""
    poses = [np.asarray(T, dtype=float) for T in T_map_boards]

    def pose(time_s: float) -> Floats:
        return poses[int(np.clip(time_s / hold_s + 1e-6, 0, len(poses) - 1))]

    b = MeshBuilder()
    far = 300.0
    lawn = np.array([[-far, -far, 0.0], [far, -far, 0.0], [far, far, 0.0], [-far, far, 0.0]])
    b.quads(lawn, Material.GRASS)
    angles = np.linspace(0.0, 2 * np.pi, 61)
    ring = 60.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    foot = np.column_stack([ring, np.zeros(61)])
    head = np.column_stack([ring, 6.0 + 2.0 * np.sin(9 * angles)])
    quads = np.stack([foot[1:], foot[:-1], head[:-1], head[1:]], axis=1)
    b.quads(quads, Material.HEDGE, one_surface=True)
    return Scene(b.build(), (Mover(mesh, pose),))


def board_poses(
    count: int,
    distance_m: tuple[float, float],
    lean_deg: tuple[float, float],
    is_seen: Callable[[Floats], bool],
    rng: np.random.Generator,
) -> list[Floats]:
    """(4, 4) poses T_rig_board before a rig that looks along z, spread over its view.

    ``lean_deg`` is how far the board leans back, so that it mirrors the sky.  Only poses that
    ``is_seen`` accepts are taken.
    """
    poses: list[Floats] = []
    for n in itertools.count():
        z = rng.uniform(*distance_m)
        # Nine places in turn, so that the corners of the picture are covered.
        x = 0.36 * z * ((n % 3) - 1) + rng.normal(0.0, 0.03) * z
        y = 0.24 * z * ((n // 3 % 3) - 1) + rng.normal(0.0, 0.03) * z
        lean = np.radians(rng.uniform(*lean_deg))
        R = exp_so3([0.0, rng.uniform(-0.5, 0.5), 0.0]) @ exp_so3([-lean, 0.0, 0.0])
        R = R @ exp_so3([0.0, 0.0, rng.uniform(-0.35, 0.35)])
        pose = make_transform(R, [x + 0.134, y, z])  # before the middle of both eyes
        if is_seen(pose):
            poses.append(pose)
        if len(poses) == count:
            break
    return poses


def seen_by_all(
    rig: RigCalibration, points_m: Floats, margin_px: float
) -> Callable[[Floats], bool]:
    """Whether every camera sees the points (N, 3) of a board in a pose T_rig_board."""

    def is_seen(T_rig_board: Floats) -> bool:
        for mounted in rig.cameras.values():
            T_camera_board = inverse(mounted.T_rig_camera) @ T_rig_board
            pixels = mounted.camera.project(transform_points(T_camera_board, points_m))
            highest = np.array(mounted.camera.size) - 1 - margin_px
            if not np.all((pixels >= margin_px) & (pixels <= highest)):
                return False
        return True

    return is_seen


def blackbody_scene(step_s: float | None = None, step_kelvin: float = 0.0) -> Scene:
    """A black wall all round at air temperature; ``step_kelvin`` warmer from ``step_s`` on."""
    b = MeshBuilder()
    b.box([-2.0, -2.0, -2.0], [2.0, 2.0, 2.0], Material.BLACKBODY)
    heating: tuple[Heating, ...] = ()
    if step_s is not None:
        start = step_s

        def kelvin(time_s: float) -> float:
            return step_kelvin if time_s >= start else 0.0

        heating = (Heating(int(Material.BLACKBODY), kelvin),)
    return Scene(b.build(), heating=heating)


def _facing(x0: float, y0: float, x1: float, y1: float, z: float) -> Floats:
    """(1, 4, 3) rectangle seen from -z, in axes x right, y down."""
    return np.array([[[x0, y0, z], [x0, y1, z], [x1, y1, z], [x1, y0, z]]])
