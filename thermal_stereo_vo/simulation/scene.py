"""A world: what stands still, and what moves through it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.simulation.mesh import Mesh, MeshBuilder


@dataclass(frozen=True)
class Mover:
    """A body that changes its place: its mesh and its pose (4, 4) in the map at a time (s)."""

    mesh: Mesh
    T_map_object: Callable[[float], NDArray[np.float64]]


@dataclass(frozen=True)
class Scene:
    """``static`` never moves.  ``thin_m`` (N, 2, 3) are the ends of wires and the like, which must
    be cast with several rays wherever they appear.
    """

    static: Mesh
    movers: Sequence[Mover] = ()
    thin_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2, 3)))

    def moving(self, time_s: float) -> Mesh | None:
        """All movers at one time as one mesh, or None when there are none."""
        if not self.movers:
            return None
        parts = [mover.mesh.moved(mover.T_map_object(time_s)) for mover in self.movers]
        return Mesh(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.material for part in parts]),
            np.concatenate(
                [part.surface + 100_000 * number for number, part in enumerate(parts)]
            ).astype(np.int32),
            np.concatenate([part.offset_kelvin for part in parts]),
            np.concatenate([part.rest for part in parts]),
        )


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    builder = MeshBuilder()
    for mesh in meshes:
        builder.mesh(mesh)
    return builder.build()
