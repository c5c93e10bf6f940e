"""What the surfaces of the scenes are made of, in both bands.

Emissivities (8-14 um) are those of the FLIR tables; the temperature figures are of the size that
field guides and the recorded stills show.  The two bands share the geometry and nothing else: a
thermal texture is never a copy of a visible one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, auto


class Material(IntEnum):
    """Index of a material in every table."""

    ASPHALT = 0
    PAVING = auto()
    KERB = auto()
    MARKING = auto()
    PATCH = auto()
    GRASS = auto()
    SOIL = auto()
    BRICK = auto()
    PLASTER = auto()
    CONCRETE = auto()
    ROOF_TILE = auto()
    METAL_ROOF = auto()
    GLASS = auto()
    FRAME = auto()
    DOOR = auto()
    FENCE = auto()
    FOLIAGE = auto()
    BARK = auto()
    HEDGE = auto()
    ALUMINIUM = auto()
    CAR_PAINT = auto()
    CAR_GLASS = auto()
    TYRE = auto()
    HOT_METAL = auto()
    SKIN = auto()
    CLOTHES = auto()
    POLE = auto()
    CABLE = auto()
    HILL = auto()
    WALL = auto()
    FLOOR = auto()
    WOOD = auto()
    SCREEN = auto()
    PLASTIC = auto()
    POSTER = auto()
    BLACKBODY = auto()
    PAINTED_BOARD = auto()
    MDF = auto()
    HEATED_PANEL = auto()
    LAMP = auto()


@dataclass(frozen=True)
class Texture:
    """Variation along a surface.

    ``amplitude`` of the octaves (K, or relative reflectance), ``spacing_m`` of the coarsest,
    ``octaves`` and the ratio ``persistence`` from one to the next finer.  ``cracks`` is the step
    along thin lines, ``patches`` that of areas with a sharp border.  Tiles of ``cell_m`` (along,
    up) differ by ``cells`` and are parted by ``joints``.
    """

    amplitude: float = 0.0
    spacing_m: float = 1.0
    octaves: int = 5
    persistence: float = 0.7
    cracks: float = 0.0
    patches: float = 0.0
    cell_m: tuple[float, float] = (0.0, 0.0)
    cells: float = 0.0
    joints: float = 0.0


@dataclass(frozen=True)
class Substance:
    """One material.

    Temperatures relative to the air: ``solar_kelvin`` in full sun at right angles,
    ``stored_kelvin`` that heat storage adds, ``sky_loss_kelvin`` that a clear night sky takes from
    a surface facing it, ``own_kelvin`` always there.  The texture of ``passive`` things fades with
    the contrast of the weather, and so do the offsets of their parts unless they are ``heated``.
    ``mirror`` surfaces reflect one direction, others the whole hemisphere.  ``albedo`` and
    ``paint`` are the visible reflectance and its variation.
    """

    emissivity: float
    solar_kelvin: float = 0.0
    stored_kelvin: float = 0.0
    sky_loss_kelvin: float = 0.0
    own_kelvin: float = 0.0
    passive: bool = True
    heated: bool = False
    mirror: bool = False
    heat: Texture = field(default_factory=Texture)
    albedo: float = 0.3
    paint: Texture = field(default_factory=Texture)


SUBSTANCES: dict[Material, Substance] = {
    Material.ASPHALT: Substance(
        0.95, 22.0, 3.0, 2.5, 0.0,
        heat=Texture(0.9, 3.0, 9, 0.80, cracks=-1.2, patches=0.5),
        albedo=0.12, paint=Texture(0.25, 1.5, 9, 0.85, cracks=-0.4, patches=-0.15),
    ),
    Material.PAVING: Substance(
        0.94, 18.0, 2.5, 2.0,
        heat=Texture(1.0, 1.5, 8, 0.8, cell_m=(0.6, 0.6), cells=0.8, joints=-1.2),
        albedo=0.35, paint=Texture(0.15, 0.8, 8, 0.8, cell_m=(0.6, 0.6), cells=0.1, joints=-0.3),
    ),
    Material.KERB: Substance(
        0.93, 16.0, 2.5, 1.0,
        heat=Texture(0.8, 0.8, 6, 0.7, cell_m=(0.9, 0.3), cells=0.8, joints=-0.8),
        albedo=0.45, paint=Texture(0.15, 0.5, 6, 0.8),
    ),
    Material.MARKING: Substance(
        0.92, 15.0, 2.5, 3.2,
        heat=Texture(1.2, 0.6, 6, 0.75), albedo=0.75, paint=Texture(0.3, 0.3, 6, 0.8),
    ),
    Material.PATCH: Substance(
        0.96, 24.0, 3.6, 2.2, heat=Texture(0.8, 0.8, 7, 0.75, cracks=-1.0),
        albedo=0.07, paint=Texture(0.2, 0.8, 8, 0.85),
    ),
    Material.GRASS: Substance(
        0.97, 8.0, 0.0, 6.0,
        heat=Texture(2.6, 2.0, 9, 0.88), albedo=0.22, paint=Texture(0.5, 1.2, 9, 0.9),
    ),
    Material.SOIL: Substance(
        0.93, 18.0, 1.0, 3.0,
        heat=Texture(2.2, 1.2, 8, 0.75), albedo=0.25, paint=Texture(0.4, 0.8, 8, 0.85),
    ),
    Material.BRICK: Substance(
        0.93, 15.0, 3.0, 1.0,
        heat=Texture(1.0, 3.0, 9, 0.78, cell_m=(0.44, 0.15), cells=0.5, joints=-0.6),
        albedo=0.28, paint=Texture(0.2, 2.0, 6, 0.7, cell_m=(0.22, 0.075), cells=0.3, joints=0.3),
    ),
    Material.PLASTER: Substance(
        0.94, 13.0, 2.2, 1.0,
        heat=Texture(1.2, 2.5, 9, 0.76, patches=0.6, cracks=-0.5),
        albedo=0.62, paint=Texture(0.12, 2.0, 8, 0.75, patches=-0.06),
    ),
    Material.CONCRETE: Substance(
        0.94, 14.0, 3.2, 1.2,
        heat=Texture(1.1, 2.0, 8, 0.76, cell_m=(2.4, 1.2), cells=0.8, joints=-1.0, cracks=-0.4),
        albedo=0.42, paint=Texture(0.15, 1.5, 8, 0.8, cell_m=(2.4, 1.2), cells=0.06, joints=-0.3),
    ),
    Material.ROOF_TILE: Substance(
        0.92, 20.0, 0.5, 5.0,
        heat=Texture(1.4, 2.0, 6, 0.7, cell_m=(0.33, 0.33), cells=1.0, joints=-0.8),
        albedo=0.2, paint=Texture(0.2, 1.0, 6, 0.8, cell_m=(0.33, 0.33), cells=0.3, joints=-0.4),
    ),
    Material.METAL_ROOF: Substance(
        0.45, 12.0, 0.0, 5.0,
        heat=Texture(0.8, 2.0, 5, 0.7, cell_m=(0.5, 0.0), cells=0.6, joints=0.8),
        albedo=0.5, paint=Texture(0.1, 1.0, 6, 0.7, cell_m=(0.5, 0.0), joints=-0.3),
    ),
    Material.GLASS: Substance(
        0.86, 4.0, 1.0, 0.5, 0.4, mirror=True, heated=True,
        heat=Texture(0.5, 0.9, 4, 0.6), albedo=0.08, paint=Texture(0.2, 0.5, 4, 0.7),
    ),
    Material.FRAME: Substance(
        0.92, 10.0, 1.5, 1.0, 0.5, heated=True,
        heat=Texture(0.6, 0.5, 4, 0.7), albedo=0.8, paint=Texture(0.05, 0.5, 4, 0.7),
    ),
    Material.DOOR: Substance(
        0.92, 12.0, 0.8, 0.6, 0.6, heated=True,
        heat=Texture(0.7, 0.6, 5, 0.7, cell_m=(0.45, 0.9), cells=0.6, joints=0.5),
        albedo=0.2, paint=Texture(0.1, 0.5, 5, 0.7, cell_m=(0.45, 0.9), joints=-0.4),
    ),
    Material.FENCE: Substance(
        0.93, 12.0, 0.2, 1.5,
        heat=Texture(0.9, 0.7, 6, 0.75, cell_m=(0.15, 0.0), cells=0.7, joints=-0.6),
        albedo=0.3, paint=Texture(0.25, 0.4, 6, 0.8, cell_m=(0.15, 0.0), cells=0.2, joints=-0.4),
    ),
    Material.FOLIAGE: Substance(
        0.97, 8.0, 0.3, 1.5,
        heat=Texture(0.9, 0.5, 2, 0.9), albedo=0.14, paint=Texture(0.4, 0.5, 5, 0.85),
    ),
    Material.BARK: Substance(
        0.95, 8.0, 1.0, 0.5,
        heat=Texture(1.2, 0.4, 5, 0.75), albedo=0.15, paint=Texture(0.4, 0.2, 5, 0.85),
    ),
    Material.HEDGE: Substance(
        0.97, 8.0, 0.3, 2.5,
        heat=Texture(2.4, 0.6, 6, 0.85), albedo=0.12, paint=Texture(0.6, 0.4, 6, 0.9),
    ),
    Material.ALUMINIUM: Substance(0.05, mirror=True, albedo=0.8),
    Material.CAR_PAINT: Substance(
        0.82, 16.0, 0.3, 4.0, mirror=True, heated=True,
        heat=Texture(0.8, 0.7, 4, 0.65), albedo=0.35, paint=Texture(0.05, 0.6, 4, 0.6),
    ),
    Material.CAR_GLASS: Substance(
        0.87, 6.0, 0.2, 3.5, mirror=True, heated=True,
        heat=Texture(0.5, 0.7, 4, 0.6), albedo=0.05, paint=Texture(0.2, 0.5, 4, 0.6),
    ),
    Material.TYRE: Substance(
        0.95, 8.0, 0.5, 0.5, heated=True, heat=Texture(0.6, 0.2, 4, 0.7), albedo=0.05,
    ),
    Material.HOT_METAL: Substance(
        0.9, 4.0, own_kelvin=0.0, passive=False, heat=Texture(1.5, 0.4, 5, 0.7), albedo=0.1,
    ),
    Material.SKIN: Substance(
        0.98, own_kelvin=0.0, passive=False, heat=Texture(0.4, 0.1, 4, 0.7), albedo=0.4,
    ),
    Material.CLOTHES: Substance(
        0.95, 4.0, own_kelvin=0.0, passive=False,
        heat=Texture(1.2, 0.25, 5, 0.75), albedo=0.2, paint=Texture(0.3, 0.2, 5, 0.8),
    ),
    Material.POLE: Substance(
        0.92, 8.0, 0.3, 1.5, heat=Texture(0.6, 0.5, 5, 0.7), albedo=0.35,
        paint=Texture(0.15, 0.4, 5, 0.8),
    ),
    Material.CABLE: Substance(0.93, 6.0, 0.0, 1.5, albedo=0.06),
    Material.HILL: Substance(
        0.96, 7.0, 0.2, 2.5, heat=Texture(2.2, 25.0, 6, 0.75), albedo=0.18,
        paint=Texture(0.4, 20.0, 6, 0.8),
    ),
    Material.WALL: Substance(
        0.94, own_kelvin=-1.0, passive=False, heat=Texture(0.14, 1.2, 7, 0.75, patches=0.1),
        albedo=0.6, paint=Texture(0.05, 1.0, 7, 0.75),
    ),
    Material.FLOOR: Substance(
        0.93, own_kelvin=-1.8, passive=False,
        heat=Texture(0.35, 1.2, 7, 0.7, cell_m=(0.5, 0.5), cells=0.15, joints=-0.25),
        albedo=0.3, paint=Texture(0.15, 0.5, 8, 0.8, cell_m=(0.5, 0.5), cells=0.1, joints=-0.4),
    ),
    Material.WOOD: Substance(
        0.92, own_kelvin=-0.3, passive=False, heat=Texture(0.4, 0.6, 6, 0.7),
        albedo=0.35, paint=Texture(0.25, 0.4, 7, 0.8),
    ),
    Material.SCREEN: Substance(
        0.9, own_kelvin=12.0, passive=False, heat=Texture(1.5, 0.5, 3, 0.6), albedo=0.05,
    ),
    Material.PLASTIC: Substance(
        0.94, own_kelvin=0.5, passive=False, heat=Texture(0.6, 0.15, 5, 0.7), albedo=0.2,
        paint=Texture(0.1, 0.1, 5, 0.8),
    ),
    Material.POSTER: Substance(
        0.93, own_kelvin=-0.8, passive=False, heat=Texture(0.15, 0.6, 5, 0.7),
        albedo=0.5, paint=Texture(0.8, 0.25, 6, 0.85, cell_m=(0.11, 0.07), cells=0.6),
    ),
    Material.BLACKBODY: Substance(1.0, passive=False, albedo=0.05),
    Material.PAINTED_BOARD: Substance(
        0.95, own_kelvin=1.0, passive=False, heat=Texture(0.1, 0.2, 3), albedo=0.05,
    ),
    Material.MDF: Substance(
        0.93, passive=False, heat=Texture(0.15, 0.1, 4), albedo=0.4,
    ),
    Material.HEATED_PANEL: Substance(
        0.95, passive=False, heat=Texture(0.3, 0.15, 3), albedo=0.5,
    ),
    Material.LAMP: Substance(
        0.94, own_kelvin=0.5, passive=False, heat=Texture(0.6, 0.15, 5, 0.7), albedo=0.95,
    ),
}  # fmt: skip
