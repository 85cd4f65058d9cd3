"""A thing of the city: a mesh at a place, and what is true of it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.occupancy import OCC3D_CLASSES

LABELS = {name: number for number, name in enumerate(OCC3D_CLASSES)}
"""Number of each Occ3D class."""
VEHICLES = tuple(LABELS[n] for n in ("bicycle", "bus", "car", "construction vehicle", "motorcycle", "trailer", "truck"))
"""Classes of things with wheels or tracks."""
MOVABLE = (*VEHICLES, LABELS["pedestrian"], LABELS["traffic cone"], LABELS["barrier"])
"""Classes that nuScenes annotates with boxes."""
State = Literal["static", "parked", "moving"]
FOREVER = 1 << 30


@dataclass(frozen=True, eq=False, kw_only=True)
class Thing:
    """Something that stands somewhere, or starts there."""

    id: int
    """Number in instance images; the same in every traversal."""
    kind: str
    """What a person would call it: `box truck`, `house`, `stop sign`."""
    label: int
    """Occ3D class."""
    color: str = ""
    """Name of its main colour, empty where that says nothing."""
    mesh: Mesh
    position: tuple[float, float, float]
    """Of the mesh's origin, in the world."""
    yaw: float = 0.0
    exists: tuple[int, int] = (0, FOREVER)
    """First traversal it is there, and the first it is there no more."""
    light: tuple[float, float, float] | None = None
    """Where it shines down at night, in its own frame."""

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return T_world_thing."""
        return flat_pose(self.position, self.yaw)

    def part_numbers(self) -> tuple[int, ...]:
        """Return the parts that its mesh has."""
        return _parts(self.mesh)


@lru_cache(maxsize=1024)
def _parts(mesh: Mesh) -> tuple[int, ...]:
    return tuple(int(p) for p in np.unique(mesh.part))


def flat_pose(position: tuple[float, float, float], yaw: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose of something that stands upright."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], position
    return T
