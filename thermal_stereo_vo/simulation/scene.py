"""A world: what stands still, and what moves through it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.mesh import Mesh


@dataclass(frozen=True)
class Mover:
    """A rigid body that changes its place: its mesh and its pose (4, 4) in the map at a time."""

    mesh: Mesh
    T_map_object: Callable[[float], NDArray[np.float64]]


@dataclass(frozen=True)
class Heating:
    """Temperature added to every surface of a material at a time (s): steps, warm-up."""

    material: int
    kelvin: Callable[[float], float]


@dataclass(frozen=True)
class Scene:
    """``static`` never moves; ``movers`` do; ``heating`` changes temperatures over time.

    ``outdoors`` scenes have sun and sky above the ground within ``extent_m`` (2, 2): lowest and
    highest x, y of the part worth lighting exactly.
    """

    static: Mesh
    movers: Sequence[Mover] = ()
    heating: Sequence[Heating] = ()
    outdoors: bool = False
    extent_m: NDArray[np.float64] | None = None
